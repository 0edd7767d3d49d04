// How much of the light from all around reaches points of a surface that hides it from itself, on the CPU.
//
// The surface is drawn once for each two opposite directions, as parallel rays see it: its nearest depths hide the sky
// on the one side, its farthest on the other. A vertex faces one of the two. It asks that buffer, percentage-closer
// filtered (Reeves et al. 1987): four texels, bilinear, each with a ramp. What arrives is the sum over directions d of
// w_d max(0, n . d) L(d) V(d), over the same sum without V; then the mean over the corners of the faces around.
//
// Phases: images are turned into the axes of the surface; pairs of directions are drawn and looked into; vertices add
// up what arrives; vertices average it over the faces around.

void expose(
#include "sky_parameters.inc"
    long long* state,  // `STATE` words of zeros
    int width,         // of rows of scratch: the vertices, filled up to 16
    float* own,        // [B, 6, width], scratch: vertices from the middle of their box, normals
    float* screen,     // [B, P, 3, width], scratch: column, row [px] and depth [m]
    float* shares      // [B, P, width], scratch: what each vertex sees of the one it faces of two directions
) {
#pragma clang fp contract(fast)
#include "../posing/vectors.h"
#include "../runtime/ranges.h"
#include "sky_light.h"
    typedef int J __attribute__((ext_vector_type(4)));
    const float FAR = 1e30f;
    const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    // Numbers that are none become `low`: no index is made of them.
    auto clamped = [&](V a, float low, float high) -> V { return smallest(a > low ? a : (V)(low), (V)(high)); };
    auto along = [](const float* axis, V x, V y, V z) -> V { return axis[0] * x + axis[1] * y + axis[2] * z; };

    phase(state, batch, [&](long long b) {
        float* rows[6];
        for (int k = 0; k < 6; k++) rows[k] = own + (6 * b + k) * width;
        float m[9];
        matrix_of(turns + 4 * b, m);
        for (int k = 0; k < 2 * PAIRS; k++)
            light_from(m, axes + 9 * (k / 2) + 6, k % 2 ? 1.f : -1.f, lights + 3 * (2 * PAIRS * b + k));
        auto turned = [&](V3 p) -> V3 {
            return {
                m[0] * p.x + m[3] * p.y + m[6] * p.z, m[1] * p.x + m[4] * p.y + m[7] * p.z,
                m[2] * p.x + m[5] * p.y + m[8] * p.z
            };
        };
        V least[3], most[3];
        for (int k = 0; k < 3; k++) least[k] = (V)(FAR), most[k] = (V)(-FAR);
        for (int i = 0; i < n_vertices; i += 16) {
            const int count = wp::min(16, n_vertices - i);
            const V3 p = turned(get3(vertices + 3 * (b * n_vertices + i), count));
            const V3 n = turned(get3(normals + 3 * (b * n_vertices + i), count));
            const V put[6] = {p.x, p.y, p.z, n.x, n.y, n.z};
            for (int k = 0; k < 6; k++) store(rows[k] + i, put[k]);
            for (int k = 0; k < 3; k++) {
                least[k] = ((lane < count) & (put[k] < least[k])) ? put[k] : least[k];
                most[k] = ((lane < count) & (put[k] > most[k])) ? put[k] : most[k];
            }
        }
        V square = zero, middle[3];
        for (int k = 0; k < 3; k++)
            middle[k] = (V)((__builtin_reduce_min(least[k]) + __builtin_reduce_max(most[k])) / 2);
        for (int i = 0; i < n_vertices; i += 16) {
            V length = zero;
            for (int k = 0; k < 3; k++) {
                const V from = load(rows[k] + i) - middle[k];
                store(rows[k] + i, from);
                length += from * from;
            }
            square = ((lane < n_vertices - i) & (length > square)) ? length : square;
        }
        radius[b] = MARGIN * __builtin_sqrtf(__builtin_reduce_max(square));
    });

    phase(state + PHASE_WORDS, (long long)batch * PAIRS, [&](long long task) {
        const int b = task / PAIRS, k = task % PAIRS;
        const float *x = own + 6ll * b * width, *y = x + width, *z = y + width;
        const float *nx = z + width, *ny = nx + width, *nz = ny + width;
        const float *right = axes + 9 * k, *down = right + 3, *away = down + 3;
        const float texel = radius[b] * (2.f / SIZE), scale = texel > 0.f ? 1.f / texel : 0.f, middle = SIZE / 2 - .5f;
        float *columns = screen + 3ll * task * width, *lines = columns + width, *depths = lines + width;
        for (int i = 0; i < n_vertices; i += 16) {
            const V px = load(x + i), py = load(y + i), pz = load(z + i);
            store(columns + i, along(right, px, py, pz) * scale + middle);
            store(lines + i, along(down, px, py, pz) * scale + middle);
            store(depths + i, along(away, px, py, pz));
        }

        const int stride = SIZE + 4;  // a row's last four pixels may start at its last
        float nearest[2 * SIZE * (SIZE + 4)], *farthest = nearest + SIZE * stride;
        for (int i = 0; i < SIZE * stride; i++) nearest[i] = FAR, farthest[i] = -FAR;
        for (int first = 0; first < n_faces; first += 16) {
            V corner[3][3];
            for (int j = 0; j < 3; j++) {
                float u[16], v[16], w[16];
                for (int l = 0; l < 16; l++) {
                    const int vertex = faces[3 * wp::min(first + l, n_faces - 1) + j];
                    u[l] = columns[vertex], v[l] = lines[vertex], w[l] = depths[vertex];
                }
                corner[j][0] = load(u), corner[j][1] = load(v), corner[j][2] = load(w);
            }
            auto least = [&](int c) -> V { return smallest(corner[0][c], smallest(corner[1][c], corner[2][c])); };
            auto most = [&](int c) -> V { return largest(corner[0][c], largest(corner[1][c], corner[2][c])); };
            const V left = __builtin_elementwise_ceil(clamped(least(0), 0.f, SIZE));
            const V last = __builtin_elementwise_floor(clamped(most(0), -1.f, SIZE - 1));
            const V top = __builtin_elementwise_ceil(clamped(least(1), 0.f, SIZE));
            const V bottom = __builtin_elementwise_floor(clamped(most(1), -1.f, SIZE - 1));
            const V bx = corner[1][0] - corner[0][0], by = corner[1][1] - corner[0][1];
            const V cx = corner[2][0] - corner[0][0], cy = corner[2][1] - corner[0][1];
            const V doubled = bx * cy - by * cx;
            const I drawn = (lane < n_faces - first) & (left <= last) & (top <= bottom) & (magnitude(doubled) > 1e-12f);
            if (!__builtin_reduce_or(drawn)) continue;
            // Shares of the second and third corner at the first pixel, and their growth by a column and a row.
            const V inverse = one / (drawn ? doubled : one), dx = left - corner[0][0], dy = top - corner[0][1];
            const V second = (dx * cy - dy * cx) * inverse, third = (dy * bx - dx * by) * inverse;
            const V by_z = corner[1][2] - corner[0][2], cz = corner[2][2] - corner[0][2];
            const V terms[9] = {second,       cy * inverse, -cx * inverse, third, -by * inverse,
                                bx * inverse, corner[0][2], by_z,          cz};
            float t[9][16];
            int box[4][16], here[16];
            for (int j = 0; j < 9; j++) store(t[j], terms[j]);
            const V bounds[4] = {left, last, top, bottom};
            for (int j = 0; j < 4; j++) *(IU*)box[j] = __builtin_convertvector(bounds[j], I);
            *(IU*)here = drawn;
            for (int l = 0; l < 16; l++) {
                if (!here[l]) continue;
                for (int row = box[2][l]; row <= box[3][l]; row++)
                    for (int column = box[0][l]; column <= box[1][l]; column += 4) {
                        const float from = (float)(column - box[0][l]), below = (float)(row - box[2][l]);
                        const Q across = {from, from + 1.f, from + 2.f, from + 3.f};
                        const Q q = t[0][l] + t[2][l] * below + t[1][l] * across;
                        const Q r = t[3][l] + t[5][l] * below + t[4][l] * across;
                        const J inside = (q >= -SLACK) & (r >= -SLACK) & (q + r <= 1.f + SLACK);
                        const Q depth = t[6][l] + q * t[7][l] + r * t[8][l];
                        float *near = nearest + row * stride + column, *far = farthest + row * stride + column;
                        const Q before = load_row(near), behind = load_row(far);
                        store_row(near, (inside & (depth < before)) ? depth : before);
                        store_row(far, (inside & (depth > behind)) ? depth : behind);
                    }
            }
        }

        for (int i = 0; i < n_vertices; i += 16) {
            const V a = load(nx + i), c = load(ny + i), d = load(nz + i);
            const V cosine = -along(away, a, c, d), size = magnitude(cosine);
            const V u = load(columns + i) + LIFT * scale * along(right, a, c, d);
            const V v = load(lines + i) + LIFT * scale * along(down, a, c, d);
            const V depth = load(depths + i) - LIFT * cosine;
            const V tangent = root(largest(one - size * size, zero)) / (size > 0.f ? size : one);
            const V bias = LIFT + smallest(tangent, (V)(STEEPEST)) * texel;
            const V column = __builtin_elementwise_floor(clamped(u, -1.f, SIZE));
            const V row = __builtin_elementwise_floor(clamped(v, -1.f, SIZE));
            const V part_x = u - column, part_y = v - row;
            const V side = cosine > 0.f ? one : -one;
            const I buffer = cosine > 0.f ? (I)(0) : (I)(SIZE * stride);
            V share = zero;
            for (int j = 0; j < 4; j++) {
                const I at_x = __builtin_convertvector(clamped(column + (float)(j % 2), 0.f, SIZE - 1), I);
                const I at_y = __builtin_convertvector(clamped(row + (float)(j / 2), 0.f, SIZE - 1), I);
                int at[16];
                *(IU*)at = at_y * stride + at_x + buffer;
                float hides[16];
                for (int l = 0; l < 16; l++) hides[l] = nearest[at[l]];
                const V gap = side * (load(hides) - depth);
                const V weight = (j % 2 ? part_x : one - part_x) * (j / 2 ? part_y : one - part_y);
                share += weight * clamped((gap + bias) * (1.f / LIFT) + one, 0.f, 1.f);
            }
            store(shares + task * width + i, share);
        }
    });

    const int blocks = (n_vertices + 15) / 16;
    phase(state + 2 * PHASE_WORDS, batch, [&](long long b) {
        const float *nx = own + (6ll * b + 3) * width, *ny = nx + width, *nz = ny + width;
        for (int i = 0; i < 16 * blocks; i += 16) {
            const V a = load(nx + i), c = load(ny + i), d = load(nz + i);
            V whole[4] = {zero, zero, zero, zero}, seen[4] = {zero, zero, zero, zero};
            for (int k = 0; k < PAIRS; k++) {
                const V cosine = -along(axes + 9 * k + 6, a, c, d), arriving = weights[k] * magnitude(cosine);
                const V share = load(shares + (b * PAIRS + k) * width + i);
                const float *light = lights + 6 * (b * PAIRS + k), *opposite = light + 3;
                for (int j = 0; j < 4; j++) {
                    const V part = j ? arriving * (cosine > 0.f ? (V)(light[j - 1]) : (V)(opposite[j - 1])) : arriving;
                    whole[j] += part;
                    seen[j] += share * part;
                }
            }
            V of[4];
            for (int j = 0; j < 4; j++)
                of[j] = whole[j] > LEAST ? smallest(seen[j] / (whole[j] > LEAST ? whole[j] : one), one) : one;
            put4(rough + 4 * (b * n_vertices + i), wp::min(16, n_vertices - i), {of[0], of[1], of[2], of[3]});
        }
    });

    ranges(state + 3 * PHASE_WORDS, (long long)batch * n_vertices, [&](int first, int end) {
        for (int i = first; i < end; i++) {
            const int b = i / n_vertices, v = i - b * n_vertices, begin = offsets[v], count = offsets[v + 1] - begin;
            Q total = (Q)(0.f);
            for (int e = begin; e < begin + count; e++)
                for (int j = 0; j < 3; j++) {
                    const int corner = faces[3 * (entries[e] / 3) + j];
                    total += load_row(rough + 4 * ((long long)b * n_vertices + corner));
                }
            store_row(out + 4ll * i, count ? total * (1.f / (3.f * count)) : load_row(rough + 4ll * i));
        }
    });
}
