// Scores of points against a drawn depth buffer, and the gradient of the vertices: see `depth_buffer_vectors`.

void score(unsigned long long address) {
#pragma clang fp contract(off)
#include "vectors.h"
    typedef int I __attribute__((ext_vector_type(8)));
    typedef int I8U __attribute__((ext_vector_type(8), aligned(4)));
    const int ranges = (job.n_points + POINTS_PER_TASK - 1) / POINTS_PER_TASK;
    const int* vertex_of = (const int*)job.point_vertices;
    const double per_tau = 1.0 / job.tau;
    // e^-x for x >= 0: 2^-n with n the whole number nearest to x / ln 2, times the series of the rest, |r| < 0.35.
    auto falloff = [](D x) -> D {
        x = x < 700.0 ? x : (D)(700.0);
        const D magic = (D)(6755399441055744.0);
        const D whole = x * 1.4426950408889634 + magic;
        const D n = whole - magic;
        const D r = (n * 0.6931471803691238 - x) + n * 1.9082149292705877e-10;
        D p = r * (1.0 / 6227020800) + 1.0 / 479001600;
        p = p * r + 1.0 / 39916800;
        p = p * r + 1.0 / 3628800;
        p = p * r + 1.0 / 362880;
        p = p * r + 1.0 / 40320;
        p = p * r + 1.0 / 5040;
        p = p * r + 1.0 / 720;
        p = p * r + 1.0 / 120;
        p = p * r + 1.0 / 24;
        p = p * r + 1.0 / 6;
        p = p * r + 0.5;
        p = p * r + 1.0;
        p = p * r + 1.0;
        const L exponent = 1023 - (__builtin_bit_cast(L, whole) - __builtin_bit_cast(L, magic));
        return p * __builtin_bit_cast(D, exponent << 52);
    };
    int found = 0;
    for (;;) {
        const int task = __atomic_fetch_add(&job.next_score, 1, __ATOMIC_RELAXED);
        if (task >= job.batch * ranges) break;
        const int b = task / ranges, first = task % ranges * POINTS_PER_TASK;
        const int end = wp::min(first + POINTS_PER_TASK, job.n_points);
        const View view = view_of(b);
        const T* points = (const T*)job.points + b * job.points_step;
        const double* camera = (const double*)job.camera_vertices + 4ll * b * job.n_vertices;
        const int* ids = (const int*)job.face_ids + (long long)b * height * width;
        T* visibility = (T*)job.visibility + (long long)b * job.n_points;
        T* slopes = job.slopes ? (T*)job.slopes + (long long)b * job.n_points : nullptr;
        int* pixels = job.pixels ? (int*)job.pixels + (long long)b * job.n_points : nullptr;
        L bad = (L)(0);

        auto shows = [&](int x, int y, int vertex) -> bool {
            const int* f = faces + 3ll * ids[(long long)y * width + x];
            return ids[(long long)y * width + x] >= 0 && (f[0] == vertex || f[1] == vertex || f[2] == vertex);
        };
        auto shows_near = [&](int x, int y, int vertex) -> bool {
            if (shows(x, y, vertex)) return true;
            const int x0 = wp::max(x - 1, 0), x1 = wp::min(x + 1, width - 1);
            const int y0 = wp::max(y - 1, 0), y1 = wp::min(y + 1, height - 1);
            for (int v = y0; v <= y1; v++)
                for (int u = x0; u <= x1; u++)
                    if (shows(u, v, vertex)) return true;
            return false;
        };

        for (int i = first; i < end; i += 8) {
            const int n = wp::min(end - i, 8);
            D px, py, pz;
            load3(points + 3ll * i, n, px, py, pz);
            bad |= ~(absolute(px) + absolute(py) + absolute(pz) <= 1e15);
            const D X = in_camera(view, 0, px, py, pz), Y = in_camera(view, 1, px, py, pz);
            const D Z = in_camera(view, 2, px, py, pz);
            const D divisor = Z > near_plane ? Z : (D)(1.0);
            const D u = view.fx * X / divisor + view.cx, v = view.fy * Y / divisor + view.cy;
            const L inside = (Z > near_plane) & (u >= 0.0) & (v >= 0.0) & (u < (double)width) & (v < (double)height);
            const I x = __builtin_convertvector(inside ? u : (D)(0.0), I);
            const I y = __builtin_convertvector(inside ? v : (D)(0.0), I);
            const I pixel = y * width + x;
            I id;
            for (int k = 0; k < 8; k++) id[k] = ids[pixel[k]];
            L seen = inside & __builtin_convertvector(id < 0, L);
            if (job.identity) {
                I known = (I)(0);
                for (int k = 0; k < n; k++) {
                    const int vertex = vertex_of[i + k];
                    known[k] = vertex >= 0 && shows_near(x[k], y[k], vertex) ? -1 : 0;
                }
                seen |= inside & __builtin_convertvector(known, L);
            }
            const L soft = inside & ~seen;
            D p = seen ? (D)(1.0) : (D)(0.0), slope = (D)(0.0);
            if (bits8(soft)) {
                int chosen[8];
                *(I8U*)chosen = id < 0 ? (I)(0) : id;
                const Corner a = gather(camera, chosen, 0), b = gather(camera, chosen, 1);
                const Corner c = gather(camera, chosen, 2);
                const Weights w = weigh(
                    a, b, c, view.u0 + __builtin_convertvector(x, D) * view.du,
                    view.v0 + __builtin_convertvector(y, D) * view.dv
                );
                const D t = (depth_of(w, a.z, b.z, c.z) - Z + job.margin) * per_tau;
                const D e = falloff(absolute(t));
                const D part = 1.0 / (1.0 + e);
                p = soft ? (t >= 0.0 ? part : e * part) : p;
                slope = soft ? -(e * part) * part * per_tau : slope;
            }
            const I at = __builtin_convertvector(soft, I) ? pixel : (I)(-1);
            if (n == 8) {
                *(T8U*)(visibility + i) = __builtin_convertvector(p, T8);
                if (slopes) *(T8U*)(slopes + i) = __builtin_convertvector(slope, T8);
                if (slopes) *(I8U*)(pixels + i) = at;
            } else
                for (int k = 0; k < n; k++) {
                    visibility[i + k] = (T)p[k];
                    if (slopes) slopes[i + k] = (T)slope[k];
                    if (slopes) pixels[i + k] = at[k];
                }
            if (vertex_of)
                for (int k = 0; k < n; k++) {
                    if (vertex_of[i + k] < -1 || vertex_of[i + k] >= job.n_vertices) found = 1;
                }
        }
        if (bits8(bad)) found = 1;
    }
    if (found) __atomic_store_n(&job.found, 1, __ATOMIC_RELAXED);
}

void pull(unsigned long long address) {
#pragma clang fp contract(off)
#include "vectors.h"
    typedef int I __attribute__((ext_vector_type(8)));
    typedef int I8U __attribute__((ext_vector_type(8), aligned(4)));
    for (;;) {
        const int b = __atomic_fetch_add(&job.next_pull, 1, __ATOMIC_RELAXED);
        if (b >= job.batch) break;
        const View view = view_of(b);
        const double* camera = (const double*)job.camera_vertices + 4ll * b * job.n_vertices;
        const int* ids = (const int*)job.face_ids + (long long)b * height * width;
        const T* grads = (const T*)job.grad_visibility + (long long)b * job.n_points;
        const T* slopes = (const T*)job.slopes + (long long)b * job.n_points;
        const int* pixels = (const int*)job.pixels + (long long)b * job.n_points;
        double* sums = (double*)job.sums + 3ll * b * job.n_vertices;
        memset(sums, 0, 3ll * job.n_vertices * sizeof(double));
        for (int i = 0; i < job.n_points; i += 8) {
            const int n = wp::min(job.n_points - i, 8);
            I pixel = (I)(-1);
            D pull = (D)(0.0);
            for (int k = 0; k < n; k++) {
                pixel[k] = pixels[i + k];
                // The buffer's depth acts as the point's, with the other sign.
                pull[k] = -(double)grads[i + k] * (double)slopes[i + k];
            }
            const I soft = pixel >= 0;
            if (!bits8(__builtin_convertvector(soft, L))) continue;
            const I at = soft ? pixel : (I)(0);
            int chosen[8];
            for (int k = 0; k < 8; k++) chosen[k] = pixel[k] < 0 ? 0 : ids[at[k]];
            const I y = at / width, x = at - y * width;
            const D u = view.u0 + __builtin_convertvector(x, D) * view.du;
            const D v = view.v0 + __builtin_convertvector(y, D) * view.dv;
            const Corner p = gather(camera, chosen, 0), q = gather(camera, chosen, 1), r = gather(camera, chosen, 2);
            const Weights w = weigh(p, q, r, u, v);
            const D ex = q.x - p.x, ey = q.y - p.y, ez = q.z - p.z, fx = r.x - p.x, fy = r.y - p.y, fz = r.z - p.z;
            const D nx = ey * fz - ez * fy, ny = ez * fx - ex * fz, nz = ex * fy - ey * fx;
            const D along = pull / ((nx * u + ny * v + nz) * w.sum);
            const D gx = along * (view.r[0] * nx + view.r[4] * ny + view.r[8] * nz);
            const D gy = along * (view.r[1] * nx + view.r[5] * ny + view.r[9] * nz);
            const D gz = along * (view.r[2] * nx + view.r[6] * ny + view.r[10] * nz);
            const D weight[3] = {w.a, w.b, w.c};
            for (int k = 0; k < n; k++) {
                if (pixel[k] < 0) continue;
                for (int j = 0; j < 3; j++) {
                    double* to = sums + 3ll * faces[3ll * chosen[k] + j];
                    to[0] += weight[j][k] * gx[k];
                    to[1] += weight[j][k] * gy[k];
                    to[2] += weight[j][k] * gz[k];
                }
            }
        }
        T* grad_vertices = (T*)job.grad_vertices + 3ll * b * job.n_vertices;
        for (long long i = 0; i < 3ll * job.n_vertices; i++) grad_vertices[i] = (T)sums[i];
    }
}
