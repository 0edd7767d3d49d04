// Part of the body of a kernel with `LANES` lanes for each vertex: of the last nearest vertex and its neighbours the
// `other` that is nearest now and that vertex v faces, its normal `m`, the way `r` to it and `depth` along that normal.
#include "contact_keys.h"
const long long row = (long long)block_index * (BLOCK / LANES) + threadIdx.x / LANES;
const int lane = threadIdx.x % LANES;
if (row >= (long long)batch * n) return;
const long long b = row / n;
const int v = (int)(row - b * n), last = others[row];
int other = -1;
V3 m = {0.f, 0.f, 0.f}, r = {0.f, 0.f, 0.f};
float depth = 0.f;
if (last >= 0) {
    const unsigned together = ((1u << LANES) - 1) << (threadIdx.x & (32 - LANES));
    const float *x = points + 3 * b * n, *facing = normals + 3 * b * n;
    auto place = [&](int j) -> V3 {
        const V3 y = get3(x, j);
        return shifts ? plus(y, get3(shifts + 3 * b * n, j)) : y;
    };
    const V3 here = place(v), normal = get3(facing, v), first = minus(place(last), here);
    Key best = key_of(dot3(first, first), 0);
    const int start = offsets[last];
    for (int e = start + lane; e < offsets[last + 1]; e += LANES) {
        const int j = neighbours[e];
        const V3 to = minus(place(j), here);
        const float distance = dot3(to, to);
        if (distance < squared_of(best) && dot3(normal, get3(facing, j)) < opposed)
            best = key_of(distance, e - start + 1);
    }
    best = nearest_of(best, together, LANES);
    const int at = (int)(unsigned)best;
    other = at ? neighbours[start + at - 1] : last;
    m = get3(facing, other);
    r = minus(place(other), here);
    depth = dot3(r, m);
}
