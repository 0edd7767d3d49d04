"""From the keys of `cuda_depth_draw` to scores of points and to pictures: one thread a point, then one a pixel.

Both read the keys alone, so that they are one node. Pictures that nobody asks for are not written, and only the
pixels that need a depth look at their face again: its float64 depth is not in the key. A thread of a large picture
takes several pixels and asks for all of their keys at once.
"""

from oasis_kernels.depth.cuda_depth import ARITHMETIC, BLOCK, CAMERA, SCENE, build

MOST_PIXELS = 4
"""A thread."""

PARAMETERS = SCENE | {
    "points": "const float*",  # [batch or 1][n_points][3]
    "points_step": "long long",
    "point_vertices": "const void*",  # [n_points] of 4 or 8 bytes, or 0: the vertex that a point is, or -1
    "vertex_bytes": "int",
    "by_identity": "int",  # whether points that are vertices of a face in view are seen by that alone
    "n_vertices": "int",
    "n_points": "int",
    "tau": "double",
    "margin": "double",
    "visibility": "float*",  # [batch][n_points]
    "slopes": "float*",  # [batch][n_points]: derivative by the point's depth; or 0
    "pixels": "int*",  # [batch][n_points]: row * width + column where the score is soft, else -1; or 0
    "depth": "float*",  # [batch][height][width], or 0
    "face_ids": "int*",  # [batch][height][width], or 0
    "barycentrics": "float*",  # [batch][height][width][3], or 0
    "pixels_a_thread": "int",  # up to MOST_PIXELS
    "found": "volatile long long*",  # set to 1 where a point's vertex is none; or 0
}

RESOLVE = """
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
        if (point_vertices) vertex = vertex_bytes == 8 ? ((const long long*)point_vertices)[i]
                                                       : (long long)((const int*)point_vertices)[i];
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
                for (int k = 0; k < 9; k++) if (ids[k] >= 0) {
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
        if (slopes) { slopes[at] = (float)slope; pixels[at] = pixel; }
    };

    auto show = [&](int b, long long i, int id) {
        double z = __longlong_as_double(0x7ff0000000000000ll), wa = 0.0, wb = 0.0, wc = 0.0;
        if (id >= 0 && (depth || barycentrics)) {
            const Triangle t = Exact::triangle(camera, vertices + b * vertices_step, faces, id);
            const Weights w = Exact::weigh(t, Exact::ray(camera, (int)(i % width), (int)(i / width)));
            z = Exact::depth(t, w);
            if (barycentrics) { wa = w.a / w.sum; wb = w.b / w.sum; wc = w.c / w.sum; }
        }
        if (depth) depth[b * plane + i] = (float)z;
        if (face_ids) face_ids[b * plane + i] = id;
        if (barycentrics) {
            float* out = barycentrics + 3 * (b * plane + i);
            out[0] = (float)wa; out[1] = (float)wb; out[2] = (float)wc;
        }
    };

    const bool pictures = depth || face_ids || barycentrics;
    const int point_tasks = (n_points + @BLOCK@ - 1) / @BLOCK@;
    const long long scored = (long long)batch * point_tasks;
    const int task_pixels = @BLOCK@ * pixels_a_thread;
    const long long pixel_tasks = pictures ? (plane + task_pixels - 1) / task_pixels : 0;
    int entry = -1;
    for (long long task = block_index; task < scored + batch * pixel_tasks; task += gridDim.x) {
        const bool scores = task < scored;
        const long long tasks = scores ? point_tasks : pixel_tasks, place = scores ? task : task - scored;
        const int b = (int)(place / tasks);
        const long long first = (place - b * tasks) * (scores ? @BLOCK@ : task_pixels) + threadIdx.x;
        int ids[@MOST_PIXELS@];
        #pragma unroll
        for (int k = 0; k < @MOST_PIXELS@; k++) {
            const long long i = first + k * @BLOCK@;
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
                const long long i = first + k * @BLOCK@;
                if (i < plane) show(b, i, ids[0]);
                #pragma unroll
                for (int j = 1; j < @MOST_PIXELS@; j++) ids[j - 1] = ids[j];  // so that they stay in registers
            }
        }
    }
"""

TEXT = (CAMERA + ARITHMETIC + RESOLVE).replace("@BLOCK@", str(BLOCK)).replace("@MOST_PIXELS@", str(MOST_PIXELS))
resolve = build("resolve_keys", PARAMETERS, TEXT, 3)
