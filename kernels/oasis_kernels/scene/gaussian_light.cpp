// The colours of Gaussians in light on the CPU, 16 at once.

void light_gaussians(
#include "gaussian_light_parameters.inc"
    long long* state  // `PHASE_WORDS` words of zeros
) {
#pragma clang fp contract(fast)
#include "../posing/vectors.h"
#define VECTOR V
#define INTEGERS I
#include "../rasterize/exponential.h"
#undef VECTOR
#undef INTEGERS
#include "gaussian_light.h"
    const int blocks = (n + 15) / 16;
    const long long all = (long long)batch * blocks, at_once = TASK / 16;
    phase(state, (all + at_once - 1) / at_once, [&](long long task) {
        for (long long block = task * at_once; block < wp::min(all, (task + 1) * at_once); block++) {
            const int b = block / blocks, i = 16 * (block - (long long)b * blocks), count = wp::min(16, n - i);
            const long long first = (long long)b * n_vertices;
            int around[48] = {};
            memcpy(around, corners + 3ll * i, 3 * count * sizeof(int));
            const V3 w = get3(weights + 3ll * i, count);
            const V by[3] = {w.x, w.y, w.z};
            V color[3] = {zero, zero, zero}, deep = zero, weak = zero;
            for (int k = 0; k < 3; k++) {
                float last[16];
                const V4 four = rows([&](int lane) -> Q {
                    const float* row = columns + 5 * (first + around[3 * lane + k]);
                    last[lane] = row[4];
                    return load_row(row);
                });
                color[0] += by[k] * four.w, color[1] += by[k] * four.x, color[2] += by[k] * four.y;
                deep += by[k] * four.z, weak += by[k] * load(last);
            }
            if (folds) {
                float seen[16] = {}, paint[16] = {}, change[3][16] = {};
                bool any = false;
                for (int lane = 0; lane < count; lane++) {
                    const int m = folds[i + lane];
                    if (m < 0) continue;
                    any = true;
                    open_fold(b, m, seen + lane, paint + lane);
                    for (int c = 0; c < 3; c++) change[c][lane] = fold_change[3 * m + c];
                }
                if (any) {
                    const V from_photo = load(seen), by_how_much = from_photo + load(paint) * (1.f - weak);
                    for (int c = 0; c < 3; c++) color[c] *= exponential(load(change[c]) * by_how_much);
                    weak *= 1.f - from_photo;
                }
            }
            if (shade) {
                const V3 s = get3(shade + 3ll * i, count);
                const V own[3] = {s.x, s.y, s.z};
                shaded(own, deep, weak, color);
            }
            if (creases) {
                float change[3][16] = {};
                bool any = false;
                for (int lane = 0; lane < count; lane++) {
                    const int m = creases[i + lane];
                    if (m < 0) continue;
                    any = true;
                    float share = 0.f;
                    for (int k = 0; k < 3; k++)
                        share += weights[3ll * (i + lane) + k] * stretched[first + around[3 * lane + k]];
                    const float* logs = share > 0.f ? crease_change : wrinkles;
                    for (int c = 0; c < 3; c++) change[c][lane] = wp::abs(share) * logs[3 * m + c];
                }
                for (int c = 0; any && c < 3; c++) color[c] *= exponential(load(change[c]));
            }
            const V3 skin = get3(colors + 3ll * i, count);
            auto clamped = [&](V x) -> V { return smallest(largest(x, zero), one); };
            const V3 lit = {clamped(skin.x * color[0]), clamped(skin.y * color[1]), clamped(skin.z * color[2])};
            put3(out + 3 * ((long long)b * n + i), count, lit);
        }
    });
}
