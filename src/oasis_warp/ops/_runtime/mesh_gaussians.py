"""Mesh-bound Gaussians: which Gaussian is bound to which face or vertex, and the backends of `pose_on_mesh`."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.posing import barycentric as generic_kernels
from oasis_kernels.posing import mesh_gaussians as kernels
from oasis_warp.ops._runtime import launch
from oasis_warp.ops._runtime.incidence import Incidence, gaussians_at_vertices, incidence, sum_at_items
from oasis_warp.ops._runtime.launch import launch_ranges


class PosingInputs(NamedTuple):
    """The float inputs of `pose_on_mesh`, gradients by them, or flags for them."""

    vertices: Any
    barycentrics: Any
    vertex_quats: Any
    area_ratio: Any
    quats: Any
    scales: Any
    offsets: Any
    """This and the next are None without Gaussians on vertices."""
    vertex_area_ratio: Any


SHARED = PosingInputs(False, True, False, False, True, True, True, False)
"""Inputs that all poses share; the others have an axis of poses in front in a call for several."""


class MeshGaussians(NamedTuple):
    """P Gaussians on vertices, then Q on faces; all indices are checked."""

    n_vertices: int
    corners: Incidence
    on_faces: Incidence
    on_vertices: Incidence | None
    at_vertices: Incidence | None
    """For adjoints: of P + 3 Q entries, the vertex of each of the first and the corners of each of the others."""

    @property
    def p(self) -> int:
        return 0 if self.on_vertices is None else len(self.on_vertices.table)

    @property
    def q(self) -> int:
        return len(self.on_faces.table)


def find_gaussians(
    faces: Tensor, face_index: Tensor, vertex_index: Tensor | None, n_vertices: int, *, transposed: bool
) -> MeshGaussians:
    """The Gaussians that these indices bind, with `at_vertices` if `transposed`."""
    corners = incidence("faces", faces, n_vertices, "vertices")
    on_faces = incidence("face_index", face_index, len(faces), "faces")
    on_vertices = None if vertex_index is None else incidence("vertex_index", vertex_index, n_vertices, "vertices")
    at_vertices = gaussians_at_vertices(corners, on_faces, on_vertices) if transposed else None
    return MeshGaussians(n_vertices, corners, on_faces, on_vertices, at_vertices)


def _params(inputs: PosingInputs, gaussians: MeshGaussians, half_powers: int) -> dict[str, Any]:
    """The parameters that all float32 kernels share."""
    return {
        "n_vertices": gaussians.n_vertices, "n_faces": len(gaussians.corners.table), "n_on_vertices": gaussians.p,
        "n_on_faces": gaussians.q, "half_powers": half_powers, "faces": gaussians.corners.table,
        "vertex_index": None if gaussians.on_vertices is None else gaussians.on_vertices.table,
        "face_index": gaussians.on_faces.table, **inputs._asdict(),
    }  # fmt: skip


def _blocks(*items: int) -> int:
    return sum(launch.block_count(n, kernels.BLOCK) for n in items)


def pose_float32(inputs: PosingInputs, gaussians: MeshGaussians, half_powers: int, posed: Sequence[Tensor]) -> None:
    """Write means, quats and scales to `posed`: on the CPU for one pose, on CUDA for any number."""
    p, q, on_cuda = gaussians.p, gaussians.q, inputs.vertices.is_cuda
    inputs = PosingInputs(*(launch.aligned if on_cuda else launch.contiguous)(*inputs))
    means, quats, scales = posed
    params = _params(inputs, gaussians, half_powers) | {"means": means, "posed_quats": quats, "posed_scales": scales}
    if on_cuda:
        n_poses = inputs.vertices.shape[:-2].numel()
        stream = launch.current_stream(inputs.vertices.device)
        launch.run_cuda(kernels.pose_mesh_gaussians, params, n_poses * _blocks(p, q), stream)
    else:
        launch.run_native(kernels.pose, params | {"state": launch.phase_state(kernels.STATE)}, launch.task_count(p, q))


def backward_float32(
    inputs: PosingInputs,
    gaussians: MeshGaussians,
    half_powers: int,
    incoming: Sequence[Tensor | None],
    gradients: PosingInputs,
) -> PosingInputs:
    """The gradients from those by means, quats and scales.

    They are written to `gradients`, tensors without elements where none is needed, except for sums over several poses.
    """
    like, at_vertices, p, q = inputs.vertices, gaussians.at_vertices, gaussians.p, gaussians.q
    n_vertices, n_faces, n_poses = gaussians.n_vertices, len(gaussians.corners.table), like.shape[:-2].numel()
    batched = like.ndim == 3
    inputs = PosingInputs(*(launch.aligned if like.is_cuda else launch.contiguous)(*inputs))
    incoming = (launch.aligned if like.is_cuda else launch.contiguous)(*incoming)
    summed = [shared and batched and g.numel() > 0 for g, shared in zip(gradients, SHARED, strict=True)]
    by_pose = PosingInputs(
        *(g.new_empty((n_poses, *g.shape)) if s else g for g, s in zip(gradients, summed, strict=True))
    )
    needs_ratio = by_pose.area_ratio.numel() > 0
    params = _params(inputs, gaussians, half_powers) | {
        "g_means": incoming[0], "g_posed_quats": incoming[1], "g_posed_scales": incoming[2],
        "vertex_starts": None if at_vertices is None else at_vertices.offsets,
        "places": None if at_vertices is None else at_vertices.entries, "face_starts": gaussians.on_faces.offsets,
        "face_gaussians": gaussians.on_faces.entries,
        "gaussian_rows": None if at_vertices is None else like.new_empty((n_poses * (p + q), 8)),
        "weights": None if at_vertices is None else like.new_empty((n_poses * q, 3)),
        "by_ratio": like.new_empty(n_poses * q) if needs_ratio else None,
        **{f"g_{name}": g for name, g in by_pose._asdict().items()},
    }  # fmt: skip
    if like.is_cuda:
        stream = launch.current_stream(like.device)
        launch.run_cuda(kernels.pose_mesh_gaussians_backward, params, n_poses * _blocks(p, q), stream)
        blocks = _blocks(0 if at_vertices is None else n_vertices, n_faces if needs_ratio else 0)
        launch.run_cuda(kernels.gather_mesh_gaussians, params, n_poses * blocks, stream)
    else:
        params["state"] = launch.phase_state(kernels.STATE)
        launch.run_native(kernels.pose_backward, params, launch.task_count(p, q, n_vertices, n_faces))
    return PosingInputs(*(torch.sum(g, 0) if s else g for g, s in zip(by_pose, summed, strict=True)))


def _arguments(inputs: PosingInputs, gaussians: MeshGaussians, half_powers: int) -> list[Any]:
    """The first arguments of the generic kernels."""
    like, faces = inputs.quats, gaussians.corners.table
    on_vertices = faces.new_empty(0) if gaussians.on_vertices is None else gaussians.on_vertices.table
    ratio = like.new_empty(0) if inputs.vertex_area_ratio is None else inputs.vertex_area_ratio
    offsets = like.new_empty((0, 3)) if inputs.offsets is None else inputs.offsets
    tensors = (
        inputs.vertices, faces, on_vertices, gaussians.on_faces.table, inputs.barycentrics, inputs.vertex_quats,
        inputs.area_ratio, ratio, offsets, inputs.quats, inputs.scales,
    )  # fmt: skip
    return [gaussians.p, *tensors, half_powers]


def pose_float64(inputs: PosingInputs, gaussians: MeshGaussians, half_powers: int, posed: Sequence[Tensor]) -> None:
    """`pose_float32` of one pose by the generic kernels."""
    inputs = PosingInputs(*launch.contiguous(*inputs))
    arguments = [*_arguments(inputs, gaussians, half_powers), *posed]
    launch_ranges(generic_kernels.pose, gaussians.p + gaussians.q, arguments, like=inputs.quats)


def backward_float64(
    inputs: PosingInputs, gaussians: MeshGaussians, half_powers: int, incoming: Sequence[Tensor],
    gradients: PosingInputs, needs: PosingInputs,
) -> PosingInputs:  # fmt: skip
    """`backward_float32` of one pose by the generic kernels; `incoming` has no None."""
    inputs, p, q = PosingInputs(*launch.contiguous(*inputs)), gaussians.p, gaussians.q
    incoming = launch.contiguous(*incoming)

    def rows(needed: bool, n: int, width: int) -> Tensor:
        return inputs.quats.new_empty((n if needed else 0, width))

    # Rows for vertices: first those of Gaussians on vertices, then three for each on a face.
    vertex_rows = rows(needs.vertices, p + 3 * q, 3)
    quat_rows = rows(needs.vertex_quats, p + 3 * q, 4)
    ratio_rows = rows(needs.area_ratio, q, 1)
    vertex_ratio_rows = rows(needs.vertex_area_ratio, p, 1)
    outputs = (
        *incoming, vertex_rows, quat_rows, ratio_rows, vertex_ratio_rows, gradients.barycentrics,
        gradients.offsets.view(-1, 3), gradients.quats, gradients.scales,
    )  # fmt: skip
    arguments = [*_arguments(inputs, gaussians, half_powers), *outputs]
    launch_ranges(generic_kernels.pose_backward, p + q, arguments, like=inputs.quats)
    sums = {
        "vertices": (vertex_rows, gaussians.at_vertices),
        "vertex_quats": (quat_rows, gaussians.at_vertices),
        "area_ratio": (ratio_rows, gaussians.on_faces),
        "vertex_area_ratio": (vertex_ratio_rows, gaussians.on_vertices),
    }
    return gradients._replace(
        **{
            name: sum_at_items(summands, index).view_as(getattr(gradients, name))
            for name, (summands, index) in sums.items()
            if getattr(needs, name) and index is not None
        }
    )
