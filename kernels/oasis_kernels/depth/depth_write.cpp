// Writing the drawn buffers out as pictures, the buffers of several parts merged.

void write(unsigned long long address) {
#pragma clang fp contract(off)
#include "vectors.h"
#include "buffer.h"
    typedef T T16 __attribute__((ext_vector_type(16)));
    typedef T T16U __attribute__((ext_vector_type(16), aligned(sizeof(T))));
    typedef T T8U __attribute__((ext_vector_type(8), aligned(sizeof(T))));
    typedef int I8 __attribute__((ext_vector_type(8)));
    typedef int I8U __attribute__((ext_vector_type(8), aligned(4)));
    const int tasks = (quads + QUADS_PER_TASK - 1) / QUADS_PER_TASK;
    const I8 index8 = {0, 1, 2, 3, 4, 5, 6, 7};
    for (;;) {
        const int task = __atomic_fetch_add(&job.next_write, 1, __ATOMIC_RELAXED);
        if (task >= job.batch * tasks) break;
        const int entry = task / tasks, first = task % tasks * QUADS_PER_TASK;
        const Scene scene = {view_of(entry), (const double*)job.camera_vertices + 4ll * entry * job.n_vertices};
        const View& view = scene.view;
        T* depth = (T*)job.depth + (long long)entry * height * width;
        int* face_ids = (int*)job.face_ids + (long long)entry * height * width;
        T* barycentrics = job.barycentrics ? (T*)job.barycentrics + 3ll * entry * height * width : nullptr;
        float* inverses = planes(entry, 0);
        int* ids = (int*)(inverses + plane);

        // Enter the pixels of another part at the 16 places from i.
        auto merge = [&](const float* other_inverses, const int* other_ids, long long i, int x, int y) {
            const F mine = *(const FU*)(inverses + i), other = *(const FU*)(other_inverses + i);
            const F apart = other - mine, doubt = other * DOUBT;
            const I won = apart > doubt;
            *(FU*)(inverses + i) = won ? other : mine;
            *(IU*)(ids + i) = won ? (I) * (const IU*)(other_ids + i) : (I) * (const IU*)(ids + i);
            unsigned open = bits((other > 0.f) & (apart >= -doubt) & (apart <= doubt));
            for (; open; open &= open - 1) {
                const int k = __builtin_ctz(open), u = x + k / 4, v = y + k % 4;
                if (u >= width || v >= height) continue;
                const int f = other_ids[i + k];
                contest(scene, inverses, ids, i + k, f, u, v, exact(scene, f, u, v)[0], other_inverses[i + k]);
            }
        };
        // Depths and barycentrics in float64 of up to eight pixels from (x, y), of which `n` exist.
        auto write_exactly = [&](int x, int y, int n, I8 id) {
            const long long i = (long long)y * width + x;
            const L covered = __builtin_convertvector((id >= 0) & (index8 < n), L);
            D z = (D)(__builtin_inf()), wa = (D)(0.0), wb = wa, wc = wa;
            if (bits8(covered)) {
                int chosen[8];
                *(I8U*)chosen = id < 0 ? (I8)(0) : id;
                const Corner p = gather(scene.camera, chosen, 0), q = gather(scene.camera, chosen, 1);
                const Corner r = gather(scene.camera, chosen, 2);
                const D u = view.u0 + (eight + (double)x) * view.du, v = (D)(view.v0 + (double)y * view.dv);
                const Weights w = weigh(p, q, r, u, v);
                z = covered ? depth_of(w, p.z, q.z, r.z) : z;
                wa = covered ? w.a / w.sum : wa;
                wb = covered ? w.b / w.sum : wb;
                wc = covered ? w.c / w.sum : wc;
            }
            T spare[32];
            T* depth_out = n == 8 ? depth + i : spare;
            *(T8U*)depth_out = __builtin_convertvector(z, T8);
            if (n < 8) memcpy(depth + i, spare, n * sizeof(T));
            if (!barycentrics) return;
            T* out = n == 8 ? barycentrics + 3 * i : spare;
            const T8 a = __builtin_convertvector(wa, T8), b = __builtin_convertvector(wb, T8);
            const T8 c = __builtin_convertvector(wc, T8);
            *(T8U*)out = __builtin_shufflevector(
                __builtin_shufflevector(a, b, 0, 8, -1, 1, 9, -1, 2, 10), c, 0, 1, 8, 3, 4, 9, 6, 7
            );
            *(T8U*)(out + 8) = __builtin_shufflevector(
                __builtin_shufflevector(a, b, -1, 3, 11, -1, 4, 12, -1, 5), c, 10, 1, 2, 11, 4, 5, 12, 7
            );
            *(T8U*)(out + 16) = __builtin_shufflevector(
                __builtin_shufflevector(a, b, 13, -1, 6, 14, -1, 7, 15, -1), c, 0, 13, 2, 3, 14, 5, 6, 15
            );
            if (n < 8) memcpy(barycentrics + 3 * i, spare, 3 * n * sizeof(T));
        };
        auto write_row = [&](int x, int y, F inverse, I id) {
            if (y >= height) return;
            const long long i = (long long)y * width + x;
            const I hit = inverse > 0.f;
            const F z = hit ? 1.f / inverse : (F)(__builtin_inff());
            const I shown = hit ? id : (I)(-1);
            const int n = wp::min(width - x, 16);
            if (n == 16) {
                *(T16U*)(depth + i) = __builtin_convertvector(z, T16);
                *(IU*)(face_ids + i) = shown;
            } else
                for (int k = 0; k < n; k++) {
                    depth[i + k] = (T)z[k];
                    face_ids[i + k] = shown[k];
                }
            if (!barycentrics && sizeof(T) == 4) return;
            write_exactly(x, y, wp::min(n, 8), shown.lo);
            if (n > 8) write_exactly(x + 8, y, n - 8, shown.hi);
        };

        const int end = wp::min(first + QUADS_PER_TASK, quads);
        for (int quad = first; quad < end; quad++)
            for (int x = 0; x < width; x += 16) {
                const long long i = (long long)quad * stride + 4 * x;
                for (int part = 1; part < job.parts; part++) {
                    const float* other = planes(entry, part);
                    for (int k = 0; k < 4; k++)
                        merge(other, (const int*)(other + plane), i + 16 * k, x + 4 * k, 4 * quad);
                }
                F p[4];
                I s[4];
                for (int k = 0; k < 4; k++) {
                    p[k] = *(const FU*)(inverses + i + 16 * k);
                    s[k] = *(const IU*)(ids + i + 16 * k);
                }
                const F p01 = COLUMNS(p[0], p[1], 0), p23 = COLUMNS(p[2], p[3], 0);
                const F q01 = COLUMNS(p[0], p[1], 2), q23 = COLUMNS(p[2], p[3], 2);
                const I s01 = COLUMNS(s[0], s[1], 0), s23 = COLUMNS(s[2], s[3], 0);
                const I t01 = COLUMNS(s[0], s[1], 2), t23 = COLUMNS(s[2], s[3], 2);
                write_row(x, 4 * quad, HALVES(p01, p23, 0), HALVES(s01, s23, 0));
                write_row(x, 4 * quad + 1, HALVES(p01, p23, 8), HALVES(s01, s23, 8));
                write_row(x, 4 * quad + 2, HALVES(q01, q23, 0), HALVES(t01, t23, 0));
                write_row(x, 4 * quad + 3, HALVES(q01, q23, 8), HALVES(t01, t23, 8));
            }
    }
}
