"""What the CUDA kernels of the depth buffer share: the camera, the float64 arithmetic of `depth_buffer`, a builder.

`clear` -> `draw` -> `draw_large` (`cuda_depth_draw`) -> `resolve` (`cuda_depth_resolve`), four nodes of a graph;
backwards `pull` twice and `settle` (`cuda_depth_pull`). Arrays are float32, decisions are float64: the same
expressions in the same order as in `depth_buffer`, without fused multiply-adds, so that every pixel shows the same
face as on the CPU.
"""

from typing import Any

import warp as wp

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

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
"""

ARITHMETIC = """
    struct Corner { double x, y, z; };
    struct Triangle { Corner a, b, c; };
    struct Ray { double u, v; };  // passes (u, v, 1)
    struct Weights { double a, b, c, sum; };
    struct Exact {
        static __device__ Corner in_camera(const Camera& camera, double x, double y, double z) {
            const double* r = camera.view;
            return {r[0] * x + r[1] * y + r[2] * z + r[3], r[4] * x + r[5] * y + r[6] * z + r[7],
                    r[8] * x + r[9] * y + r[10] * z + r[11]};
        }
        static __device__ Corner corner(const Camera& camera, const float* p) {
            return in_camera(camera, p[0], p[1], p[2]);
        }
        static __device__ Triangle triangle(const Camera& camera, const float* mesh, const int* faces, int f) {
            const int i = faces[3ll * f], j = faces[3ll * f + 1], k = faces[3ll * f + 2];
            return {corner(camera, mesh + 3ll * i), corner(camera, mesh + 3ll * j), corner(camera, mesh + 3ll * k)};
        }
        static __device__ Ray ray(const Camera& camera, int x, int y) {
            return {camera.lens[2] + (double)x * camera.lens[3], camera.lens[6] + (double)y * camera.lens[7]};
        }
        // `depth_buffer.edge_functions`: barycentrics times their sum, all of one sign inside, edges included.
        static __device__ Weights weigh(const Triangle& t, Ray ray) {
            const double ax = t.a.x - ray.u * t.a.z, ay = t.a.y - ray.v * t.a.z;
            const double bx = t.b.x - ray.u * t.b.z, by = t.b.y - ray.v * t.b.z;
            const double cx = t.c.x - ray.u * t.c.z, cy = t.c.y - ray.v * t.c.z;
            const double wa = bx * cy - by * cx, wb = cx * ay - cy * ax, wc = ax * by - ay * bx;
            return {wa, wb, wc, wa + wb + wc};
        }
        static __device__ double depth(const Triangle& t, const Weights& w) {
            return (w.a * t.a.z + w.b * t.b.z + w.c * t.c.z) / w.sum;
        }
        // Out of line: where it is called rarely, its registers must not cost the rest.
        static __device__ __noinline__ double depth_of_face(
            const Camera& camera, const float* mesh, const int* faces, int f, Ray ray
        ) {
            const Triangle t = triangle(camera, mesh, faces, f);
            return depth(t, weigh(t, ray));
        }
    };
"""


def build(name: str, parameters: dict[str, str], body: str, blocks_a_multiprocessor: int = 1) -> CudaNative:
    """A kernel of `BLOCK` threads a block without fused multiply-adds, for CUDA only."""
    text = f"#if defined(__CUDA_ARCH__)\n{body}\n#endif\n"
    native = cuda_native(name, parameters, text, BLOCK, blocks_a_multiprocessor)
    module: Any = native.kernel.module
    wp.set_module_options({"fuse_fp": False}, module=module)
    return native
