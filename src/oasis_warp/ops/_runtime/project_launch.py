"""Launches of the projection kernels: the vector ones for float32 on the CPU, the generic ones for all else.

Kernels do not know how long arrays are: `check_arrays` proves it before each launch.
"""

import ctypes
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from oasis_kernels.rasterize import projection as generic
from oasis_kernels.rasterize import projection_native
from oasis_kernels.rasterize.projection_native import CHUNK
from oasis_kernels.runtime.native import PHASE_WORDS
from oasis_warp.core.checks import FINITE_LIMIT
from oasis_warp.ops._runtime.launch import (
    SCALAR,
    VEC2,
    VEC3,
    VEC4,
    address,
    current_stream,
    even_cuts,
    launch_ranges,
    run_cuda,
    run_native,
    view,
    wait_for,
)
from oasis_warp.ops._runtime.pair_counts import own_slot
from oasis_warp.ops._runtime.records import counters_size, empty_records, table_words, tables
from oasis_warp.ops._runtime.rules import current_rules
from oasis_warp.ops._runtime.values import refuse_capture

CAMERA_SUM_BLOCK = 1024
"""Gaussians whose camera gradients one thread of the generic kernel adds up; fixed, so that threads change no sum."""
OUTPUTS = (
    ("means2d", 2, None), ("covars2d", 3, torch.float64), ("depths", 0, None), ("conics", 3, None),
    ("radii", 2, torch.int32),
)  # fmt: skip
"""Name, numbers a Gaussian (0: no axis for them) and type (None: that of the inputs) of what projection writes, besides
the records."""
Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
VECTORS = {dtype: {2: VEC2[dtype], 3: VEC3[dtype], 4: VEC4[dtype]} for dtype in (torch.float32, torch.float64)}
VECTORS[torch.int32] = {2: wp.vec2i, 4: wp.vec4i}


class Scene(NamedTuple):
    """What is projected, and by which cameras. Either `quats` and `scales` are None, or `covars` is."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def contiguous(self) -> "Scene":
        """The same for kernels, which know no strides."""
        return Scene(*(t.contiguous() if isinstance(t, Tensor) else t for t in self))


class Limits(NamedTuple):
    """What decides on drawing a Gaussian, besides its opacity."""

    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float


def as_float32(value: float) -> float:
    """`value` rounded to float32, so that float32 and float64 calls take the same decisions by it."""
    return ctypes.c_float(value).value


def empty_outputs(means: Tensor, viewmats: Tensor, width: int, height: int) -> Outputs:
    """Memory for `OUTPUTS` and the records."""
    shape = viewmats.shape[0], means.shape[0]
    means2d, covars2d, depths, conics, radii = (
        means.new_empty((*shape, size) if size else shape, dtype=dtype)
        for _name, size, dtype in OUTPUTS
    )
    return means2d, covars2d, depths, conics, radii, empty_records(means, *shape, width, height)


def _output_words(scene: Scene, out: Sequence[Tensor]) -> dict[str, int]:
    """Addresses of everything that projection writes."""
    words = {name: tensor.data_ptr() for (name, *_), tensor in zip(OUTPUTS, out, strict=False)}
    return words | table_words(out[-1], len(scene.viewmats) * len(scene.means), scene.means.dtype)


def check_arrays(scene: Scene, **others: tuple[Tensor | None, tuple[int, ...], torch.dtype]) -> None:
    """Refuse tensors whose shapes, types or devices do not belong together.

    Raises:
        ValueError: names the argument.
    """
    means, quats, scales, covars, viewmats, Ks, *_ = scene
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


def _words(scene: Scene, **others: Tensor | None) -> dict[str, int]:
    """Parameters of a native kernel: the scene, and other tensors by name, all of which the caller keeps alive."""
    tensors = {name: value for name, value in scene._asdict().items() if not isinstance(value, int)} | others
    words = {
        name: 0 if tensor is None else address(tensor, tensor.dtype, tensor.numel()) for name, tensor in tensors.items()
    }
    sizes = {"n": len(scene.means), "n_cameras": len(scene.viewmats), "width": scene.width, "height": scene.height}
    return words | sizes


def project_vectors(scene: Scene, opacities: Tensor, limits: Limits, out: Sequence[Tensor]) -> bool:
    """Fill `out` by the vector kernel; False where an input was not finite or outside its range."""
    rules = current_rules()
    near, far, radius_clip, eps2d = limits
    numbers = torch.tensor(
        [as_float32(near), as_float32(far), radius_clip, as_float32(eps2d), as_float32(rules.alpha_min),
         rules.extent_sigmas, FINITE_LIMIT],
        dtype=torch.float64,
    )  # fmt: skip
    state = torch.zeros(PHASE_WORDS + 1, dtype=torch.int64)
    words = _words(scene, opacities=opacities, limits=numbers, state=state, bad=state[PHASE_WORDS:])
    words |= _output_words(scene, out)
    run_native(projection_native.project(), words, -(-len(scene.means) // CHUNK))
    return not state[PHASE_WORDS]


def _cuda_words(scene: Scene, **others: Tensor | None) -> dict[str, int | float]:
    """Parameters of a CUDA kernel: the scene, and other tensors by name."""
    words: dict[str, int | float] = {
        name: 0 if tensor is None else tensor.data_ptr()
        for name, tensor in {
            "means": scene.means, "quats": scene.quats, "scales": scene.scales, "covars": scene.covars,
            "viewmats": scene.viewmats, "Ks": scene.Ks, **others,
        }.items()
    }  # fmt: skip
    sizes = {"n": len(scene.means), "n_cameras": len(scene.viewmats), "width": scene.width, "height": scene.height}
    return words | sizes


def project_cuda(scene: Scene, opacities: Tensor, limits: Limits, out: Sequence[Tensor], validate: bool) -> bool:
    """Fill `out` by the float32 CUDA kernel; where it is to `validate`, wait for what it says of the inputs.

    Returns:
        False where an input was found not finite or outside its range.
    """
    rules = current_rules()
    stream = current_stream(scene.means.device)
    bad = None
    if validate:
        refuse_capture()
        bad = own_slot()
        bad[0] = 0
    total = len(scene.viewmats) * len(scene.means)
    n_blocks = max(1, -(-total // projection_native.BLOCK))  # one clears the counters at least
    n_counters = counters_size(scene.means, len(scene.viewmats), scene.width, scene.height) // 4
    words = _cuda_words(scene, opacities=opacities, bad=bad) | _output_words(scene, out) | {
        "n_threads": n_blocks * projection_native.BLOCK, "n_counters": n_counters,
        "near": as_float32(limits.near_plane), "far": as_float32(limits.far_plane), "radius_clip": limits.radius_clip,
        "eps2d": as_float32(limits.eps2d), "alpha_min": as_float32(rules.alpha_min),
        "extent_sigmas": rules.extent_sigmas, "largest": FINITE_LIMIT,
    }  # fmt: skip
    run_cuda(projection_native.cuda_project(), words, n_blocks, stream)
    if bad is None:
        return True
    wait_for(stream)
    return not bad[0]


def backward_cuda(scene: Scene, radii: Tensor, incoming: "Incoming", out: Mapping[str, Tensor]) -> None:
    """Fill the gradients `out`, by name, by the float32 CUDA kernel."""
    n, n_cameras, g_viewmats = len(scene.means), len(scene.viewmats), out.get("viewmats")
    sums = None if g_viewmats is None else radii.new_empty((n_cameras * n, 12), dtype=torch.float64)
    words = _cuda_words(
        scene, radii=radii, g_means2d=incoming.means2d, g_covars2d=incoming.covars2d, g_depths=incoming.depths,
        g_cameras=sums, **{f"g_{name}": out.get(name) for name in ("means", "quats", "scales", "covars")},
    )  # fmt: skip
    run_cuda(
        projection_native.cuda_project_backward(), words, -(-n // projection_native.BLOCK),
        current_stream(radii.device),
    )  # fmt: skip
    if g_viewmats is not None and sums is not None:
        _fill_viewmats(g_viewmats, _sum_rows(sums, n, CAMERA_SUM_BLOCK))


def project_generic(scene: Scene, opacities: Tensor, limits: Limits, out: Sequence[Tensor]) -> None:
    """Fill `out` by the generic kernel."""
    rules = current_rules()
    records = tables(out[-1], len(scene.viewmats), len(scene.means), scene.means.dtype)
    launch_ranges(
        generic.project(SCALAR[scene.means.dtype]),
        even_cuts(len(scene.viewmats) * len(scene.means)),
        [
            len(scene.means), *_gaussian_views(scene), view(opacities), view(scene.viewmats), view(scene.Ks),
            scene.width, scene.height, as_float32(limits.near_plane), as_float32(limits.far_plane),
            as_float32(limits.eps2d), limits.radius_clip, as_float32(rules.alpha_min), rules.extent_sigmas,
            *(_rows(tensor, size) for (_name, size, _dtype), tensor in zip(OUTPUTS, out, strict=False)),
            _rows(records.sort_depths, 0), _rows(records.centers, 4), _rows(records.whitenings, 4),
            _rows(records.boxes, 4),
        ],
        like=scene.means,
    )  # fmt: skip


class Incoming(NamedTuple):
    """Gradients by what was projected; None stands for zeros."""

    means2d: Tensor | None
    covars2d: Tensor | None
    depths: Tensor | None

    def contiguous(self) -> "Incoming":
        """The same for kernels, which know no strides."""
        return Incoming(*(t if t is None else t.contiguous() for t in self))


def backward_vectors(scene: Scene, radii: Tensor, incoming: Incoming, out: Mapping[str, Tensor]) -> None:
    """Fill `out`, gradients by any of means, quats, scales, covars and viewmats, by the vector kernel."""
    chunks, n_cameras = -(-len(scene.means) // CHUNK), len(scene.viewmats)
    chunk_cameras = torch.empty(n_cameras if "viewmats" in out else 0, chunks, 12, dtype=torch.float64)
    state = torch.zeros(projection_native.STATE, dtype=torch.int64)
    words = _words(
        scene,
        radii=radii,
        **{f"g_{name}": gradient for name, gradient in incoming._asdict().items()},
        **{f"g_{name}": out.get(name) for name in ("means", "quats", "scales", "covars", "viewmats")},
        chunk_cameras=chunk_cameras,
        state=state,
    )
    run_native(projection_native.project_backward(), words, max(chunks, n_cameras))


def backward_generic(scene: Scene, radii: Tensor, incoming: Incoming, out: Mapping[str, Tensor]) -> None:
    """`backward_vectors` by the generic kernel, which works out what nobody asks for too."""
    n_cameras, n, dtype = len(scene.viewmats), len(scene.means), scene.means.dtype

    def given(gradient: Tensor | None, *size: int, dtype: torch.dtype = dtype) -> Tensor:
        return radii.new_zeros(n_cameras, n, *size, dtype=dtype) if gradient is None else gradient

    def filled(name: str, *size: int) -> Tensor:
        wanted, like = out.get(name), getattr(scene, name)
        return wanted if wanted is not None else scene.means.new_empty(0 if like is None else n, *size)

    g_viewmats = out.get("viewmats")
    sums = radii.new_empty(0 if g_viewmats is None else n_cameras * n, 12, dtype=torch.float64)
    launch_ranges(
        generic.project_backward(SCALAR[dtype]),
        even_cuts(n),
        [
            n, n_cameras, *_gaussian_views(scene), view(scene.viewmats), view(scene.Ks), scene.width, scene.height,
            _rows(radii, 2), _rows(given(incoming.means2d, 2), 2),
            _rows(given(incoming.covars2d, 3, dtype=torch.float64), 3), _rows(given(incoming.depths), 0),
            int(g_viewmats is not None), _rows(filled("means", 3), 3), _rows(filled("quats", 4), 4),
            _rows(filled("scales", 3), 3), view(filled("covars", 3, 3)), view(sums),
        ],
        like=scene.means,
    )  # fmt: skip
    if g_viewmats is not None:
        _fill_viewmats(g_viewmats, _sum_rows(sums, n, CAMERA_SUM_BLOCK))


def _gaussian_views(scene: Scene) -> list[object]:
    """Arguments means, quats, scales, covars, with_covars of the generic kernels; what is None is empty."""
    means = scene.means
    quats = means.new_empty(0, 4) if scene.quats is None else scene.quats
    scales = means.new_empty(0, 3) if scene.scales is None else scene.scales
    covars = means.new_empty(0, 3, 3) if scene.covars is None else scene.covars
    return [_rows(means, 3), _rows(quats, 4), _rows(scales, 3), view(covars), int(scene.covars is not None)]


def _rows(tensor: Tensor, size: int) -> object:
    """A contiguous tensor as an array of vectors of `size` numbers, or of numbers where it is 0."""
    return view(tensor.view(-1, size), VECTORS[tensor.dtype][size]) if size else view(tensor.view(-1))


def _fill_viewmats(g_viewmats: Tensor, sums: Tensor) -> None:
    """Add up sums over parts of the Gaussians, camera by camera, to the upper three rows; the last one is not read."""
    n_cameras = len(g_viewmats)
    parts = len(sums) // n_cameras
    g_viewmats[:, :3] = _sum_rows(sums, parts, parts).view(n_cameras, 3, 4)
    g_viewmats[:, 3] = 0


def _sum_rows(values: Tensor, n: int, block: int) -> Tensor:
    """Sums of blocks of rows of each group of `n` rows, in order."""
    tasks = len(values) // n * -(-n // block)
    sums = values.new_empty(tasks, values.shape[1])
    launch_ranges(
        generic.sum_blocks, [0, tasks], [n, block, view(values), view(sums)], like=values, lanes=values.shape[1]
    )
    return sums
