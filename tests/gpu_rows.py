"""Measurements as a GPU gives them, made up, for what writes and draws them."""

from dataclasses import replace

from oasis_warp.bench.roofline import KernelRow
from oasis_warp.bench.scaling import ScalingRow
from oasis_warp.bench.speed import GpuRow

ABOUT = {"device": "a GPU", "commit": "0123456789", "versions": "oasis_warp 0"}

GPU = GpuRow(
    case="37k at 512 x 512", pass_="forward + backward", way="warp", gaussians=36_881, faces=None, views=1, width=512,
    height=512, wall_ms=0.25, wall_iqr_ms=0.01, busy_ms=0.1, busy_iqr_ms=0.001, launch_ms=0.11, kernels_ms=0.09,
    kernels=9.0, peak_mb=20.5, max_abs=3e-3, most_abs=4e-7, rel_l2=2e-7, gradient_rel_l2=5e-7, bit_equal=True,
    not_captured="", groups=11, calls=40, seed=0, **ABOUT,
)  # fmt: skip
PEER = replace(
    GPU, way="gsplat", wall_ms=0.75, busy_ms=None, busy_iqr_ms=None, launch_ms=None, kernels_ms=0.45, kernels=30.0,
    not_captured="not tried",
)  # fmt: skip
FRAME = replace(
    GPU, case="avatar at 512 x 512", pass_="pose + draw", busy_ms=None, busy_iqr_ms=None, launch_ms=None,
    gradient_rel_l2=None, not_captured="operation not permitted when stream is capturing",
)  # fmt: skip
SPEED = [GPU, PEER, FRAME]

POINT = ScalingRow(
    axis="gaussians", series="512 x 512", scene="surface 1000", pass_="forward", gaussians=1000, views=1, width=512,
    height=512, pairs=48_000, longest=62, wall_ms=0.1, busy_ms=0.02, peak_mb=3.0, finite=True, overflow=False,
    checked="all", max_abs=1e-6, most_abs=3e-7, not_captured="", seed=0, **ABOUT,
)  # fmt: skip


def line(axis, series, amounts, times, **fixed):
    """Both passes of points along an axis, with these times of the GPU; a backward pass takes as long again."""
    rows = []
    for amount, ms in zip(amounts, times, strict=True):
        grown = {"gaussians": {"gaussians": amount}, "views": {"views": amount}}.get(
            axis, {"width": round(amount**0.5), "height": round(amount**0.5)}
        )
        point = replace(POINT, axis=axis, series=series, scene=f"surface {amount}", **grown, **fixed)
        rows.append(replace(point, busy_ms=ms, wall_ms=ms + 0.05))
        rows.append(replace(point, pass_="forward + backward", busy_ms=2 * ms, wall_ms=2 * ms + 0.1))
    return rows


STUDY = [
    *line("gaussians", "512 x 512", (1000, 10_000, 100_000), (0.02, 0.03, 0.6)),
    *line("pixels", "37,000 Gaussians", (128**2, 256**2), (0.02, 0.05)),
    *line("views", "37,000 Gaussians at 512 x 512", (1, 8), (0.05, 0.3)),
    *line("stress", "giants", (1,), (0.4,)),
]

KERNEL = KernelRow(
    case="37k at 512 x 512, forward + backward", kernel="blend_tiles_backward_3", launches=1.0, us=50.0, bytes=2e7,
    flops=5e8, gb_s=400.0, gflop_s=10_000.0, floor_us=10.0, bound="flops", ceiling_gb_s=4250.0,
    ceiling_gflop_s=50_000.0, **ABOUT,
)  # fmt: skip
UNKNOWN = replace(
    KERNEL, kernel="vectorized_elementwise_kernel", us=30.0, bytes=None, flops=None, gb_s=None, gflop_s=None,
    floor_us=None, bound="",
)  # fmt: skip
KERNELS = [
    KERNEL, UNKNOWN, replace(UNKNOWN, kernel="Memset", us=0.1),
    replace(KERNEL, kernel="gather_records_3", us=8.0, flops=1e6, gflop_s=125.0, floor_us=4.7, bound="bytes"),
    replace(KERNEL, case="posing 37k", kernel="pose_mesh_gaussians", us=5.0),
]  # fmt: skip
