"""Gradients of the scores by points and by the corners of the faces in view: the adjoint of `cuda_depth_resolve`.

Along a ray d = (u, v, 1), a plane with normal n through a corner that moves by e with weight w comes nearer or goes
farther by w (n e) / (n d). Many points pull at one vertex, and floats added by atomics would round differently each
time. Whole numbers do not: `pull` runs twice, one thread a point, first for the largest of all numbers that are to be
added, a block each, then to add multiples of 2^-shift of it in 64 bits, where 2^shift leaves just enough room for
their sum: for 10^4 points each is off by 2^-47 of the largest. `settle`, one thread a vertex, turns sums into floats.
"""

from oasis_kernels.depth.cuda_depth import ARITHMETIC, BLOCK, CAMERA, SCENE, build

PEAKS = 1024
"""Blocks of `pull` at the most."""

PULLED = {name: kind for name, kind in SCENE.items() if name != "keys" and name != "near_plane"} | {
    "n_vertices": "int",
    "n_points": "int",
    "face_ids": "const int*",  # [batch][height][width]
    "grad_visibility": "const float*",  # [batch][n_points]
    "slopes": "const float*",  # [batch][n_points]
    "pixels": "const int*",  # [batch][n_points]
    "grad_points": "float*",  # [batch][n_points][3], or 0
    "adds": "int",  # 0 in the first run, 1 in the second
    "peaks": "unsigned long long*",  # [blocks]: bits of doubles
    "shift": "long long*",  # of the sums
    "sums": "long long*",  # [batch][n_vertices][4]: three axes, and not 0 where one was no number; or 0
}

PULL = """
    typedef unsigned long long Bits;
    __shared__ Camera camera;
    __shared__ Bits highest[@BLOCK@ / 32];
    const unsigned all = 0xffffffffu;
    const long long step = (long long)gridDim.x * @BLOCK@;
    const long long thread_index = (long long)block_index * @BLOCK@ + threadIdx.x;
    // The largest over the block, in all of its threads. Bits of doubles that are not negative have their order.
    auto largest_of_block = [&](Bits mine) -> Bits {
        for (int offset = 16; offset > 0; offset >>= 1) {
            const Bits other = __shfl_xor_sync(all, mine, offset);
            mine = other > mine ? other : mine;
        }
        if ((threadIdx.x & 31) == 0) highest[threadIdx.x >> 5] = mine;
        __syncthreads();
        for (int k = 0; k < @BLOCK@ / 32; k++) mine = highest[k] > mine ? highest[k] : mine;
        return mine;
    };

    int exponent = 0;
    Bits peak = 0;
    if (adds) {
        for (int k = threadIdx.x; k < (int)gridDim.x; k += @BLOCK@) peak = peaks[k] > peak ? peaks[k] : peak;
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
        if (!adds && grad_points) for (int axis = 0; axis < 3; axis++)
            grad_points[3 * at + axis] = (float)(along * camera.view[8 + axis]);
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
                    if (finite) atomicAdd((Bits*)sum + axis, (Bits)__double2ll_rn(scalbn(number, exponent)));
                    else sum[3] = 1;
                } else if (finite) {
                    const Bits bits = (Bits)__double_as_longlong(fabs(number));
                    peak = bits > peak ? bits : peak;
                }
            }
        }
    };
    const int tasks = (n_points + @BLOCK@ - 1) / @BLOCK@;
    int entry = -1;
    for (long long task = block_index; task < (long long)batch * tasks; task += gridDim.x) {
        const int b = (int)(task / tasks), i = (int)(task % tasks) * @BLOCK@ + threadIdx.x;
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
"""

SETTLED = {
    "sums": "const long long*",
    "shift": "const long long*",
    "n": "long long",  # vertices of all batch entries
    "grad_vertices": "float*",  # [n][3]
}

SETTLE = """
    const long long step = (long long)gridDim.x * @BLOCK@;
    for (long long i = (long long)block_index * @BLOCK@ + threadIdx.x; i < n; i += step)
        for (int axis = 0; axis < 3; axis++)
            grad_vertices[3 * i + axis] =
                sums[4 * i + 3] ? __int_as_float(0x7fc00000) : (float)scalbn((double)sums[4 * i + axis], -(int)*shift);
"""

pull = build("pull_at_corners", PULLED, (CAMERA + ARITHMETIC + PULL).replace("@BLOCK@", str(BLOCK)))
settle = build("settle_sums", SETTLED, SETTLE.replace("@BLOCK@", str(BLOCK)))
