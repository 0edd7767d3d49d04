"""Backends of the projection: vector kernels for float32 on the CPU, CUDA kernels, generic ones for all else.

Kernels do not know how long arrays are: `check_arrays` proves it before each launch.
"""

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.rasterize import projection as generic
from oasis_kernels.rasterize import projection_native
from oasis_kernels.rasterize.projection_native import CHUNK
from oasis_kernels.runtime.native import PHASE_WORDS
from oasis_warp.ops._runtime.launch import (
    SCALAR,
    block_count,
    contiguous,
    current_stream,
    launch_ranges,
    phase_state,
    run_cuda,
    run_native,
    vectors,
    wait_for,
)
from oasis_warp.ops._runtime.pair_counts import thread_slot
from oasis_warp.ops._runtime.records import counters_size, empty_records, table_params, tables
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.values import refuse_capture
from oasis_warp.ops.checks import FINITE_LIMIT

CAMERA_SUM_BLOCK = 1024
"""Gaussians whose camera gradients one thread adds up; fixed, so that the number of threads changes no sum."""
OUTPUTS = (
    ("means2d", 2, None), ("covars2d", 3, torch.float64), ("depths", 0, None), ("conics", 3, None),
    ("radii", 2, torch.int32),
)  # fmt: skip
"""Name, numbers per Gaussian (0: no axis for them) and type (None: that of the inputs) of the outputs, besides the
records."""
Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


class ProjectionInputs(NamedTuple):
    """Gaussians and cameras. Either `quats` and `scales` are None, or `covars` is."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    ortho: int
    """1 for orthographic cameras."""

    def contiguous(self) -> "ProjectionInputs":
        """The same in contiguous memory, which kernels need."""
        return ProjectionInputs(*contiguous(*self[:6]), self.width, self.height, self.ortho)

    def params(self, **others: Any) -> dict[str, Any]:
        """Parameters of the float32 kernels: these, the sizes and others."""
        return {**self._asdict(), "n": len(self.means), "n_cameras": len(self.viewmats), **others}


class Limits(NamedTuple):
    """Which Gaussians are drawn, besides their opacity."""

    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float


def as_float32(value: float) -> float:
    """`value` rounded to float32, so that float32 and float64 calls decide alike."""
    return ctypes.c_float(value).value


def empty_outputs(means: Tensor, viewmats: Tensor, width: int, height: int) -> Outputs:
    """Memory for `OUTPUTS` and the records."""
    shape = viewmats.shape[0], means.shape[0]
    means2d, covars2d, depths, conics, radii = (
        means.new_empty((*shape, size) if size else shape, dtype=dtype) for _name, size, dtype in OUTPUTS
    )
    return means2d, covars2d, depths, conics, radii, empty_records(means, *shape, width, height)


def _output_params(scene: ProjectionInputs, out: Sequence[Tensor]) -> dict[str, Any]:
    params = {name: tensor for (name, *_), tensor in zip(OUTPUTS, out, strict=False)}
    return params | table_params(out[-1], len(scene.viewmats) * len(scene.means), scene.means.dtype)


def check_arrays(scene: ProjectionInputs, **others: tuple[Tensor | None, tuple[int, ...], torch.dtype]) -> None:
    """Refuse tensors whose shapes, types or devices do not belong together."""
    means, quats, scales, covars, viewmats, Ks = scene[:6]
    n, c, dtype = means.shape[0], viewmats.shape[0], means.dtype
    if (quats is None or scales is None) if covars is None else not (quats is None and scales is None):
        raise ValueError("covars: expected either covars, or quats and scales, got neither or both.")
    expected = (
        ("means", means, (n, 3), dtype), ("quats", quats, (n, 4), dtype), ("scales", scales, (n, 3), dtype),
        ("covars", covars, (n, 3, 3), dtype), ("viewmats", viewmats, (c, 4, 4), dtype), ("Ks", Ks, (c, 3, 3), dtype),
        *((name, *other) for name, other in others.items()),
    )  # fmt: skip
    for name, tensor, shape, kind in expected:
        if tensor is not None and (tensor.shape != shape or tensor.dtype != kind or tensor.device != means.device):
            raise ValueError(
                f"{name}: expected shape {list(shape)}, {kind} on {means.device}, "
                f"got {list(tensor.shape)}, {tensor.dtype} on {tensor.device}."
            )


def project_vectors(
    scene: ProjectionInputs, opacities: Tensor, limits: Limits, out: Sequence[Tensor], validate: bool
) -> bool:
    """Fill `out` by the vector kernel; False if an input is not finite or outside its range."""
    rules = current_rules()
    near, far, radius_clip, eps2d = limits
    numbers = torch.tensor(
        [as_float32(near), as_float32(far), radius_clip, as_float32(eps2d), as_float32(rules.alpha_min),
         rules.extent_sigmas, FINITE_LIMIT],
        dtype=torch.float64,
    )  # fmt: skip
    state = phase_state(PHASE_WORDS + 1)
    params = scene.params(opacities=opacities, limits=numbers, state=state, bad=state[PHASE_WORDS:])
    run_native(projection_native.project, params | _output_params(scene, out), block_count(len(scene.means), CHUNK))
    return not state[PHASE_WORDS]


def project_cuda(
    scene: ProjectionInputs, opacities: Tensor, limits: Limits, out: Sequence[Tensor], validate: bool
) -> bool:
    """Fill `out` by the CUDA kernel; with `validate`, wait for it: False as in `project_vectors`."""
    rules = current_rules()
    stream = current_stream(scene.means.device)
    bad = None
    if validate:
        refuse_capture()
        bad = thread_slot()
        bad[0] = 0
    total = len(scene.viewmats) * len(scene.means)
    n_blocks = max(1, block_count(total, projection_native.BLOCK))  # at least one, which clears the counters
    n_counters = counters_size(scene.means, len(scene.viewmats), scene.width, scene.height) // 4
    params = _output_params(scene, out) | scene.params(
        opacities=opacities, bad=bad, n_threads=n_blocks * projection_native.BLOCK, n_counters=n_counters,
        near=as_float32(limits.near_plane), far=as_float32(limits.far_plane), radius_clip=limits.radius_clip,
        eps2d=as_float32(limits.eps2d), alpha_min=as_float32(rules.alpha_min), extent_sigmas=rules.extent_sigmas,
        largest=FINITE_LIMIT, colors=None, n_colors=0, backgrounds=None, n_backgrounds=0,
    )  # fmt: skip
    run_cuda(projection_native.cuda_project, params, n_blocks, stream)
    if bad is None:
        return True
    wait_for(stream)
    return not bad[0]


def project_generic(scene: ProjectionInputs, opacities: Tensor, limits: Limits, out: Sequence[Tensor]) -> None:
    """Fill `out` by the generic kernel, which does not check values."""
    rules = current_rules()
    records = tables(out[-1], len(scene.viewmats), len(scene.means), scene.means.dtype)
    launch_ranges(
        generic.project(SCALAR[scene.means.dtype]),
        len(scene.viewmats) * len(scene.means),
        [
            len(scene.means), *_gaussian_views(scene), opacities, scene.viewmats, scene.Ks, scene.ortho, scene.width,
            scene.height, as_float32(limits.near_plane), as_float32(limits.far_plane), as_float32(limits.eps2d),
            limits.radius_clip, as_float32(rules.alpha_min), rules.extent_sigmas,
            *(vectors(t) if size else t.view(-1) for (_, size, _), t in zip(OUTPUTS, out, strict=False)),
            records.sort_depths.view(-1), vectors(records.centers), vectors(records.whitenings), vectors(records.boxes),
        ],
        like=scene.means,
    )  # fmt: skip


class ProjectionGradients(NamedTuple):
    """Gradients by inputs, empty where they are not needed, or flags for them."""

    means: Any
    quats: Any
    scales: Any
    covars: Any
    viewmats: Any


class Incoming(NamedTuple):
    """Gradients by outputs, contiguous; None stands for zeros."""

    g_means2d: Tensor | None
    g_covars2d: Tensor | None
    g_depths: Tensor | None


def backward_cuda(
    scene: ProjectionInputs, radii: Tensor, incoming: Incoming, gradients: ProjectionGradients, needs_cameras: bool
) -> None:
    """Fill the gradients by the CUDA kernel."""
    n, n_cameras = len(scene.means), len(scene.viewmats)
    sums = radii.new_empty((n_cameras * n, 12), dtype=torch.float64) if needs_cameras else None
    params = scene.params(
        radii=radii, g_cameras=sums, **incoming._asdict(), **{f"g_{k}": g for k, g in gradients._asdict().items()}
    )
    n_blocks = block_count(n, projection_native.BLOCK)
    run_cuda(projection_native.cuda_project_backward, params, n_blocks, current_stream(radii.device))
    if sums is not None:
        fill_viewmats(gradients.viewmats, sums, n)


def backward_vectors(
    scene: ProjectionInputs, radii: Tensor, incoming: Incoming, gradients: ProjectionGradients, needs_cameras: bool
) -> None:
    """Fill the gradients by the vector kernel."""
    chunks, n_cameras = block_count(len(scene.means), CHUNK), len(scene.viewmats)
    params = scene.params(
        radii=radii, chunk_cameras=torch.empty(n_cameras if needs_cameras else 0, chunks, 12, dtype=torch.float64),
        state=phase_state(projection_native.STATE), **incoming._asdict(),
        **{f"g_{k}": g for k, g in gradients._asdict().items()},
    )  # fmt: skip
    run_native(projection_native.project_backward, params, max(chunks, n_cameras))


def backward_generic(
    scene: ProjectionInputs, radii: Tensor, incoming: Incoming, gradients: ProjectionGradients, needs_cameras: bool
) -> None:
    """Fill the gradients by the generic kernel, which computes those that are not needed too."""
    n_cameras, n, dtype = len(scene.viewmats), len(scene.means), scene.means.dtype

    def given(gradient: Tensor | None, *size: int, dtype: torch.dtype = dtype) -> Tensor:
        return radii.new_zeros(n_cameras, n, *size, dtype=dtype) if gradient is None else gradient

    def filled(name: str, *size: int) -> Tensor:
        gradient, like = getattr(gradients, name), getattr(scene, name)
        return gradient if gradient.numel() else scene.means.new_empty(0 if like is None else n, *size)

    sums = radii.new_empty(n_cameras * n if needs_cameras else 0, 12, dtype=torch.float64)
    launch_ranges(
        generic.project_backward(SCALAR[dtype]),
        n,
        [
            n, n_cameras, *_gaussian_views(scene), scene.viewmats, scene.Ks, scene.ortho, scene.width, scene.height,
            vectors(radii), vectors(given(incoming.g_means2d, 2)),
            vectors(given(incoming.g_covars2d, 3, dtype=torch.float64)), given(incoming.g_depths).view(-1),
            int(needs_cameras), vectors(filled("means", 3)), vectors(filled("quats", 4)), vectors(filled("scales", 3)),
            filled("covars", 3, 3), sums,
        ],
        like=scene.means,
    )  # fmt: skip
    if needs_cameras:
        fill_viewmats(gradients.viewmats, sums, n)


def _gaussian_views(scene: ProjectionInputs) -> list[object]:
    """Arguments means, quats, scales, covars, with_covars of the generic kernels; what is None is empty."""
    means = scene.means
    quats = means.new_empty(0, 4) if scene.quats is None else scene.quats
    scales = means.new_empty(0, 3) if scene.scales is None else scene.scales
    covars = means.new_empty(0, 3, 3) if scene.covars is None else scene.covars
    return [vectors(means), vectors(quats), vectors(scales), covars, int(scene.covars is not None)]


def fill_viewmats(g_viewmats: Tensor, by_gaussian: Tensor, n: int) -> None:
    """Add up the parts [C * n, 12] of the Gaussians, camera by camera, to the upper rows; the last row is not read."""
    n_cameras, sums = len(g_viewmats), _sum_rows(by_gaussian, n, CAMERA_SUM_BLOCK)
    parts = len(sums) // n_cameras
    g_viewmats[:, :3] = _sum_rows(sums, parts, parts).view(n_cameras, 3, 4)
    g_viewmats[:, 3] = 0


def _sum_rows(values: Tensor, n: int, block: int) -> Tensor:
    """Sums of blocks of rows of each group of `n` rows, in order."""
    tasks = len(values) // n * -(-n // block)
    sums = values.new_empty(tasks, values.shape[1])
    launch_ranges(generic.sum_blocks, [0, tasks], [n, block, values, sums], like=values, lanes=values.shape[1])
    return sums
