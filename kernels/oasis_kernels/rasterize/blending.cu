// Float32 blending on CUDA: two warps sort and draw a tile of 8 x 8 pixels, one pixel per lane.
//
// A warp goes through the tile's list 32 layers at a time: each lane fetches one and tests it against the warp's 8 x 4
// pixels; those that can reach a pixel are packed together in shared memory, where all lanes read them in turn.
//
// For the backward pass the list is cut into segments by its length alone. What each segment but the first adds to a
// pixel, and the transmittance at the end of each but the last, are kept, so that the segments can be replayed at once.

__global__ void blend(
#include "tile_parameters.inc"
    const long long* keys, float* image, float* alphas
) {
#include "tile_layers.h"
    // Each warp sorts 32 keys at a time in its registers; then every key counts those before it in all runs.
    __shared__ long long keys_here[LONGEST];
    __shared__ int sorted_here[LONGEST];
    if (count <= LONGEST) {
        const int runs = (count + 31) >> 5;
        for (int run = warp; run < runs; run += WARPS) {
            const int at = run * 32 + lane;
            long long key = at < count ? keys[start + at] : 0x7fffffffffffffffll;
#pragma unroll
            for (int size = 2; size <= 32; size <<= 1) {
#pragma unroll
                for (int step = size >> 1; step > 0; step >>= 1) {
                    const long long other = __shfl_xor_sync(all, key, step);
                    const bool smaller = ((lane & size) == 0 || size == 32) == ((lane & step) == 0);
                    if ((other < key) == smaller) key = other;
                }
            }
            keys_here[at] = key;
        }
        __syncthreads();
        for (int at = threadIdx.x; at < runs * 32; at += BLOCK) {
            const long long key = keys_here[at];
            int rank = 0;
#pragma unroll 4
            for (int run = 0; run < runs; run++) {
                const long long* those = keys_here + run * 32;
                int before = 0;
#pragma unroll
                for (int step = 16; step > 0; step >>= 1)
                    if (those[before + step - 1] < key) before += step;
                rank += before + (those[before] < key);
            }
            if (at < count) {
                const int g = camera * n + (int)(key & INDEX_MASK);
                sorted_here[rank] = g;
                if (stops) tile_gaussians[start + rank] = g;
            }
        }
        __syncthreads();
    }
    const int* const list = count <= LONGEST ? sorted_here : tile_gaussians + start;
    const int used = (count + segment - 1) / segment;
    const int column = lane & 7, row = 4 * warp + (lane >> 3), pixel_here = row * 8 + column;
    const bool inside = left + column < width && top + row < height;
    // A pixel that has ended moves out of reach of every layer.
    float x = inside ? (float)column : 1e18f;
    const float y = (float)row, y_low = (float)(4 * warp), y_high = y_low + 3.f;
    float T = 1.f, C[PADDED] = {}, sums[CHANNELS] = {};
    int stop = count, now = 0;  // the segment being drawn
    auto keep = [&](int b, int k, float value) {
        if (boundaries) boundary(b, k, pixel_here) = value;
    };
    auto end_segment = [&]() {
#pragma unroll
        for (int k = 0; k < CHANNELS; k++) {
            if (now > 0) keep(now - 1, k + 1, C[k]);
            sums[k] += C[k];
            C[k] = 0.f;
        }
        if (now < used - 1) keep(now, 0, T);
        now++;
    };

    // The next 32 layers are on their way while these are drawn.
    float4 next_center, next_whitening;
    float next_opacity, next_color[PADDED];
    int next_index;
    auto fetch = [&](int first) {
        if (first + lane < count) {
            next_index = list[first + lane];
            next_center = centers[next_index];
            next_whitening = whitenings[next_index];
            next_opacity = own_opacities[next_index];
            if (CHANNELS <= 4) {
#pragma unroll
                for (int k = 0; k < CHANNELS; k++) next_color[k] = own_colors[(long long)next_index * CHANNELS + k];
            }
        }
    };
    fetch(0);
    for (int first = 0; first < count; first += 32) {
        if (first == (now + 1) * segment) end_segment();
        if (!__any_sync(all, x < 1e17f)) break;
        __syncwarp();
        const Layer l = layer(next_center, next_whitening, next_opacity);
        const bool hits = first + lane < count && reaches(l, y_low, y_high);
        const unsigned hitting = __ballot_sync(all, hits);
        const int m = __popc(hitting), slot = __popc(hitting & ((1u << lane) - 1u));
        const float* const color = CHANNELS <= 4 ? next_color : own_colors + (long long)next_index * CHANNELS;
        if (hits) put(slot, l, first + lane, color);
        if (lane >= m && lane < ((m + 3) & ~3)) put_nothing(lane);
        __syncwarp();
        fetch(first + 32);
        // Four layers at a time: their alphas do not wait for each other, and the next four are under way while these
        // are blended.
        auto alphas_of = [&](int j, float* alpha) {
#pragma unroll
            for (int i = 0; i < 4; i++) {
                const unsigned at = layers_at + (j + i) * (4 * STRIDE);
                const float4 a = load4(at), b = load4(at + 16);
                const float dx = x - a.x, dy = y - a.y;
                const float u = fmaf(a.z, dx, a.w * dy), v = fmaf(b.x, dx, b.y * dy);
                const float raw = power(fmaf(-v, v, fmaf(-u, u, b.z)));
                alpha[i] = raw >= ALPHA_MIN ? fminf(raw, ALPHA_MAX) : 0.f;
            }
        };
        float alpha[4], next_alpha[4] = {};
        if (m) alphas_of(0, alpha);
#pragma unroll 2
        for (int j = 0; j < m; j += 4) {
            if (j + 4 < m) alphas_of(j + 4, next_alpha);
            float t[5] = {T};
#pragma unroll
            for (int i = 0; i < 4; i++) t[i + 1] = fmaf(-alpha[i], t[i], t[i]);
            if (__any_sync(all, t[4] <= STOP)) {  // some pixel ends among the four
                bool ended = false;
#pragma unroll
                for (int i = 0; i < 4; i++) {
                    if (ended) alpha[i] = 0.f;
                    t[i + 1] = fmaf(-alpha[i], t[i], t[i]);
                    if (t[i + 1] <= STOP) {
                        ended = true;
                        stop = __float_as_int(layers[(j + i) * STRIDE + 7]);
                        x = 1e18f;
                        t[i + 1] = t[i];
                        alpha[i] = 0.f;
                    }
                }
#pragma unroll
                for (int i = 0; i < 4; i++)
                    if (ended) next_alpha[i] = 0.f;
            }
#pragma unroll
            for (int i = 0; i < 4; i++) {
                const float weight = alpha[i] * t[i];
#pragma unroll
                for (int k = 0; k < CHANNELS; k += 4) {
                    const float4 color = load4(layers_at + (j + i) * (4 * STRIDE) + 32 + 4 * k);
                    C[k] = fmaf(color.x, weight, C[k]);
                    if (k + 1 < CHANNELS) C[k + 1] = fmaf(color.y, weight, C[k + 1]);
                    if (k + 2 < CHANNELS) C[k + 2] = fmaf(color.z, weight, C[k + 2]);
                    if (k + 3 < CHANNELS) C[k + 3] = fmaf(color.w, weight, C[k + 3]);
                }
            }
            T = t[4];
#pragma unroll
            for (int i = 0; i < 4; i++) alpha[i] = next_alpha[i];
        }
    }
    end_segment();
    for (; now < used; now++) {  // segments that no pixel needed
        for (int k = 0; k < CHANNELS; k++) keep(now - 1, k + 1, 0.f);
        if (now < used - 1) keep(now, 0, T);
    }
    if (!inside) return;
    const long long pixel = first_pixel + (long long)row * width + column;
    alphas[pixel] = 1.f - T;
    if (transmittance) transmittance[pixel] = T;
    if (stops) stops[pixel] = stop;
#pragma unroll
    for (int k = 0; k < CHANNELS; k++)
        image[pixel * CHANNELS + k] = sums[k] + (backgrounds ? backgrounds[camera * CHANNELS + k] * T : 0.f);
}
