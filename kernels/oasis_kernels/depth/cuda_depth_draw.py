"""Drawing faces into keys, one 64-bit word a pixel: the CUDA depth buffer.

`clear` empties the keys. `draw` gives a warp eight faces: 24 lanes bring a corner each into the camera's axes, eight
lanes find a box each, and then the pixels of all eight boxes are dealt out to the 32 lanes, so that a warp is busy
whatever the sizes of its faces. Faces with larger boxes go to a queue, and `draw_large` deals out the pixels of the
whole queue to all warps of the GPU in equal shares. Those that find the queue full are drawn where they are found: so
many fill the GPU either way.

A key is the depth, rounded down to a float32, above the face's index, so that the smallest key is nearly the answer.
Where the rounded depths of two faces agree, the exact ones are compared (see `settle`): the face that stays is the
nearest, of those at one depth the first, whatever the order of the threads.
"""

from oasis_kernels.depth.cuda_depth import ARITHMETIC, BLOCK, CAMERA, SCENE, build

FACES_A_BLOCK = 64
LARGE = 256
"""Pixels of a box above which a face goes to the queue."""
SHARE = 512
"""Pixels of a box in the queue that are handed out at once."""
WORTH_A_LOOK = 8 * SHARE
"""Pixels of a box above which a share is looked at as a whole first: most may lie beside a long, thin triangle."""
QUEUE = 1 << 17
"""Faces that the queue holds at the most."""
START_BITS = 44
"""Of the queue's counter, for the number of shares; the bits above count faces. A picture has fewer than 2^31 pixels,
so that 2^17 faces fit; what other warps add while the queue fills up, eight faces each, fits as well."""

DRAWN = SCENE | {
    "counter": "unsigned long long*",  # of the queue
    "queue_faces": "long long*",  # [capacity]: batch entry * n_faces + face
    "queue_starts": "long long*",  # [capacity + 1]: shares of all faces before it
    "capacity": "int",
}

CLEAR = """
    const ulonglong2 empty = {~0ull, ~0ull};
    const long long step = (long long)gridDim.x * @BLOCK@;
    for (long long i = (long long)block_index * @BLOCK@ + threadIdx.x; i < key_pairs; i += step) keys[i] = empty;
    if (block_index == 0 && threadIdx.x == 0) *counter = 0;
    if (found && block_index == 0) for (int b = threadIdx.x; b < batch; b += @BLOCK@)
        if (!(Ks[b * Ks_step] > 0.f) || !(Ks[b * Ks_step + 4] > 0.f)) *found = 1;
"""

PIXELS = """
    // Columns and rows of the picture that a face may reach; width 0 if there are none.
    struct Box { int left, top, width, height; };
    auto box_of = [&](const Camera& camera, const Triangle& t) -> Box {
        const double* lens = camera.lens;
        double low_x = 1e300, low_y = 1e300, high_x = -1e300, high_y = -1e300;
        bool beyond = false, finite = true;
        auto reach = [&](double x, double y, double z) {
            const double inverse = 1.0 / z;
            const double u = lens[0] * x * inverse + lens[1], v = lens[4] * y * inverse + lens[5];
            low_x = u < low_x ? u : low_x; high_x = u > high_x ? u : high_x;
            low_y = v < low_y ? v : low_y; high_y = v > high_y ? v : high_y;
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
        auto last_from = [](double v, int size) -> int {
            return v < size - 1 ? (int)(v > -1.0 ? v : -1.0) : size - 1;
        };
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
    struct Hit { Key* at; Key key; double z; Ray ray; };
    // Pixel `item` of a box, row by row.
    auto meet = [&](const Camera& camera, Key* picture, const Triangle& t, double flat, int left, int top,
                    unsigned box_width, int f, unsigned item) -> Hit {
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
"""

DRAW = """
    constexpr int FACES = 8;  // a warp
    struct Small { Triangle triangle; double flat; int left, top, width, start; };
    __shared__ Camera camera;
    __shared__ Small smalls[@WARPS@][FACES];
    Small* small = smalls[warp];
    const int groups = (n_faces - 1) / @FACES_A_BLOCK@ + 1;
    int entry = -1;
    for (long long task = block_index; task < (long long)batch * groups; task += gridDim.x) {
        const int b = (int)(task / groups), first = (int)(task % groups) * @FACES_A_BLOCK@ + FACES * warp;
        const float* mesh = vertices + b * vertices_step;
        const bool has_corner = lane < 3 * FACES && first + lane / 3 < n_faces;
        float px = 0.f, py = 0.f, pz = 0.f;
        if (has_corner) {
            const float* p = mesh + 3ll * faces[3ll * first + lane];
            px = p[0]; py = p[1]; pz = p[2];
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
            s.left = box.left; s.top = box.top; s.width = box.width;
        }
        const long long pixels = (long long)box.width * box.height;
        const bool large = pixels > @LARGE@;
        const unsigned larges = __ballot_sync(all, large);
        bool queued = false;
        if (larges) {
            const long long shares = large ? (pixels + @SHARE@ - 1) / @SHARE@ : 0;
            long long sum = shares;
            for (int offset = 1; offset < FACES; offset <<= 1) {
                const long long other = __shfl_up_sync(all, sum, offset);
                if (lane >= offset) sum += other;
            }
            Key place = ~0ull;
            // Once it is full nobody adds to the counter, lest it overflow.
            if (lane == FACES - 1 && *(volatile Key*)counter >> @START_BITS@ < (Key)capacity)
                place = atomicAdd(counter, (Key)__popc(larges) << @START_BITS@ | (Key)sum);
            place = __shfl_sync(all, place, FACES - 1);
            const long long slot = (long long)(place >> @START_BITS@) + __popc(larges & ((1u << lane) - 1));
            const long long start = (long long)(place & ((1ull << @START_BITS@) - 1)) + sum - shares;
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
            for (int j = 1; j < FACES; j++) if ((int)item >= starts[j]) { k = j; start = starts[j]; }
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
"""

DRAW_LARGE = """
    const Key counted = *counter;
    const long long n = min((long long)(counted >> @START_BITS@), (long long)capacity);
    if (n == 0) return;
    const long long shares = (long long)(counted >> @START_BITS@) > capacity
        ? queue_starts[capacity] : (long long)(counted & ((1ull << @START_BITS@) - 1));
    const long long warps = (long long)gridDim.x * @WARPS@, me = (long long)block_index * @WARPS@ + warp;
    long long share = shares * me / warps;
    const long long end = shares * (me + 1) / warps;
    if (share >= end) return;
    long long slot = 0;  // the last face that starts at `share` or before
    for (long long beyond = n; beyond - slot > 1;) {
        const long long middle = (slot + beyond) / 2;
        if (queue_starts[middle] <= share) slot = middle; else beyond = middle;
    }
    // Whether a triangle surely has none of the items from `first` to `last`. On the screen its edge functions are
    // linear, so they are largest and smallest at the corners of the columns and rows of these items: a lane a corner.
    auto passes_by = [&](const Camera& camera, const Triangle& t, const Box& box, unsigned first, unsigned last) {
        const unsigned top = first / box.width, bottom = (last - 1) / box.width;
        const unsigned left = top == bottom ? first - top * box.width : 0;
        const unsigned right = top == bottom ? last - 1 - top * box.width : box.width - 1;
        const Ray ray = Exact::ray(camera, box.left + (int)(lane & 1 ? right : left),
                                   box.top + (int)(lane & 2 ? bottom : top));
        const Weights w = Exact::weigh(t, ray);
        // What rounding may add up to, here or at a pixel, with a margin.
        auto size_of = [&](const Corner& p) {
            return fabs(p.x) + fabs(p.y) + (fabs(ray.u) + fabs(ray.v)) * fabs(p.z);
        };
        const double a = size_of(t.a), b = size_of(t.b), c = size_of(t.c);
        const double slack_a = 1e-14 * (b * c), slack_b = 1e-14 * (c * a), slack_c = 1e-14 * (a * b);
        const bool is_negative = __all_sync(all, w.a < -slack_a) || __all_sync(all, w.b < -slack_b) ||
                                 __all_sync(all, w.c < -slack_c);
        const bool is_positive = __all_sync(all, w.a > slack_a) || __all_sync(all, w.b > slack_b) ||
                                 __all_sync(all, w.c > slack_c);
        return is_negative && is_positive;
    };
    __shared__ Camera cameras[@WARPS@];
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
            const unsigned first = (unsigned)(share - start) * @SHARE@, last = min(first + @SHARE@, pixels);
            if (pixels > @WORTH_A_LOOK@ && passes_by(camera, t, box, first, last)) continue;
            draw_items(camera, mesh, first, last, [&](unsigned item) -> Hit {
                return meet(camera, keys + b * plane, t, flat, box.left, box.top, box.width, f, item);
            });
        }
    }
"""


def _filled(text: str) -> str:
    numbers = {
        "BLOCK": BLOCK, "WARPS": BLOCK // 32, "FACES_A_BLOCK": FACES_A_BLOCK, "LARGE": LARGE, "SHARE": SHARE,
        "START_BITS": START_BITS, "WORTH_A_LOOK": WORTH_A_LOOK,
    }  # fmt: skip
    for name, value in numbers.items():
        text = text.replace(f"@{name}@", str(value))
    return text


CLEARED = {name: SCENE[name] for name in ("Ks", "Ks_step", "batch")} | {
    "keys": "ulonglong2*",
    "key_pairs": "long long",
    "counter": "unsigned long long*",
    "found": "volatile long long*",  # set to 1 where a focal length is not positive; or 0
}

clear = build("clear_keys", CLEARED, _filled(CLEAR))
draw = build("draw_faces", DRAWN, _filled(CAMERA + ARITHMETIC + PIXELS + DRAW), 3)
draw_large = build("draw_large_faces", DRAWN, _filled(CAMERA + ARITHMETIC + PIXELS + DRAW_LARGE), 3)
