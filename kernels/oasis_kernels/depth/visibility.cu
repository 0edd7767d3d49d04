// From the keys of `cuda_depth_draw` to scores of points and to pictures: one thread per point, then one a pixel.
//
// Both read the keys alone, so that they are one node. Pictures that nobody asks for are not written, and only the
// pixels that need a depth look at their face again: its float64 depth is not in the key. A thread of a large picture
// takes several pixels and asks for all of their keys at once.

__global__ void resolve(
#include "mesh_parameters.inc"
    double near_plane,
    unsigned long long* keys,  // [batch][height][width]: depth rounded to float32, then the face; or all bits
    const float* points,       // [batch or 1][n_points][3]
    long long points_step,
    const void* point_vertices,  // [n_points] of 4 or 8 bytes, or 0: the vertex that a point is, or -1
    int vertex_bytes,
    int by_identity,  // whether points that are vertices of a face in view are seen by that alone
    int n_vertices,
    int n_points,
    double tau,
    double margin,
    float* visibility,         // [batch][n_points]
    float* slopes,             // [batch][n_points]: derivative by the point's depth; or 0
    int* pixels,               // [batch][n_points]: row * width + column where the score is soft, else -1; or 0
    float* depth,              // [batch][height][width], or 0
    int* face_ids,             // [batch][height][width], or 0
    float* barycentrics,       // [batch][height][width][3], or 0
    int pixels_a_thread,       // up to MAX_PIXELS
    volatile long long* found  // set to 1 where a point's vertex is none; or 0
) {
#include "camera_cuda.h"
#include "exact_cuda.h"
    typedef unsigned long long Key;
    __shared__ Camera camera;
    const long long plane = (long long)width * height;

    auto score = [&](int b, int i) {
        const float* mesh = vertices + b * vertices_step;
        const Key* picture = keys + b * plane;
        auto shown = [&](int x, int y) -> int { return (int)(unsigned)picture[(long long)y * width + x]; };
        const Corner p = Exact::corner(camera, points + b * points_step + 3ll * i);
        const long long at = (long long)b * n_points + i;
        double seen = 0.0, slope = 0.0;
        int pixel = -1;
        long long vertex = -1;
        if (point_vertices)
            vertex =
                vertex_bytes == 8 ? ((const long long*)point_vertices)[i] : (long long)((const int*)point_vertices)[i];
        if (found && (vertex < -1 || vertex >= n_vertices)) *found = 1;
        const double u = camera.lens[0] * p.x / p.z + camera.lens[1], v = camera.lens[4] * p.y / p.z + camera.lens[5];
        if (p.z > near_plane && u >= 0.0 && v >= 0.0 && u < (double)width && v < (double)height) {
            const int x = (int)u, y = (int)v, id = shown(x, y);
            bool known = id < 0;
            if (!known && by_identity && vertex >= 0) {
                // All of the 3 x 3 pixels at once, so that the reads do not wait for each other.
                int ids[9];
#pragma unroll
                for (int k = 0; k < 9; k++)
                    ids[k] = shown(min(max(x + k % 3 - 1, 0), width - 1), min(max(y + k / 3 - 1, 0), height - 1));
#pragma unroll
                for (int k = 0; k < 9; k++)
                    if (ids[k] >= 0) {
                        const int* f = faces + 3ll * ids[k];
                        known |= f[0] == vertex || f[1] == vertex || f[2] == vertex;
                    }
            }
            if (known) {
                seen = 1.0;
            } else {
                const Triangle t = Exact::triangle(camera, mesh, faces, id);
                const double per_tau = 1.0 / tau;
                const double z = Exact::depth(t, Exact::weigh(t, Exact::ray(camera, x, y)));
                const double step = (z - p.z + margin) * per_tau;
                const double e = exp(-fabs(step)), part = 1.0 / (1.0 + e);
                seen = step >= 0.0 ? part : e * part;
                slope = -(e * part) * part * per_tau;
                pixel = y * width + x;
            }
        }
        visibility[at] = (float)seen;
        if (slopes) {
            slopes[at] = (float)slope;
            pixels[at] = pixel;
        }
    };

    auto show = [&](int b, long long i, int id) {
        double z = __longlong_as_double(0x7ff0000000000000ll), wa = 0.0, wb = 0.0, wc = 0.0;
        if (id >= 0 && (depth || barycentrics)) {
            const Triangle t = Exact::triangle(camera, vertices + b * vertices_step, faces, id);
            const Weights w = Exact::weigh(t, Exact::ray(camera, (int)(i % width), (int)(i / width)));
            z = Exact::depth(t, w);
            if (barycentrics) {
                wa = w.a / w.sum;
                wb = w.b / w.sum;
                wc = w.c / w.sum;
            }
        }
        if (depth) depth[b * plane + i] = (float)z;
        if (face_ids) face_ids[b * plane + i] = id;
        if (barycentrics) {
            float* out = barycentrics + 3 * (b * plane + i);
            out[0] = (float)wa;
            out[1] = (float)wb;
            out[2] = (float)wc;
        }
    };

    const bool pictures = depth || face_ids || barycentrics;
    const int point_tasks = (n_points + BLOCK - 1) / BLOCK;
    const long long scored = (long long)batch * point_tasks;
    const int task_pixels = BLOCK * pixels_a_thread;
    const long long pixel_tasks = pictures ? (plane + task_pixels - 1) / task_pixels : 0;
    int entry = -1;
    for (long long task = block_index; task < scored + batch * pixel_tasks; task += gridDim.x) {
        const bool scores = task < scored;
        const long long tasks = scores ? point_tasks : pixel_tasks, place = scores ? task : task - scored;
        const int b = (int)(place / tasks);
        const long long first = (place - b * tasks) * (scores ? BLOCK : task_pixels) + threadIdx.x;
        int ids[MAX_PIXELS];
#pragma unroll
        for (int k = 0; k < MAX_PIXELS; k++) {
            const long long i = first + k * BLOCK;
            ids[k] = !scores && k < pixels_a_thread && i < plane ? (int)(unsigned)keys[b * plane + i] : -1;
        }
        if (b != entry) {
            __syncthreads();  // nobody reads the last camera any more
            read_camera(camera, b, threadIdx.x);
            __syncthreads();
            entry = b;
        }
        if (scores) {
            if (first < n_points) score(b, (int)first);
        } else {
#pragma unroll 1
            for (int k = 0; k < pixels_a_thread; k++) {
                const long long i = first + k * BLOCK;
                if (i < plane) show(b, i, ids[0]);
#pragma unroll
                for (int j = 1; j < MAX_PIXELS; j++) ids[j - 1] = ids[j];  // so that they stay in registers
            }
        }
    }
}

// Gradients of the scores by points and by the corners of the faces in view: the adjoint of `cuda_depth_resolve`.
//
// Along a ray d = (u, v, 1), a plane with normal n through a corner that moves by e with weight w comes nearer or goes
// farther by w (n e) / (n d). Many points pull at one vertex, and floats added by atomics would round differently each
// time. Whole numbers do not: `pull` runs twice, one thread per point, first for the largest of all numbers that are to
// be added, a block each, then to add multiples of 2^-shift of it in 64 bits, where 2^shift leaves just enough room for
// their sum: for 10^4 points each is off by 2^-47 of the largest. `settle`, one thread per vertex, turns sums into
// floats.
__global__ void pull(
#include "mesh_parameters.inc"
    int n_vertices,
    int n_points,
    const int* face_ids,           // [batch][height][width]
    const float* grad_visibility,  // [batch][n_points]
    const float* slopes,           // [batch][n_points]
    const int* pixels,             // [batch][n_points]
    float* grad_points,            // [batch][n_points][3], or 0
    int adds,                      // 0 in the first run, 1 in the second
    unsigned long long* peaks,     // [blocks]: bits of doubles
    long long* shift,              // of the sums
    long long* sums                // [batch][n_vertices][4]: three axes, and not 0 where one was no number; or 0
) {
#include "camera_cuda.h"
#include "exact_cuda.h"
    typedef unsigned long long Bits;
    __shared__ Camera camera;
    __shared__ Bits highest[BLOCK / 32];
    const unsigned all = 0xffffffffu;
    const long long step = (long long)gridDim.x * BLOCK;
    const long long thread_index = (long long)block_index * BLOCK + threadIdx.x;
    // The largest over the block, in all of its threads. Bits of doubles that are not negative have their order.
    auto largest_of_block = [&](Bits mine) -> Bits {
        for (int offset = 16; offset > 0; offset >>= 1) {
            const Bits other = __shfl_xor_sync(all, mine, offset);
            mine = other > mine ? other : mine;
        }
        if ((threadIdx.x & 31) == 0) highest[threadIdx.x >> 5] = mine;
        __syncthreads();
        for (int k = 0; k < BLOCK / 32; k++) mine = highest[k] > mine ? highest[k] : mine;
        return mine;
    };

    int exponent = 0;
    Bits peak = 0;
    if (adds) {
        for (int k = threadIdx.x; k < (int)gridDim.x; k += BLOCK) peak = peaks[k] > peak ? peaks[k] : peak;
        peak = largest_of_block(peak);
        // Sums of 3 n_points numbers below 2^(e + 1) must stay below 2^62.
        const int e = peak ? ilogb(__longlong_as_double((long long)peak)) : 0;
        exponent = 61 - e - (64 - __clzll(3ll * n_points));
        if (thread_index == 0) *shift = exponent;
        peak = 0;
    } else if (sums) {
        for (long long i = thread_index; i < 4ll * batch * n_vertices; i += step) sums[i] = 0;
    }

    auto pull = [&](int b, int i) {
        const long long at = (long long)b * n_points + i;
        const int pixel = pixels[at];
        const double along = (double)grad_visibility[at] * (double)slopes[at];
        if (!adds && grad_points)
            for (int axis = 0; axis < 3; axis++) grad_points[3 * at + axis] = (float)(along * camera.view[8 + axis]);
        if (pixel < 0 || !sums) return;
        const int f = face_ids[(long long)b * width * height + pixel];
        const Triangle t = Exact::triangle(camera, vertices + b * vertices_step, faces, f);
        const Ray ray = Exact::ray(camera, pixel % width, pixel / width);
        const Weights w = Exact::weigh(t, ray);
        const double ex = t.b.x - t.a.x, ey = t.b.y - t.a.y, ez = t.b.z - t.a.z;
        const double gx = t.c.x - t.a.x, gy = t.c.y - t.a.y, gz = t.c.z - t.a.z;
        const double nx = ey * gz - ez * gy, ny = ez * gx - ex * gz, nz = ex * gy - ey * gx;
        // The buffer's depth acts as the point's, with the other sign.
        const double share = -along / ((nx * ray.u + ny * ray.v + nz) * w.sum), weights[3] = {w.a, w.b, w.c};
        for (int axis = 0; axis < 3; axis++) {
            const double* r = camera.view + axis;
            const double world = share * (r[0] * nx + r[4] * ny + r[8] * nz);
            for (int k = 0; k < 3; k++) {
                const double number = weights[k] * world;
                const bool finite = fabs(number) <= 1.7976931348623157e308;
                if (adds) {
                    long long* sum = sums + 4 * ((long long)b * n_vertices + faces[3ll * f + k]);
                    if (finite)
                        atomicAdd((Bits*)sum + axis, (Bits)__double2ll_rn(scalbn(number, exponent)));
                    else
                        sum[3] = 1;
                } else if (finite) {
                    const Bits bits = (Bits)__double_as_longlong(fabs(number));
                    peak = bits > peak ? bits : peak;
                }
            }
        }
    };
    const int tasks = (n_points + BLOCK - 1) / BLOCK;
    int entry = -1;
    for (long long task = block_index; task < (long long)batch * tasks; task += gridDim.x) {
        const int b = (int)(task / tasks), i = (int)(task % tasks) * BLOCK + threadIdx.x;
        if (b != entry) {
            __syncthreads();  // nobody reads the last camera any more
            read_camera(camera, b, threadIdx.x);
            __syncthreads();
            entry = b;
        }
        if (i < n_points) pull(b, i);
    }
    if (!adds && sums) {
        __syncthreads();
        peak = largest_of_block(peak);
        if (threadIdx.x == 0) peaks[block_index] = peak;
    }
}

__global__ void settle(
    const long long* sums,   // [batch][n_vertices][4]: three axes, and not 0 where one was no number; or 0
    const long long* shift,  // of the sums
    long long n,             // vertices of all batch entries
    float* grad_vertices     // [n][3]
) {
    const long long step = (long long)gridDim.x * BLOCK;
    for (long long i = (long long)block_index * BLOCK + threadIdx.x; i < n; i += step)
        for (int axis = 0; axis < 3; axis++)
            grad_vertices[3 * i + axis] =
                sums[4 * i + 3] ? __int_as_float(0x7fc00000) : (float)scalbn((double)sums[4 * i + axis], -(int)*shift);
}
