"""Drawing faces into buffers of 4 x 4 blocks, and writing the pictures out: see `depth_buffer_vectors`."""

MARKS = """
    // Marks of a vertex: nothing is known of the place on the screen of one that is BEHIND the near plane; ODD ones are
    // out of reach of fixed point; a LOST one has no finite place. The others tell on which side of the picture it is.
    constexpr int BEHIND = 1, ODD = 2, LOST = 4, LEFT = 8, RIGHT = 16, ABOVE = 32, BELOW = 64;
"""

BUFFER = """
    typedef float F __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef bool M __attribute__((ext_vector_type(16)));
    typedef float FU __attribute__((ext_vector_type(16), aligned(4)));
    typedef int IU __attribute__((ext_vector_type(16), aligned(4)));
    auto bits = [](I m) -> unsigned { return __builtin_bit_cast(unsigned short, __builtin_convertvector(m, M)); };
    // Columns c and c + 1 of a matrix of four columns, whose rows are the quarters of a and b: 8 numbers each.
    #define COLUMNS(a, b, c) \\
        __builtin_shufflevector(a, b, c, c + 4, c + 8, c + 12, c + 16, c + 20, c + 24, c + 28, \\
                                c + 1, c + 5, c + 9, c + 13, c + 17, c + 21, c + 25, c + 29)
    // The eight numbers from place c of a, then of b.
    #define HALVES(a, b, c) \\
        __builtin_shufflevector(a, b, c, c + 1, c + 2, c + 3, c + 4, c + 5, c + 6, c + 7, \\
                                c + 16, c + 17, c + 18, c + 19, c + 20, c + 21, c + 22, c + 23)
    const int quads = (height + 3) / 4, stride = 4 * ((width + @SPARE_COLUMNS@ + 15) / 16 * 16);
    const long long plane = (long long)quads * stride;
    // Buffers of batch entry b: for each part the inverse depths of its pixels, 0 where nothing is, then their faces,
    // unwritten where nothing is.
    auto planes = [&](int b, int part) -> float* { return (float*)job.planes + 2 * plane * (b * job.parts + part); };
    // Two inverse depths, each 2^-18 of itself off at the most, tell which is nearer if they are this far apart.
    const float DOUBT = 1.52587890625e-5f;

    struct Scene { View view; const double* camera; };
    auto corner = [&](const Scene& scene, int f, int j) -> Corner {
        const double* p = scene.camera + 4ll * faces[3ll * f + j];
        return {(D)(p[0]), (D)(p[1]), (D)(p[2])};
    };
    // |w.sum| up to here is a face seen edge-on: `depth_buffer.triangle`.
    auto edge_on = [](const Corner& a, const Corner& b, const Corner& c) -> double {
        const double ex = b.x[0] - a.x[0], ey = b.y[0] - a.y[0], ez = b.z[0] - a.z[0];
        const double gx = c.x[0] - a.x[0], gy = c.y[0] - a.y[0], gz = c.z[0] - a.z[0];
        const double nx = ey * gz - ez * gy, ny = ez * gx - ex * gz, nz = ex * gy - ey * gx;
        return 1e-13 * __builtin_sqrt(nx * nx + ny * ny + nz * nz);
    };
    // Depths at which face `f` is hit in eight pixels from (x, y); 0 for a miss.
    auto exact = [&](const Scene& scene, int f, int x, int y) __attribute__((noinline)) -> D {
        const Corner p = corner(scene, f, 0), q = corner(scene, f, 1), r = corner(scene, f, 2);
        const D u = scene.view.u0 + (eight + (double)x) * scene.view.du;
        const D v = (D)(scene.view.v0 + (double)y * scene.view.dv);
        const Weights w = weigh(p, q, r, u, v);
        const D z = depth_of(w, p.z, q.z, r.z);
        return (w.inside & (absolute(w.sum) > edge_on(p, q, r)) & (z > near_plane)) ? z : (D)(0.0);
    };
    // Enter face `f` at pixel (x, y), place i, which it hits at depth z; 1 / z is near `inverse`.
    auto contest = [&](const Scene& scene, float* inverses, int* ids, long long i, int f, int x, int y, double z,
                       float inverse) {
        const float apart = inverse - inverses[i], doubt = DOUBT * inverse;
        if (inverses[i] > 0.f && apart <= doubt) {
            if (apart < -doubt) return;
            const double rival = exact(scene, ids[i], x, y)[0];
            if (z > rival || (z == rival && f > ids[i])) return;
        }
        inverses[i] = inverse;
        ids[i] = f;
    };
"""

DRAW = """
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
    struct Place { I x, y, inverse, marks; };
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
                low_x = wp::min(low_x, u); high_x = wp::max(high_x, u);
                low_y = wp::min(low_y, v); high_y = wp::max(high_y, v);
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
            for (int y = y0; y <= y1; y++) for (int x = x0; x <= x1; x += 8) {
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
            *(F*)of[0] = slope_xa; *(F*)of[1] = slope_ya;
            *(F*)of[2] = slope_xb; *(F*)of[3] = slope_yb;
            *(F*)of[4] = slope_xc; *(F*)of[5] = slope_yc;
            *(F*)of[6] = pa - doubt * (along_b + along_c); *(F*)of[7] = along_b; *(F*)of[8] = along_c;
            *(F*)of[9] = doubt + doubt; *(F*)of[10] = nearest * (2.f * DOUBT);
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
                *(IOut*)(ids + i) = won ? (I)(f) : (I)*(const IU*)(ids + i);
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
                *(F*)starts[0][block] = a; *(F*)starts[1][block] = b; *(F*)starts[2][block] = c;
                *(I*)places[block] = place_of + (block % 2 * 16 + block / 2 * stride);
                const unsigned reached = bits((block % 2 ? wide : (I)(-1)) & (block / 2 ? high : (I)(-1)));
                blocks |= (unsigned long long)(reached & small) << 16 * block;
            }
            for (; blocks; blocks &= blocks - 1) {
                const int j = __builtin_ctzll(blocks), k = j % 16, block = j / 16;
                draw_block(k, first + k, (&starts[0][0][0])[j], (&starts[1][0][0])[j], (&starts[2][0][0])[j],
                           (&places[0][0])[j], xs[k] + block % 2 * 4, ys[k] + block / 2 * 4);
            }

            for (unsigned rest = todo & ~small; rest; rest &= rest - 1) {
                const int k = __builtin_ctz(rest), f = first + k;
                if (!(fast >> k & 1)) { draw_exactly(f); continue; }
                const int left = xs[k], right = x1[k], bottom = y1[k];
                for (int y = ys[k]; y <= bottom; y += 4) for (int x = left; x <= right; x += 4) {
                    const float across = (float)(x - left), down = (float)(y - ys[k]);
                    draw_block(k, f, starts[0][0][k] + across * of[0][k] + down * of[1][k],
                               starts[1][0][k] + across * of[2][k] + down * of[3][k],
                               starts[2][0][k] + across * of[4][k] + down * of[5][k],
                               y / 4 * stride + 4 * x, x, y);
                }
            }
        }
    }
"""

WRITE = """
    typedef T T16 __attribute__((ext_vector_type(16)));
    typedef T T16U __attribute__((ext_vector_type(16), aligned(sizeof(T))));
    typedef T T8U __attribute__((ext_vector_type(8), aligned(sizeof(T))));
    typedef int I8 __attribute__((ext_vector_type(8)));
    typedef int I8U __attribute__((ext_vector_type(8), aligned(4)));
    const int tasks = (quads + @QUADS_A_TASK@ - 1) / @QUADS_A_TASK@;
    const I8 index8 = {0, 1, 2, 3, 4, 5, 6, 7};
    for (;;) {
        const int task = __atomic_fetch_add(&job.next_write, 1, __ATOMIC_RELAXED);
        if (task >= job.batch * tasks) break;
        const int entry = task / tasks, first = task % tasks * @QUADS_A_TASK@;
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
            *(IU*)(ids + i) = won ? (I)*(const IU*)(other_ids + i) : (I)*(const IU*)(ids + i);
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
                __builtin_shufflevector(a, b, 0, 8, -1, 1, 9, -1, 2, 10), c, 0, 1, 8, 3, 4, 9, 6, 7);
            *(T8U*)(out + 8) = __builtin_shufflevector(
                __builtin_shufflevector(a, b, -1, 3, 11, -1, 4, 12, -1, 5), c, 10, 1, 2, 11, 4, 5, 12, 7);
            *(T8U*)(out + 16) = __builtin_shufflevector(
                __builtin_shufflevector(a, b, 13, -1, 6, 14, -1, 7, 15, -1), c, 0, 13, 2, 3, 14, 5, 6, 15);
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
            } else for (int k = 0; k < n; k++) {
                depth[i + k] = (T)z[k];
                face_ids[i + k] = shown[k];
            }
            if (!barycentrics && sizeof(T) == 4) return;
            write_exactly(x, y, wp::min(n, 8), shown.lo);
            if (n > 8) write_exactly(x + 8, y, n - 8, shown.hi);
        };

        const int end = wp::min(first + @QUADS_A_TASK@, quads);
        for (int quad = first; quad < end; quad++) for (int x = 0; x < width; x += 16) {
            const long long i = (long long)quad * stride + 4 * x;
            for (int part = 1; part < job.parts; part++) {
                const float* other = planes(entry, part);
                for (int k = 0; k < 4; k++) merge(other, (const int*)(other + plane), i + 16 * k, x + 4 * k, 4 * quad);
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
"""
