"""Gaussians on a mesh: the float inputs of `pose_on_mesh`, who rides on what, and the vectorised CPU kernels."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from oasis_kernels.posing import mesh_gaussians as kernels
from oasis_warp.ops._runtime.incidence import Incidence, incidence, riders_at_vertices
from oasis_warp.ops._runtime.launch import run_native
from oasis_warp.ops._runtime.poses import at_pose
from oasis_warp.ops._runtime.words import place, task_count


class Floats(NamedTuple):
    """The float inputs, or gradients by them; the last two are None where nothing rides on vertices."""

    vertices: Tensor
    barycentrics: Tensor
    vertex_quats: Tensor
    area_ratio: Tensor
    quats: Tensor
    scales: Tensor
    offsets: Tensor | None
    vertex_area_ratio: Tensor | None

    def contiguous(self) -> "Floats":
        return Floats(*(None if tensor is None else tensor.contiguous() for tensor in self))

    def at_pose(self, k: int) -> "Floats":
        """Those of one of several poses."""
        return Floats(*(t if shared else at_pose(t, k) for t, shared in zip(self, SHARED, strict=True)))


SHARED = (False, True, False, False, True, True, True, False)
"""Which of `Floats` all poses share; the others have an axis of poses in front where there are several."""


class Riders(NamedTuple):
    """Who rides on what, checked: P Gaussians on vertices, then Q on faces."""

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


def find_riders(
    faces: Tensor, face_index: Tensor, vertex_index: Tensor | None, n_vertices: int, *, transposed: bool
) -> Riders:
    """Look up the indices, with `at_vertices` where `transposed`.

    Raises:
        ValueError: an index is out of range.
    """
    corners = incidence("faces", faces, n_vertices, "vertices")
    on_faces = incidence("face_index", face_index, len(faces), "faces")
    on_vertices = None if vertex_index is None else incidence("vertex_index", vertex_index, n_vertices, "vertices")
    at_vertices = riders_at_vertices(faces, face_index, vertex_index, n_vertices) if transposed else None
    return Riders(n_vertices, corners, on_faces, on_vertices, at_vertices)


def _input_words(inputs: Floats, riders: Riders, half_powers: int, state: Tensor) -> dict[str, int]:
    n_vertices, n_faces, p, q = riders.n_vertices, len(riders.corners.table), riders.p, riders.q
    return {
        "n_vertices": n_vertices,
        "n_faces": n_faces,
        "n_on_vertices": p,
        "n_on_faces": q,
        "half_powers": half_powers,
        "vertices": place(inputs.vertices, 3 * n_vertices),
        "faces": place(riders.corners.table, 3 * n_faces, torch.int32),
        "vertex_index": place(None if riders.on_vertices is None else riders.on_vertices.table, p, torch.int32),
        "face_index": place(riders.on_faces.table, q, torch.int32),
        "barycentrics": place(inputs.barycentrics, 3 * q),
        "vertex_quats": place(inputs.vertex_quats, 4 * n_vertices),
        "area_ratio": place(inputs.area_ratio, n_faces),
        "vertex_area_ratio": place(inputs.vertex_area_ratio, n_vertices),
        "offsets": place(inputs.offsets, 3 * p),
        "quats": place(inputs.quats, 4 * (p + q)),
        "scales": place(inputs.scales, 3 * (p + q)),
        "state": place(state, kernels.STATE, torch.int64),
    }


def pose_vectorised(inputs: Floats, riders: Riders, half_powers: int, posed: Sequence[Tensor]) -> None:
    """Write means, quats and scales to `posed`."""
    total = riders.p + riders.q
    means, quats, scales = posed
    state = torch.zeros(kernels.STATE, dtype=torch.int64)
    words = _input_words(inputs, riders, half_powers, state) | {
        "means": place(means, 3 * total),
        "posed_quats": place(quats, 4 * total),
        "posed_scales": place(scales, 3 * total),
    }
    run_native(kernels.pose, words, task_count(riders.p, riders.q))


def pose_backward_vectorised(
    inputs: Floats, riders: Riders, half_powers: int, g_posed: Sequence[Tensor | None], g: Sequence[Tensor | None]
) -> None:
    """Write to `g`, in the order of `Floats`, the gradients that are wanted, given those by means, quats and scales."""
    n_vertices, n_faces, p, q = riders.n_vertices, len(riders.corners.table), riders.p, riders.q
    g_vertices, g_barycentrics, g_vertex_quats, g_area_ratio, g_quats, g_scales, g_offsets, g_vertex_area_ratio = g
    g_means, g_posed_quats, g_posed_scales = g_posed
    like, at_vertices = inputs.vertices, riders.at_vertices
    rows = None if at_vertices is None else like.new_empty((p + q, 8))
    weights = None if at_vertices is None else like.new_empty((q, 3))
    by_ratio = None if g_area_ratio is None else like.new_empty(q)
    state = torch.zeros(kernels.STATE, dtype=torch.int64)
    words = _input_words(inputs, riders, half_powers, state) | {
        "g_means": place(g_means, 3 * (p + q)),
        "g_posed_quats": place(g_posed_quats, 4 * (p + q)),
        "g_posed_scales": place(g_posed_scales, 3 * (p + q)),
        "vertex_starts": 0 if at_vertices is None else place(at_vertices.offsets, n_vertices + 1, torch.int32),
        "places": 0 if at_vertices is None else place(at_vertices.entries, p + 3 * q, torch.int32),
        "face_starts": place(riders.on_faces.offsets, n_faces + 1, torch.int32),
        "face_gaussians": place(riders.on_faces.entries, q, torch.int32),
        "gaussian_rows": place(rows, 8 * (p + q)),
        "weights": place(weights, 3 * q),
        "by_ratio": place(by_ratio, q),
        "g_vertices": place(g_vertices, 3 * n_vertices),
        "g_barycentrics": place(g_barycentrics, 3 * q),
        "g_vertex_quats": place(g_vertex_quats, 4 * n_vertices),
        "g_area_ratio": place(g_area_ratio, n_faces),
        "g_quats": place(g_quats, 4 * (p + q)),
        "g_scales": place(g_scales, 3 * (p + q)),
        "g_offsets": place(g_offsets, 3 * p),
        "g_vertex_area_ratio": place(g_vertex_area_ratio, n_vertices),
    }
    run_native(kernels.pose_backward, words, task_count(p, q, n_vertices, n_faces))
