#include "face.h"
auto edges = [&](const Table& vertices, const int* corners) -> Edges {
    V3 p[3];
    for (int k = 0; k < 3; k++) {
        const V4 v = rows([&](int lane) -> Q { return at3(vertices, corners[3 * lane + k]); });
        p[k] = {v.w, v.x, v.y};
    }
    return edges_of(p[0], p[1], p[2]);
};
auto at_rest = [&](const Table& vertices, int first, int count, const int* corners, Start& from) -> Triangle {
    if (!triangles) {
        const Edges e = edges(vertices, corners);
        from = start(e);
        return triangle(e, from);
    }
    auto part = [&](int k) -> V4 {
        return rows([&](int lane) -> Q {
            return load_row(triangles + 12ll * (first + wp::min(lane, count - 1)) + 4 * k);
        });
    };
    const V4 p = part(0), q = part(1), r = part(2);
    return from_row(p, q, r, from);
};
auto pair = [&](const Table& before, const Table& after, int first, int count, const int* corners) -> Pair {
    Start from;
    const Triangle rest = at_rest(before, first, count, corners, from);
    return pair_of(rest, triangle(edges(after, corners), from), from);
};
int last_corners[48];
auto corners_of = [&](const int* faces, int first, int count) -> const int* {
    const int* corners = faces + 3ll * first;
    if (count == 16) return corners;
    memset(last_corners, 0, sizeof last_corners);
    memcpy(last_corners, corners, 3 * count * sizeof(int));
    return last_corners;
};
