"""The depth buffer on the CPU: what `depth_buffer` computes, 8 or 16 numbers at a time, to the same face ids.

`transform` (a task is a range of vertices) -> `draw` (a part of the faces, into a buffer of its own) -> `write` (rows
of the buffers, merged) -> `score` (a range of points). Each is launched once a thread, and the threads take tasks off a
counter of the call until none is left. Backwards, `pull` (a batch entry) gives the corners of the faces their gradient.

Drawing is a filter. Faces are set up 16 at a time in float32, from corners in fixed point on the screen (2^-21 px for
pictures up to 512 px) and their inverse depths, and then tested against blocks of 4 x 4 pixels: one vector for each
edge function, one for the inverse depth, which is linear on the screen. Each carries a bound of its error, and where
a bound leaves open whether a face contains a pixel's centre, or which of two faces is in front, that one pixel is
decided by the float64 arithmetic of `depth_buffer`: same expressions, same order, no fused multiply-add. So the
filter costs no exactness and opens no seam: which face a pixel shows depends neither on the vectors' width, nor on
the threads, nor on whether the processor fuses. What a filter cannot serve (triangles through the near plane, far
outside the picture, or too thin for its bounds) is drawn in float64, 8 pixels at a time.

A buffer is kept in blocks: pixel (x, y) at (y / 4) * stride + 4 x + y % 4, so that the 4 x 4 pixels at any column are
one unaligned load.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from oasis_kernels.depth.depth_buffer_draw import BUFFER, DRAW, MARKS, WRITE
from oasis_kernels.depth.depth_buffer_job import HEAD, POINTS_A_TASK, QUADS_A_TASK, SPARE_COLUMNS, VERTICES_A_TASK
from oasis_kernels.depth.depth_buffer_score import PULL, SCORE
from oasis_kernels.runtime.vectors import cpu_options

TRANSFORM = """
    typedef int I __attribute__((ext_vector_type(8)));
    typedef float F __attribute__((ext_vector_type(8)));
    typedef int I4 __attribute__((ext_vector_type(4)));
    typedef int I4U __attribute__((ext_vector_type(4), aligned(4)));
    const int ranges = wp::max((job.n_vertices + @VERTICES_A_TASK@ - 1) / @VERTICES_A_TASK@, 1);
    const double units = (double)(1 << job.fraction_bits);
    const double reach = (double)(1 << 30) / units;             // of fixed point round the picture's middle [px]
    const double middle_x = width / 2, middle_y = height / 2;
    const D round = (D)(6755399441055744.0);                    // 1.5 * 2^52: adding it leaves an integer's low bits
    int found = 0;
    for (;;) {
        const int task = __atomic_fetch_add(&job.next_transform, 1, __ATOMIC_RELAXED);
        if (task >= job.batch * ranges) break;
        const int b = task / ranges, first = task % ranges * @VERTICES_A_TASK@;
        const int end = wp::min(first + @VERTICES_A_TASK@, job.n_vertices);
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
            #define ROW(k, xy, z, p, q) \\
                *(D4U*)(camera_out + 4 * (k)) = __builtin_shufflevector(xy, z, 2 * ((k) % 4), 2 * ((k) % 4) + 1, \\
                                                                        8 + 2 * ((k) % 4), 9 + 2 * ((k) % 4)); \\
                *(I4U*)(screen_out + 4 * (k)) = __builtin_shufflevector(p, q, 2 * ((k) % 4), 2 * ((k) % 4) + 1, \\
                                                                        8 + 2 * ((k) % 4), 9 + 2 * ((k) % 4));
            ROW(0, xy0, z0, p0, q0) ROW(1, xy0, z0, p0, q0) ROW(2, xy0, z0, p0, q0) ROW(3, xy0, z0, p0, q0)
            ROW(4, xy1, z1, p1, q1) ROW(5, xy1, z1, p1, q1) ROW(6, xy1, z1, p1, q1) ROW(7, xy1, z1, p1, q1)
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
"""

CONSTANTS = {
    "VERTICES_A_TASK": VERTICES_A_TASK,
    "POINTS_A_TASK": POINTS_A_TASK,
    "QUADS_A_TASK": QUADS_A_TASK,
    "SPARE_COLUMNS": SPARE_COLUMNS,
}
BODIES = {
    "transform": HEAD + MARKS + TRANSFORM,
    "draw": HEAD + MARKS + BUFFER + DRAW,
    "write": HEAD + BUFFER + WRITE,
    "score": HEAD + SCORE,
    "pull": HEAD + PULL,
}


class Kernels(NamedTuple):
    """Kernels of one scalar type. Their one argument is the address of a `Job`."""

    transform: Any
    draw: Any
    write: Any
    score: Any
    pull: Any
    all: Any
    """`transform`, `draw`, `write` and `score`, one after the other, for a single thread."""


@functools.cache
def kernels(dtype: str) -> Kernels:
    """The kernels for inputs of C type "float" or "double"."""
    module = wp.get_module(f"{__name__}.{dtype}")
    wp.set_module_options(cpu_options(), module=module)

    def native(stage: str) -> Any:
        text = BODIES[stage]
        for name, value in {"T": dtype, **CONSTANTS}.items():
            text = text.replace(f"@{name}@", str(value))

        def stub(address: wp.uint64): ...

        stub.__name__ = stub.__qualname__ = f"{stage}_natively"
        return wp.func_native(text)(stub)

    transform_natively, draw_natively = native("transform"), native("draw")
    write_natively, score_natively, pull_natively = native("write"), native("score"), native("pull")

    def transform(address: wp.uint64):
        transform_natively(address)

    def draw(address: wp.uint64):
        draw_natively(address)

    def write(address: wp.uint64):
        write_natively(address)

    def score(address: wp.uint64):
        score_natively(address)

    def pull(address: wp.uint64):
        pull_natively(address)

    def transform_draw_write_score(address: wp.uint64):
        transform_natively(address)
        draw_natively(address)
        write_natively(address)
        score_natively(address)

    functions = (transform, draw, write, score, pull, transform_draw_write_score)
    return Kernels(*(wp.Kernel(function, module=module) for function in functions))
