// What the CUDA kernels of the depth buffer share: the camera, the float64 arithmetic of `depth_buffer`, a builder.
//
// `clear` -> `draw` -> `draw_large` (`cuda_depth_draw`) -> `resolve` (`cuda_depth_resolve`), four nodes of a graph;
// backwards `pull` twice and `settle` (`cuda_depth_pull`). Arrays are float32, decisions are float64: the same
// expressions in the same order as in `depth_buffer`, without fused multiply-adds, so that every pixel shows the same
// face as on the CPU.

// Drawing faces into keys, one 64-bit word a pixel: the CUDA depth buffer.
//
// `clear` empties the keys. `draw` gives a warp eight faces: 24 lanes bring a corner each into the camera's axes, eight
// lanes find a box each, and then the pixels of all eight boxes are dealt out to the 32 lanes, so that a warp is busy
// whatever the sizes of its faces. Faces with larger boxes go to a queue, and `draw_large` deals out the pixels of the
// whole queue to all warps of the GPU in equal shares. Those that find the queue full are drawn where they are found:
// so many fill the GPU either way.
//
// A key is the depth, rounded down to a float32, above the face's index, so that the smallest key is nearly the answer.
// Where the rounded depths of two faces agree, the exact ones are compared (see `settle`): the face that stays is the
// nearest, of those at one depth the first, whatever the order of the threads.

__global__ void clear(
    const float* Ks,  // [batch or 1][3][3]
    long long Ks_step,
    int batch,
    ulonglong2* keys,  // [batch][height][width]: depth rounded to float32, then the face; or all bits
    long long key_pairs,
    unsigned long long* counter,  // of the queue
    volatile long long* found     // set to 1 where a focal length is not positive; or 0
) {
    const ulonglong2 empty = {~0ull, ~0ull};
    const long long step = (long long)gridDim.x * BLOCK;
    for (long long i = (long long)block_index * BLOCK + threadIdx.x; i < key_pairs; i += step) keys[i] = empty;
    if (block_index == 0 && threadIdx.x == 0) *counter = 0;
    if (found && block_index == 0)
        for (int b = threadIdx.x; b < batch; b += BLOCK)
            if (!(Ks[b * Ks_step] > 0.f) || !(Ks[b * Ks_step + 4] > 0.f)) *found = 1;
}

__global__ void draw(
#include "mesh_parameters.inc"
#include "queue_parameters.inc"
    int capacity
) {
#include "camera_cuda.h"
#include "exact_cuda.h"
#include "pixels_cuda.h"
    constexpr int FACES = 8;  // a warp
    struct Small {
        Triangle triangle;
        double flat;
        int left, top, width, start;
    };
    __shared__ Camera camera;
    __shared__ Small smalls[WARPS][FACES];
    Small* small = smalls[warp];
    const int groups = (n_faces - 1) / FACES_PER_BLOCK + 1;
    int entry = -1;
    for (long long task = block_index; task < (long long)batch * groups; task += gridDim.x) {
        const int b = (int)(task / groups), first = (int)(task % groups) * FACES_PER_BLOCK + FACES * warp;
        const float* mesh = vertices + b * vertices_step;
        const bool has_corner = lane < 3 * FACES && first + lane / 3 < n_faces;
        float px = 0.f, py = 0.f, pz = 0.f;
        if (has_corner) {
            const float* p = mesh + 3ll * faces[3ll * first + lane];
            px = p[0];
            py = p[1];
            pz = p[2];
        }
        if (b != entry) {
            __syncthreads();  // nobody reads the last camera any more
            read_camera(camera, b, threadIdx.x);
            __syncthreads();
            entry = b;
        }
        __syncwarp();  // nor the last faces
        if (has_corner) (&small[lane / 3].triangle.a)[lane % 3] = Exact::in_camera(camera, px, py, pz);
        __syncwarp();

        Box box = {0, 0, 0, 0};
        if (lane < FACES && first + lane < n_faces) {
            Small& s = small[lane];
            const Triangle t = s.triangle;
            box = box_of(camera, t);
            s.flat = edge_on(t);
            s.left = box.left;
            s.top = box.top;
            s.width = box.width;
        }
        const long long pixels = (long long)box.width * box.height;
        const bool large = pixels > LARGE;
        const unsigned larges = __ballot_sync(all, large);
        bool queued = false;
        if (larges) {
            const long long shares = large ? (pixels + SHARE - 1) / SHARE : 0;
            long long sum = shares;
            for (int offset = 1; offset < FACES; offset <<= 1) {
                const long long other = __shfl_up_sync(all, sum, offset);
                if (lane >= offset) sum += other;
            }
            Key place = ~0ull;
            // Once it is full nobody adds to the counter, lest it overflow.
            if (lane == FACES - 1 && *(volatile Key*)counter >> START_BITS < (Key)capacity)
                place = atomicAdd(counter, (Key)__popc(larges) << START_BITS | (Key)sum);
            place = __shfl_sync(all, place, FACES - 1);
            const long long slot = (long long)(place >> START_BITS) + __popc(larges & ((1u << lane) - 1));
            const long long start = (long long)(place & ((1ull << START_BITS) - 1)) + sum - shares;
            // Places are given out in order: the start of the first face that has none is the end of the queue.
            if (large && place != ~0ull && slot <= capacity) queue_starts[slot] = start;
            queued = large && place != ~0ull && slot < capacity;
            if (queued) queue_faces[slot] = (long long)b * n_faces + first + lane;
        }
        const int count = large ? 0 : (int)pixels;
        int sum = count;
        for (int offset = 1; offset < FACES; offset <<= 1) {
            const int other = __shfl_up_sync(all, sum, offset);
            if (lane >= offset) sum += other;
        }
        if (lane < FACES) small[lane].start = sum - count;
        const int total = __shfl_sync(all, sum, FACES - 1);
        unsigned unqueued = __ballot_sync(all, large && !queued);
        __syncwarp();

        Key* picture = keys + b * plane;
        int starts[FACES];
#pragma unroll
        for (int k = 1; k < FACES; k++) starts[k] = small[k].start;
        draw_items(camera, mesh, 0, total, [&](unsigned item) -> Hit {
            int k = 0, start = 0;
#pragma unroll
            for (int j = 1; j < FACES; j++)
                if ((int)item >= starts[j]) {
                    k = j;
                    start = starts[j];
                }
            const Small& s = small[k];
            return meet(camera, picture, s.triangle, s.flat, s.left, s.top, s.width, first + k, item - start);
        });
        for (; unqueued; unqueued &= unqueued - 1) {
            const int k = __ffs(unqueued) - 1;
            const Small& s = small[k];
            draw_items(camera, mesh, 0, (unsigned)__shfl_sync(all, pixels, k), [&](unsigned item) -> Hit {
                return meet(camera, picture, s.triangle, s.flat, s.left, s.top, s.width, first + k, item);
            });
        }
    }
}

__global__ void draw_large(
#include "mesh_parameters.inc"
#include "queue_parameters.inc"
    int capacity
) {
#include "camera_cuda.h"
#include "exact_cuda.h"
#include "pixels_cuda.h"
    const Key counted = *counter;
    const long long n = min((long long)(counted >> START_BITS), (long long)capacity);
    if (n == 0) return;
    const long long shares = (long long)(counted >> START_BITS) > capacity
                                 ? queue_starts[capacity]
                                 : (long long)(counted & ((1ull << START_BITS) - 1));
    const long long warps = (long long)gridDim.x * WARPS, me = (long long)block_index * WARPS + warp;
    long long share = shares * me / warps;
    const long long end = shares * (me + 1) / warps;
    if (share >= end) return;
    long long slot = 0;  // the last face that starts at `share` or before
    for (long long beyond = n; beyond - slot > 1;) {
        const long long middle = (slot + beyond) / 2;
        if (queue_starts[middle] <= share)
            slot = middle;
        else
            beyond = middle;
    }
    // Whether a triangle surely has none of the items from `first` to `last`. On the screen its edge functions are
    // linear, so they are largest and smallest at the corners of the columns and rows of these items: a lane a corner.
    auto passes_by = [&](const Camera& camera, const Triangle& t, const Box& box, unsigned first, unsigned last) {
        const unsigned top = first / box.width, bottom = (last - 1) / box.width;
        const unsigned left = top == bottom ? first - top * box.width : 0;
        const unsigned right = top == bottom ? last - 1 - top * box.width : box.width - 1;
        const Ray ray =
            Exact::ray(camera, box.left + (int)(lane & 1 ? right : left), box.top + (int)(lane & 2 ? bottom : top));
        const Weights w = Exact::weigh(t, ray);
        // What rounding may add up to, here or at a pixel, with a margin.
        auto size_of = [&](const Corner& p) { return fabs(p.x) + fabs(p.y) + (fabs(ray.u) + fabs(ray.v)) * fabs(p.z); };
        const double a = size_of(t.a), b = size_of(t.b), c = size_of(t.c);
        const double slack_a = 1e-14 * (b * c), slack_b = 1e-14 * (c * a), slack_c = 1e-14 * (a * b);
        const bool is_negative =
            __all_sync(all, w.a < -slack_a) || __all_sync(all, w.b < -slack_b) || __all_sync(all, w.c < -slack_c);
        const bool is_positive =
            __all_sync(all, w.a > slack_a) || __all_sync(all, w.b > slack_b) || __all_sync(all, w.c > slack_c);
        return is_negative && is_positive;
    };
    __shared__ Camera cameras[WARPS];
    Camera& camera = cameras[warp];
    int entry = -1;
    for (; share < end; slot++) {
        const int b = (int)(queue_faces[slot] / n_faces), f = (int)(queue_faces[slot] % n_faces);
        const long long start = queue_starts[slot];
        const long long until = min(end, slot + 1 < n ? queue_starts[slot + 1] : shares);
        if (b != entry) {
            __syncwarp();
            read_camera(camera, b, lane);
            __syncwarp();
            entry = b;
        }
        const float* mesh = vertices + b * vertices_step;
        const Triangle t = Exact::triangle(camera, mesh, faces, f);
        const Box box = box_of(camera, t);
        const double flat = edge_on(t);
        const unsigned pixels = (unsigned)box.width * (unsigned)box.height;
        for (; share < until; share++) {
            const unsigned first = (unsigned)(share - start) * SHARE, last = min(first + SHARE, pixels);
            if (pixels > CULLED_SHARE && passes_by(camera, t, box, first, last)) continue;
            draw_items(camera, mesh, first, last, [&](unsigned item) -> Hit {
                return meet(camera, keys + b * plane, t, flat, box.left, box.top, box.width, f, item);
            });
        }
    }
}
