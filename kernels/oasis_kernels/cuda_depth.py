"""What the CUDA kernels of the depth buffer share: the camera, the float64 arithmetic of `depth_buffer`, a builder.

`clear` -> `draw` -> `draw_large` (`cuda_depth_draw`) -> `resolve` (`cuda_depth_resolve`), four nodes of a graph;
backwards `pull` twice and `settle` (`cuda_depth_pull`). Arrays are float32, decisions are float64: the same
expressions in the same order as in `depth_buffer`, without fused multiply-adds, so that every pixel shows the same
face as on the CPU.
"""

from typing import Any

import warp as wp

from oasis_kernels.cuda_native import CudaNative, cuda_native

BLOCK = 256
"""Threads a block."""

SCENE = {
    "vertices": "const float*",  # [batch or 1][n_vertices][3]
    "viewmats": "const float*",  # [batch or 1][4][4]
    "Ks": "const float*",  # [batch or 1][3][3]
    "faces": "const int*",  # [n_faces][3]
    "vertices_step": "long long",  # numbers from one batch entry to the next, 0 where they share
    "viewmats_step": "long long",
    "Ks_step": "long long",
    "batch": "int",
    "n_faces": "int",
    "width": "int",
    "height": "int",
    "near_plane": "double",
    "keys": "unsigned long long*",  # [batch][height][width]: depth rounded to float32, then the face; or all bits
}

CAMERA = """
    // Three rows of the view; for columns and rows: focal length, centre, the first ray and the step between rays.
    struct Camera { double view[12], lens[8]; };
    // Thread t of 14 or more reads its part of the camera of batch entry b.
    auto read_camera = [&](Camera& camera, int b, int t) {
        if (t < 12) camera.view[t] = viewmats[b * viewmats_step + t];
        if (t == 12 || t == 13) {
            const float* K = Ks + b * Ks_step;
            double* lens = camera.lens + 4 * (t - 12);
            lens[0] = K[4 * (t - 12)];
            lens[1] = K[2 + 3 * (t - 12)];
            lens[3] = 1.0 / lens[0];
            lens[2] = (0.5 - lens[1]) * lens[3];
        }
    };
    struct Corner { double x, y, z; };
    auto in_camera = [](const Camera& camera, double x, double y, double z) -> Corner {
        const double* r = camera.view;
        return {r[0] * x + r[1] * y + r[2] * z + r[3], r[4] * x + r[5] * y + r[6] * z + r[7],
                r[8] * x + r[9] * y + r[10] * z + r[11]};
    };
    auto read_corner = [&](const Camera& camera, const float* p) -> Corner {
        return in_camera(camera, p[0], p[1], p[2]);
    };
"""

ARITHMETIC = """
    struct Triangle { Corner a, b, c; };
    auto triangle = [&](const Camera& camera, const float* mesh, int f) -> Triangle {
        const int* corners = faces + 3ll * f;
        const int i = corners[0], j = corners[1], k = corners[2];
        return {read_corner(camera, mesh + 3ll * i), read_corner(camera, mesh + 3ll * j),
                read_corner(camera, mesh + 3ll * k)};
    };
    struct Ray { double u, v; };
    auto ray_of = [](const Camera& camera, int x, int y) -> Ray {
        return {camera.lens[2] + (double)x * camera.lens[3], camera.lens[6] + (double)y * camera.lens[7]};
    };
    // `depth_buffer.edge_functions`: barycentrics times their sum, all of one sign inside, edges included.
    struct Weights { double a, b, c, sum; };
    auto weigh = [](const Triangle& t, Ray ray) -> Weights {
        const double ax = t.a.x - ray.u * t.a.z, ay = t.a.y - ray.v * t.a.z;
        const double bx = t.b.x - ray.u * t.b.z, by = t.b.y - ray.v * t.b.z;
        const double cx = t.c.x - ray.u * t.c.z, cy = t.c.y - ray.v * t.c.z;
        const double wa = bx * cy - by * cx, wb = cx * ay - cy * ax, wc = ax * by - ay * bx;
        return {wa, wb, wc, wa + wb + wc};
    };
    auto depth_of = [](const Triangle& t, const Weights& w) -> double {
        return (w.a * t.a.z + w.b * t.b.z + w.c * t.c.z) / w.sum;
    };
"""


def build(name: str, parameters: dict[str, str], body: str, blocks_a_multiprocessor: int = 1) -> CudaNative:
    """A kernel of `BLOCK` threads a block without fused multiply-adds, for CUDA only."""
    text = f"#if defined(__CUDA_ARCH__)\n{body}\n#endif\n"
    native = cuda_native(name, parameters, text, BLOCK, blocks_a_multiprocessor)
    module: Any = native.kernel.module
    wp.set_module_options({"fuse_fp": False}, module=module)
    return native
