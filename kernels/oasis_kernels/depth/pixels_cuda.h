// Columns and rows of the picture that a face may reach; width 0 if there are none.
struct Box {
    int left, top, width, height;
};
auto box_of = [&](const Camera& camera, const Triangle& t) -> Box {
    const double* lens = camera.lens;
    double low_x = 1e300, low_y = 1e300, high_x = -1e300, high_y = -1e300;
    bool beyond = false, finite = true;
    auto reach = [&](double x, double y, double z) {
        const double inverse = 1.0 / z;
        const double u = lens[0] * x * inverse + lens[1], v = lens[4] * y * inverse + lens[5];
        low_x = u < low_x ? u : low_x;
        high_x = u > high_x ? u : high_x;
        low_y = v < low_y ? v : low_y;
        high_y = v > high_y ? v : high_y;
        beyond = true;
    };
    // Of what lies beyond the near plane: corners, and where edges pass through it.
    auto follow = [&](const Corner& p, const Corner& q) {
        finite = finite && fabs(p.x) + fabs(p.y) + fabs(p.z) < 1e100;
        if (p.z > near_plane) reach(p.x, p.y, p.z);
        if ((p.z > near_plane) != (q.z > near_plane)) {
            const double s = (near_plane - p.z) / (q.z - p.z);
            reach(p.x + s * (q.x - p.x), p.y + s * (q.y - p.y), near_plane);
        }
    };
    follow(t.a, t.b);
    follow(t.b, t.c);
    follow(t.c, t.a);
    if (!beyond || !finite) return {0, 0, 0, 0};
    // Rounding of the box never decides about a pixel on an edge. Clamped as doubles, because the conversion of a
    // huge one to an integer is undefined; where overflow has left NaN, to the whole picture.
    const double slack_x = 1e-3 + 1e-9 * (fabs(low_x) + fabs(high_x));
    const double slack_y = 1e-3 + 1e-9 * (fabs(low_y) + fabs(high_y));
    auto first_from = [](double v, int size) -> int { return v > 0.0 ? (int)(v < size ? v : size) : 0; };
    auto last_from = [](double v, int size) -> int { return v < size - 1 ? (int)(v > -1.0 ? v : -1.0) : size - 1; };
    const int x0 = first_from(ceil(low_x - slack_x - 0.5), width);
    const int x1 = last_from(floor(high_x + slack_x - 0.5), width);
    const int y0 = first_from(ceil(low_y - slack_y - 0.5), height);
    const int y1 = last_from(floor(high_y + slack_y - 0.5), height);
    if (x0 > x1 || y0 > y1) return {0, 0, 0, 0};
    return {x0, y0, x1 - x0 + 1, y1 - y0 + 1};
};
// |sum of weights| up to here is a face seen edge-on: `depth_buffer.with_edge_on`.
auto edge_on = [](const Triangle& t) -> double {
    const double ex = t.b.x - t.a.x, ey = t.b.y - t.a.y, ez = t.b.z - t.a.z;
    const double gx = t.c.x - t.a.x, gy = t.c.y - t.a.y, gz = t.c.z - t.a.z;
    const double nx = ey * gz - ez * gy, ny = ez * gx - ex * gz, nz = ex * gy - ey * gx;
    return 1e-13 * sqrt(nx * nx + ny * ny + nz * nz);
};

typedef unsigned long long Key;
// A ray that meets a face in front of the camera. `at` is null for one that does not.
struct Hit {
    Key* at;
    Key key;
    double z;
    Ray ray;
};
// Pixel `item` of a box, row by row.
auto meet = [&](const Camera& camera,
                Key* picture,
                const Triangle& t,
                double flat,
                int left,
                int top,
                unsigned box_width,
                int f,
                unsigned item) -> Hit {
    const unsigned row = item / box_width;
    const int x = left + (int)(item - row * box_width), y = top + (int)row;
    const Ray ray = Exact::ray(camera, x, y);
    const Weights w = Exact::weigh(t, ray);
    const bool inside = (w.a >= 0.0 && w.b >= 0.0 && w.c >= 0.0) || (w.a <= 0.0 && w.b <= 0.0 && w.c <= 0.0);
    if (!inside || !(fabs(w.sum) > flat)) return {nullptr};
    const double z = Exact::depth(t, w);
    if (!(z > near_plane)) return {nullptr};
    const Key key = (Key)__float_as_uint(__double2float_rd(z)) << 32 | (unsigned)f;
    return {picture + (long long)y * width + x, key, z, ray};
};
// A hit has been entered, by which its key or `old` was lost. The smaller key is the right one where rounded depths
// differ. Where they agree, the thread that has seen both puts the better one back if it is not there. Nobody takes
// a key out without this duty, and the better one is the same for all threads, so the last word is the best.
auto settle = [&](const Hit& hit, Key old, const Camera& camera, const float* mesh) {
    if (!hit.at || old >> 32 != hit.key >> 32) return;
    auto depth = [&](Key key) { return Exact::depth_of_face(camera, mesh, faces, (int)(unsigned)key, hit.ray); };
    auto is_nearer = [](double za, Key a, double zb, Key b) { return za < zb || (za == zb && a < b); };
    const double old_z = depth(old);
    const bool stays = is_nearer(old_z, old, hit.z, hit.key);
    const Key best = stays ? old : hit.key;
    const double best_z = stays ? old_z : hit.z;
    for (Key shown = old < hit.key ? old : hit.key; shown != best;) {
        const Key found = atomicCAS(hit.at, shown, best);
        if (found == shown || found >> 32 < best >> 32) break;
        if (found != best && is_nearer(depth(found), found, best_z, best)) break;
        shown = found;
    }
};
// Items from `first` to `end`, dealt out to the lanes; two a lane at a time, for the memory's sake.
auto draw_items = [&](const Camera& camera, const float* mesh, unsigned first, unsigned end, auto hit_of) {
    for (unsigned item = first + (threadIdx.x & 31); item < end; item += 64) {
        const Hit a = hit_of(item), b = item + 32 < end ? hit_of(item + 32) : Hit{nullptr};
        const Key old_a = a.at ? atomicMin(a.at, a.key) : 0, old_b = b.at ? atomicMin(b.at, b.key) : 0;
        settle(a, old_a, camera, mesh);
        settle(b, old_b, camera, mesh);
    }
};
const long long plane = (long long)width * height;
const unsigned all = 0xffffffffu;
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
