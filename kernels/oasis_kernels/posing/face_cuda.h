#include "face.h"
auto edges = [&](const float* vertices, const int* corner) -> Edges {
    return edges_of(get3(vertices, corner[0]), get3(vertices, corner[1]), get3(vertices, corner[2]));
};
auto at_rest = [&](long long f, const int* corner, Start& from) -> Triangle {
    if (triangles)
        return from_row(get4(triangles, 3 * f), get4(triangles, 3 * f + 1), get4(triangles, 3 * f + 2), from);
    const Edges e = edges(rest_vertices, corner);
    from = start(e);
    return triangle(e, from);
};
auto pair = [&](const float* posed_vertices, long long f, const int* corner) -> Pair {
    Start from;
    const Triangle rest = at_rest(f, corner, from);
    return pair_of(rest, triangle(edges(posed_vertices, corner), from), from);
};
