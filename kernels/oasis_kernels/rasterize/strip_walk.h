const long long stride = 2 * (strip_width + PAD);
auto pair_of = [&](long long index, int strip) -> long long {
    return pair_starts[index] + strip - (boxes[4 * index + 1] >> height_bits);
};
// Draw a strip: `vector(y, x, weight, drawn)` sees every vector, `row_pair(y)` follows the last of two rows, and
// `layer(gaussian)` the last of all.
auto walk =
    [&](const Strip& p, const int* list, int count, float* plane, auto&& vector, auto&& row_pair, auto&& layer) {
        for (int y = 0; y < p.rows; y += 2)
            for (int x = 0; x < strip_width + PAD; x += COLUMNS) {
                const I inside = (column + (float)x < (float)p.columns) & (row + (float)y < (float)p.rows);
                store(plane + y / 2 * stride + 2 * x, inside ? (V)(1.f) : (V)(-1.f));
            }
        for (int place = 0; place < count; place++) {
            __builtin_prefetch(records + 16ll * list[place + 8 < count ? place + 8 : place]);
            const float* r = records + 16ll * list[place];
            const Layer l = layer_of(r, p);
            for (int y = l.y0; y < l.y1; y += 2) {
#include "strip_row.h"
                float* t = plane + y / 2 * stride + 2 * l.x0;
                for (int x = l.x0; x < l.x1; x += COLUMNS, t += LANES, X += (float)COLUMNS) {
#include "strip_blend.h"
                    store(t, ends ? -before : after);
                    vector(y, x, full, drawn & ~ends);
                }
                row_pair(y);
            }
            layer(list[place]);
        }
    };
