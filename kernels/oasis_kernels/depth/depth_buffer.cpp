// The depth buffer on the CPU: what `depth_buffer` computes, 8 or 16 numbers at a time, to the same face ids.
//
// `transform` (a task is a range of vertices) -> `draw` (a part of the faces, into a buffer of its own) -> `write`
// (rows of the buffers, merged) -> `score` (a range of points). Each is launched once a thread, and the threads take
// tasks off a counter of the call until none is left. Backwards, `pull` (a batch entry) gives the corners of the faces
// their gradient.
//
// Drawing is a filter. Faces are set up 16 at a time in float32, from corners in fixed point on the screen (2^-21 px
// for pictures up to 512 px) and their inverse depths, and then tested against blocks of 4 x 4 pixels: one vector for
// each edge function, one for the inverse depth, which is linear on the screen. Each carries a bound of its error, and
// where a bound leaves open whether a face contains a pixel's centre, or which of two faces is in front, that one pixel
// is decided by the float64 arithmetic of `depth_buffer`: same expressions, same order, no fused multiply-add. So the
// filter costs no exactness and opens no seam: which face a pixel shows depends neither on the vectors' width, nor on
// the threads, nor on whether the processor fuses. What a filter cannot serve (triangles through the near plane, far
// outside the picture, or too thin for its bounds) is drawn in float64, 8 pixels at a time.
//
// A buffer is kept in blocks: pixel (x, y) at (y / 4) * stride + 4 x + y % 4, so that the 4 x 4 pixels at any column
// are one unaligned load.

void transform(unsigned long long address) {
#pragma clang fp contract(off)
#include "vectors.h"
#include "marks.h"
    typedef int I __attribute__((ext_vector_type(8)));
    typedef float F __attribute__((ext_vector_type(8)));
    typedef int I4 __attribute__((ext_vector_type(4)));
    typedef int I4U __attribute__((ext_vector_type(4), aligned(4)));
    const int ranges = wp::max((job.n_vertices + VERTICES_PER_TASK - 1) / VERTICES_PER_TASK, 1);
    const double units = (double)(1 << job.fraction_bits);
    const double reach = (double)(1 << 30) / units;  // of fixed point round the picture's middle [px]
    const double middle_x = width / 2, middle_y = height / 2;
    const D round = (D)(6755399441055744.0);  // 1.5 * 2^52: adding it leaves an integer's low bits
    int found = 0;
    for (;;) {
        const int task = __atomic_fetch_add(&job.next_transform, 1, __ATOMIC_RELAXED);
        if (task >= job.batch * ranges) break;
        const int b = task / ranges, first = task % ranges * VERTICES_PER_TASK;
        const int end = wp::min(first + VERTICES_PER_TASK, job.n_vertices);
        const View view = view_of(b);
        found |= view.bad;
        const T* vertices = (const T*)job.vertices + b * job.vertices_step;
        double* camera = (double*)job.camera_vertices + 4ll * b * job.n_vertices;
        int* screen = (int*)job.screen_vertices + 4ll * b * job.n_vertices;
        L bad = (L)(0);
        for (int i = first; i < end; i += 8) {
            const int n = wp::min(end - i, 8);
            D x, y, z;
            load3(vertices + 3ll * i, n, x, y, z);
            bad |= ~(absolute(x) + absolute(y) + absolute(z) <= 1e15);
            const D X = in_camera(view, 0, x, y, z), Y = in_camera(view, 1, x, y, z), Z = in_camera(view, 2, x, y, z);
            const L finite = absolute(X) + absolute(Y) + absolute(Z) < 1e100;
            const L before = finite & (Z > near_plane);
            const D inverse = 1.0 / (before ? Z : (D)(1.0));
            const D u = view.fx * X * inverse + view.cx, v = view.fy * Y * inverse + view.cy;
            const D from_x = u - middle_x, from_y = v - middle_y;
            // Depths that float32 cannot invert, and those a rounding away from the near plane, are odd as well.
            const L placed = finite & (~before | (absolute(u) + absolute(v) < 1e100));
            const L even = (absolute(from_x) < reach) & (absolute(from_y) < reach) & (inverse < 1e30) &
                           (inverse > 1e-30) & (Z > near_plane * (1 + 1e-9));
            const L marks = (finite & ~before & (L)(BEHIND)) | (~placed & (L)(LOST)) | (before & ~even & (L)(ODD)) |
                            (before & (((u < 0.0) & (L)(LEFT)) | ((u > (double)width) & (L)(RIGHT)) |
                                       ((v < 0.0) & (L)(ABOVE)) | ((v > (double)height) & (L)(BELOW))));
            const L kept = before & even;
            const D fixed_x = (kept ? from_x * units : (D)(0.0)) + round;
            const D fixed_y = (kept ? from_y * units : (D)(0.0)) + round;
            const I sx = __builtin_convertvector(__builtin_bit_cast(L, fixed_x), I);
            const I sy = __builtin_convertvector(__builtin_bit_cast(L, fixed_y), I);
            const I sw = __builtin_bit_cast(I, __builtin_convertvector(kept ? inverse : (D)(1.0), F));
            const I sm = __builtin_convertvector(marks, I);
            const D zero = (D)(0.0);
            const D xy0 = __builtin_shufflevector(X, Y, 0, 8, 1, 9, 2, 10, 3, 11);
            const D xy1 = __builtin_shufflevector(X, Y, 4, 12, 5, 13, 6, 14, 7, 15);
            const D z0 = __builtin_shufflevector(Z, zero, 0, 8, 1, 9, 2, 10, 3, 11);
            const D z1 = __builtin_shufflevector(Z, zero, 4, 12, 5, 13, 6, 14, 7, 15);
            const I p0 = __builtin_shufflevector(sx, sy, 0, 8, 1, 9, 2, 10, 3, 11);
            const I p1 = __builtin_shufflevector(sx, sy, 4, 12, 5, 13, 6, 14, 7, 15);
            const I q0 = __builtin_shufflevector(sw, sm, 0, 8, 1, 9, 2, 10, 3, 11);
            const I q1 = __builtin_shufflevector(sw, sm, 4, 12, 5, 13, 6, 14, 7, 15);
            double rows[32];
            int places[32];
            double* camera_out = n == 8 ? camera + 4ll * i : rows;
            int* screen_out = n == 8 ? screen + 4ll * i : places;
#define ROW(k, xy, z, p, q)                                                                                     \
    *(D4U*)(camera_out + 4 * (k)) =                                                                             \
        __builtin_shufflevector(xy, z, 2 * ((k) % 4), 2 * ((k) % 4) + 1, 8 + 2 * ((k) % 4), 9 + 2 * ((k) % 4)); \
    *(I4U*)(screen_out + 4 * (k)) =                                                                             \
        __builtin_shufflevector(p, q, 2 * ((k) % 4), 2 * ((k) % 4) + 1, 8 + 2 * ((k) % 4), 9 + 2 * ((k) % 4));
            ROW(0, xy0, z0, p0, q0)
            ROW(1, xy0, z0, p0, q0)
            ROW(2, xy0, z0, p0, q0)
            ROW(3, xy0, z0, p0, q0)
            ROW(4, xy1, z1, p1, q1)
            ROW(5, xy1, z1, p1, q1)
            ROW(6, xy1, z1, p1, q1)
            ROW(7, xy1, z1, p1, q1)
#undef ROW
            if (n < 8) {
                for (int k = 0; k < 4 * n; k++) {
                    camera[4ll * i + k] = rows[k];
                    screen[4ll * i + k] = places[k];
                }
            }
        }
        if (bits8(bad)) found = 1;
    }
    if (found) __atomic_store_n(&job.found, 1, __ATOMIC_RELAXED);
}

void draw(unsigned long long address) {
#pragma clang fp contract(off)
#include "vectors.h"
#include "marks.h"
#include "buffer.h"
    typedef int I4 __attribute__((ext_vector_type(4)));
    typedef int I8 __attribute__((ext_vector_type(8)));
    typedef int I4U __attribute__((ext_vector_type(4), aligned(4)));
    // Not the builtins: those care for NaN, at twice the instructions.
    auto lower = [](auto a, auto b) { return a < b ? a : b; };
    auto upper = [](auto a, auto b) { return a > b ? a : b; };
    auto size_of = [](F a) -> F { return __builtin_elementwise_abs(a); };
#if defined(__FMA__) || defined(__aarch64__)
    auto fma = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
#else
    auto fma = [](F a, F b, F c) -> F { return a * b + c; };
#endif
// A choice between new and old is compiled to a masked store. Those of AVX2 take many times as long as plain ones
// on some processors; a volatile one stays plain.
#if defined(__AVX512F__)
    typedef FU FOut;
    typedef IU IOut;
#else
    typedef volatile FU FOut;
    typedef volatile IU IOut;
#endif
    const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const F column = __builtin_convertvector(lane / 4, F), row = __builtin_convertvector(lane % 4, F);
    const int shift = job.fraction_bits, unit = 1 << shift;
    const float pixel = 1.f / (float)unit;
    // The centre of column x is at x unit + centre_x in fixed point.
    const int centre_x = unit / 2 - width / 2 * unit, centre_y = unit / 2 - height / 2 * unit;

    // Corner j of the 16 faces from `first`, those past the last being the last.
    struct Place {
        I x, y, inverse, marks;
    };
    auto place = [&](const int* screen, int first, int j) -> Place {
        I4 r[16];
        for (int k = 0; k < 16; k++) {
            const int f = wp::min(first + k, job.n_faces - 1);
            r[k] = *(const I4U*)(screen + 4ll * faces[3ll * f + j]);
        }
        I quad[4];
        for (int k = 0; k < 4; k++) {
            const I8 a = __builtin_shufflevector(r[4 * k], r[4 * k + 1], 0, 1, 2, 3, 4, 5, 6, 7);
            const I8 b = __builtin_shufflevector(r[4 * k + 2], r[4 * k + 3], 0, 1, 2, 3, 4, 5, 6, 7);
            quad[k] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        }
        const I xy0 = COLUMNS(quad[0], quad[1], 0), xy1 = COLUMNS(quad[2], quad[3], 0);
        const I wm0 = COLUMNS(quad[0], quad[1], 2), wm1 = COLUMNS(quad[2], quad[3], 2);
        return {HALVES(xy0, xy1, 0), HALVES(xy0, xy1, 8), HALVES(wm0, wm1, 0), HALVES(wm0, wm1, 8)};
    };
    // Columns or rows whose centre may lie between the fixed-point numbers `low` and `high`: each is half a unit off.
    auto first_of = [&](I low, int centre) -> I { return upper((low - 1 - centre + (unit - 1)) >> shift, (I)(0)); };
    auto last_of = [&](I high, int centre, int size) -> I {
        return lower((high + 1 - centre) >> shift, (I)(size - 1));
    };

    for (;;) {
        const int task = __atomic_fetch_add(&job.next_draw, 1, __ATOMIC_RELAXED);
        if (task >= job.batch * job.parts) break;
        const int entry = task / job.parts, part = task % job.parts;
        const Scene scene = {view_of(entry), (const double*)job.camera_vertices + 4ll * entry * job.n_vertices};
        const View& view = scene.view;
        const int* screen = (const int*)job.screen_vertices + 4ll * entry * job.n_vertices;
        float* inverses = planes(entry, part);
        int* ids = (int*)(inverses + plane);
        memset(inverses, 0, plane * sizeof(float));

        auto draw_exactly = [&](int f) __attribute__((noinline)) {
            double low_x = 1e300, low_y = 1e300, high_x = -1e300, high_y = -1e300;
            auto reach = [&](double x, double y, double z) {
                const double u = view.fx * x / z + view.cx, v = view.fy * y / z + view.cy;
                low_x = wp::min(low_x, u);
                high_x = wp::max(high_x, u);
                low_y = wp::min(low_y, v);
                high_y = wp::max(high_y, v);
            };
            // The box of what lies beyond the near plane: of the corners there, and of where edges pass through it.
            for (int j = 0; j < 3; j++) {
                const double* p = scene.camera + 4ll * faces[3ll * f + j];
                const double* q = scene.camera + 4ll * faces[3ll * f + (j + 1) % 3];
                if (p[2] > near_plane) reach(p[0], p[1], p[2]);
                if ((p[2] > near_plane) != (q[2] > near_plane)) {
                    const double t = (near_plane - p[2]) / (q[2] - p[2]);
                    reach(p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1]), near_plane);
                }
            }
            // Rounding of the box never decides about a pixel on an edge.
            const double slack_x = 1e-3 + 1e-9 * (wp::abs(low_x) + wp::abs(high_x));
            const double slack_y = 1e-3 + 1e-9 * (wp::abs(low_y) + wp::abs(high_y));
            // Clamped as doubles, because the conversion of a huge one to an integer is undefined; where overflow has
            // left NaN, to the whole picture.
            auto first_from = [](double v, int size) -> int { return v > 0.0 ? (int)(v < size ? v : size) : 0; };
            auto last_from = [](double v, int size) -> int {
                return v < size - 1 ? (int)(v > -1.0 ? v : -1.0) : size - 1;
            };
            const int x0 = first_from(__builtin_ceil(low_x - slack_x - 0.5), width);
            const int x1 = last_from(__builtin_floor(high_x + slack_x - 0.5), width);
            const int y0 = first_from(__builtin_ceil(low_y - slack_y - 0.5), height);
            const int y1 = last_from(__builtin_floor(high_y + slack_y - 0.5), height);
            for (int y = y0; y <= y1; y++)
                for (int x = x0; x <= x1; x += 8) {
                    const D z = exact(scene, f, x, y);
                    for (int hit = bits8(z > 0.0) & ((2 << wp::min(x1 - x, 7)) - 1); hit; hit &= hit - 1) {
                        const int k = __builtin_ctz(hit);
                        const float inverse = (float)wp::min(wp::max(1.0 / z[k], 1e-30), 1e30);
                        const long long i = (long long)(y / 4) * stride + 4 * (x + k) + y % 4;
                        contest(scene, inverses, ids, i, f, x + k, y, z[k], inverse);
                    }
                }
        };
        auto settle = [&](int f, unsigned open, int i, int x, int y, F inverse) __attribute__((noinline)) {
            for (; open; open &= open - 1) {
                const int k = __builtin_ctz(open);
                if (x + k / 4 >= width || y + k % 4 >= height) continue;
                const double z = exact(scene, f, x + k / 4, y + k % 4)[0];
                if (z > 0.0) contest(scene, inverses, ids, i + k, f, x + k / 4, y + k % 4, z, inverse[k]);
            }
        };

        const int end = (int)((long long)job.n_faces * (part + 1) / job.parts);
        for (int first = (int)((long long)job.n_faces * part / job.parts); first < end; first += 16) {
            const Place a = place(screen, first, 0), b = place(screen, first, 1), c = place(screen, first, 2);
            const I all = a.marks & b.marks & c.marks, any = a.marks | b.marks | c.marks;
            const I x0 = first_of(lower(a.x, lower(b.x, c.x)), centre_x);
            const I y0 = first_of(lower(a.y, lower(b.y, c.y)), centre_y);
            const I x1 = last_of(upper(a.x, upper(b.x, c.x)), centre_x, width);
            const I y1 = last_of(upper(a.y, upper(b.y, c.y)), centre_y, height);
            // Off the picture or behind the near plane as a whole; without a place; in no pixel.
            const I odd = (any & (BEHIND | ODD)) != 0;
            const I drawn = (lane < end - first) & ((all & ~ODD) == 0) & ((any & LOST) == 0);
            const unsigned todo = bits(drawn & (odd | ((x0 <= x1) & (y0 <= y1))));
            if (!todo) continue;

            // Corners in pixels from the centre of the first block's first pixel.
            const I top = y0 & ~3;
            const I left_edge = (x0 << shift) + centre_x, top_edge = (top << shift) + centre_y;
            auto offset = [&](I v, I origin) -> F { return __builtin_convertvector(v - origin, F) * pixel; };
            const F ax = offset(a.x, left_edge), ay = offset(a.y, top_edge);
            const F bx = offset(b.x, left_edge), by = offset(b.y, top_edge);
            const F cx = offset(c.x, left_edge), cy = offset(c.y, top_edge);
            const F pa = __builtin_bit_cast(F, a.inverse), pb = __builtin_bit_cast(F, b.inverse);
            const F pc = __builtin_bit_cast(F, c.inverse);
            const F signed_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
            const F sign = signed_area < 0.f ? (F)(-1.f) : (F)(1.f);
            const F area = signed_area * sign;
            // Edge function opposite a corner, slope_x x + slope_y y + start: positive inside, the area at the corner.
            const F slope_xa = (by - cy) * sign, slope_ya = (cx - bx) * sign;
            const F slope_xb = (cy - ay) * sign, slope_yb = (ax - cx) * sign;
            const F slope_xc = (ay - by) * sign, slope_yc = (bx - ax) * sign;
            // With coordinates of corners and pixels up to `size` and edges up to `extent`, what is computed of an edge
            // function is off by (8 size + 2 extent) (error of a coordinate) for the corners, which are rounded to half
            // a unit and, where they exceed 2^24 units, to float32; and by 24 extent size 2^-24 for its own roundings.
            F size = upper(upper(size_of(ax), size_of(ay)), upper(size_of(bx), size_of(by)));
            size = upper(size, upper(size_of(cx), size_of(cy)));
            size = upper(size, __builtin_convertvector(upper(x1 - x0, y1 - top) + 4, F));
            F extent = upper(upper(size_of(slope_xa), size_of(slope_ya)), upper(size_of(slope_xb), size_of(slope_yb)));
            extent = upper(extent, upper(size_of(slope_xc), size_of(slope_yc)));
            const F rounded = size > 16777216.f * pixel ? size * 6e-8f : (F)(0.f);
            const F doubt = size * (8.f * pixel + 14.f * rounded + 1.6e-6f * extent);
            const F per_area = 1.f / area;
            const F along_b = (pb - pa) * per_area, along_c = (pc - pa) * per_area;
            // Inverse depths must be within 2^-18 of themselves, or the face is too thin for float32.
            const F nearest = upper(pa, upper(pb, pc)), farthest = lower(pa, lower(pb, pc));
            const F blur = 2.f * doubt * (size_of(along_b) + size_of(along_c)) + nearest * 4e-7f;
            const I fine = (area > 16.f * doubt) & (blur < 3.8e-6f * farthest) & (nearest < 2.f * farthest) & ~odd;
            const unsigned fast = bits(fine);

            // Edge functions are kept `doubt` too high: from 0 on a pixel may be inside, from 2 doubt on it is.
            const F start_a = doubt - slope_xa * bx - slope_ya * by;
            const F start_b = doubt - slope_xb * cx - slope_yb * cy;
            const F start_c = doubt - slope_xc * ax - slope_yc * ay;
            float of[11][16] __attribute__((aligned(64)));
            *(F*)of[0] = slope_xa;
            *(F*)of[1] = slope_ya;
            *(F*)of[2] = slope_xb;
            *(F*)of[3] = slope_yb;
            *(F*)of[4] = slope_xc;
            *(F*)of[5] = slope_yc;
            *(F*)of[6] = pa - doubt * (along_b + along_c);
            *(F*)of[7] = along_b;
            *(F*)of[8] = along_c;
            *(F*)of[9] = doubt + doubt;
            *(F*)of[10] = nearest * (2.f * DOUBT);
            auto draw_block = [&](int k, int f, float a, float b, float c, int i, int x, int y) {
                const F wa = fma((F)(of[0][k]), column, fma((F)(of[1][k]), row, (F)(a)));
                const F wb = fma((F)(of[2][k]), column, fma((F)(of[3][k]), row, (F)(b)));
                const F wc = fma((F)(of[4][k]), column, fma((F)(of[5][k]), row, (F)(c)));
                const F least = lower(lower(wa, wb), wc);
                const F inverse = fma(wc, (F)(of[8][k]), fma(wb, (F)(of[7][k]), (F)(of[6][k])));
                const F before = *(const FU*)(inverses + i);
                const F apart = inverse - before;
                const I won = (least >= of[9][k]) & (apart > of[10][k]);
                const unsigned certain = bits(won), possible = bits((least >= 0.f) & (apart >= -of[10][k]));
                *(FOut*)(inverses + i) = won ? inverse : before;
                *(IOut*)(ids + i) = won ? (I)(f) : (I) * (const IU*)(ids + i);
                if (possible != certain) settle(f, possible & ~certain, i, x, y, inverse);
            };

            // Faces within 2 x 2 blocks: no loop a face, whose length the processor could not foretell.
            const I place_of = top * (stride / 4) + x0 * 4;
            const I wide = x1 - x0 >= 4, high = y1 - top >= 4;
            const unsigned large = bits((x1 - x0 >= 8) | (y1 - top >= 8)), small = todo & fast & ~large;
            float starts[3][4][16] __attribute__((aligned(64)));
            int places[4][16] __attribute__((aligned(64))), xs[16] __attribute__((aligned(64)));
            int ys[16] __attribute__((aligned(64)));
            *(I*)xs = x0;
            *(I*)ys = top;
            unsigned long long blocks = 0;
            for (int block = 0; block < 4; block++) {
                const float across = (float)(block % 2 * 4), down = (float)(block / 2 * 4);
                const F a = fma(slope_xa, (F)(across), fma(slope_ya, (F)(down), start_a));
                const F b = fma(slope_xb, (F)(across), fma(slope_yb, (F)(down), start_b));
                const F c = fma(slope_xc, (F)(across), fma(slope_yc, (F)(down), start_c));
                *(F*)starts[0][block] = a;
                *(F*)starts[1][block] = b;
                *(F*)starts[2][block] = c;
                *(I*)places[block] = place_of + (block % 2 * 16 + block / 2 * stride);
                const unsigned reached = bits((block % 2 ? wide : (I)(-1)) & (block / 2 ? high : (I)(-1)));
                blocks |= (unsigned long long)(reached & small) << 16 * block;
            }
            for (; blocks; blocks &= blocks - 1) {
                const int j = __builtin_ctzll(blocks), k = j % 16, block = j / 16;
                draw_block(
                    k, first + k, (&starts[0][0][0])[j], (&starts[1][0][0])[j], (&starts[2][0][0])[j],
                    (&places[0][0])[j], xs[k] + block % 2 * 4, ys[k] + block / 2 * 4
                );
            }

            for (unsigned rest = todo & ~small; rest; rest &= rest - 1) {
                const int k = __builtin_ctz(rest), f = first + k;
                if (!(fast >> k & 1)) {
                    draw_exactly(f);
                    continue;
                }
                const int left = xs[k], right = x1[k], bottom = y1[k];
                for (int y = ys[k]; y <= bottom; y += 4)
                    for (int x = left; x <= right; x += 4) {
                        const float across = (float)(x - left), down = (float)(y - ys[k]);
                        draw_block(
                            k, f, starts[0][0][k] + across * of[0][k] + down * of[1][k],
                            starts[1][0][k] + across * of[2][k] + down * of[3][k],
                            starts[2][0][k] + across * of[4][k] + down * of[5][k], y / 4 * stride + 4 * x, x, y
                        );
                    }
            }
        }
    }
}
