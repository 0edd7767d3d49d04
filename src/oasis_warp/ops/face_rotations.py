"""Rotations and area ratios of faces and vertices between a rest mesh and a posed one."""

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_kernels import face_rotation as kernels
from oasis_warp.core.checks import check_finite, check_float, check_shape
from oasis_warp.ops._incidence import Incidence, incidence, sum_at_items
from oasis_warp.ops._launch import even_cuts, launch_ranges, view


class FaceRotations(NamedTuple):
    """How the surface turned and grew. Quaternions are unit, wxyz, rest to posed."""

    vertex_quats: Float[Tensor, "V 4"]
    face_quats: Float[Tensor, "F 4"]
    area_ratio: Float[Tensor, "F"]
    """Posed area over rest area."""


class _FaceRotations(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rest_vertices, posed_vertices, corners: Incidence):
        faces = corners.table
        n_faces, n_vertices = len(faces), len(rest_vertices)
        face_quats = rest_vertices.new_empty((n_faces, 4))
        area_ratio = rest_vertices.new_empty(n_faces)
        weights = rest_vertices.new_empty(n_faces, dtype=torch.float64)
        launch_ranges(
            kernels.face_rotations,
            even_cuts(n_faces),
            [
                view(rest_vertices),
                view(posed_vertices),
                view(faces),
                view(face_quats),
                view(area_ratio),
                view(weights),
            ],
            like=rest_vertices,
        )
        # What has no rotation of its own gets that of the largest face, so that a rigid motion still acts rigidly.
        fallback = weights.argmax(keepdim=True) if n_faces else weights.new_empty(0, dtype=torch.int64)
        if n_faces:
            face_quats = torch.where(weights[:, None] > 0, face_quats, face_quats[fallback])

        vertex_quats = rest_vertices.new_empty((n_vertices, 4))
        reference = faces.new_empty(n_vertices)
        norms = weights.new_empty(n_vertices)
        launch_ranges(
            kernels.vertex_rotations,
            even_cuts(n_vertices),
            [
                view(face_quats),
                view(weights),
                view(corners.offsets),
                view(corners.entries),
                view(fallback.to(torch.int32)),
                view(vertex_quats),
                view(reference),
                view(norms),
            ],
            like=rest_vertices,
        )
        ctx.corners = corners
        ctx.save_for_backward(
            rest_vertices, posed_vertices, face_quats, vertex_quats, weights, reference, norms
        )
        return vertex_quats, face_quats, area_ratio

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_vertex_quats, grad_face_quats, grad_area_ratio):
        rest_vertices, posed_vertices, face_quats, vertex_quats, weights, reference, norms = ctx.saved_tensors
        faces = ctx.corners.table
        grad_sums = norms.new_empty((len(norms), 4))
        launch_ranges(
            kernels.vertex_rotations_backward,
            even_cuts(len(norms)),
            [
                view(vertex_quats),
                view(norms),
                view(grad_vertex_quats.contiguous()),
                view(grad_sums, wp.vec4d),
            ],
            like=norms,
        )
        needs_rest, needs_posed, _ = ctx.needs_input_grad
        rest_rows = rest_vertices.new_empty((len(faces) if needs_rest else 0, 9))
        posed_rows = rest_vertices.new_empty((len(faces) if needs_posed else 0, 9))
        launch_ranges(
            kernels.face_rotations_backward,
            even_cuts(len(faces)),
            [
                view(rest_vertices),
                view(posed_vertices),
                view(faces),
                view(face_quats),
                view(weights),
                view(reference),
                view(grad_sums, wp.vec4d),
                view(grad_face_quats.contiguous()),
                view(grad_area_ratio.contiguous()),
                view(rest_rows),
                view(posed_rows),
            ],
            like=norms,
        )
        return (
            sum_at_items(rest_rows.view(-1, 3), ctx.corners) if needs_rest else None,  # rest_vertices
            sum_at_items(posed_rows.view(-1, 3), ctx.corners) if needs_posed else None,  # posed_vertices
            None,  # corners
        )


def face_rotations(
    rest_vertices: Float[Tensor, "V 3"],
    posed_vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    *,
    validate: bool = True,
) -> FaceRotations:
    """Rotation of every face and vertex from rest to posed, and the growth of every face.

    A face turns by the rotation that takes its normal to the posed normal and, in its plane, is the polar factor of the
    map of its edges (OASIS, MM '26, appendix): the same whichever corner is listed first. Its quaternion has w >= 0.
    A vertex turns by the normalised mean of its faces' quaternions, weighted with their areas at rest and sign-aligned
    to the largest of them. A face that is flat (area 0 but for rounding) at rest or posed has no weight and no gradient
    and gets the rotation of the face with the largest rest area, as do vertices without any other face; the identity
    where there is no face at all. The area ratio is (A' + d) / (A + d), d = 0.5e-6 times the longest rest edge squared.

    Differentiable in `rest_vertices` and `posed_vertices`. Which faces touch a vertex is computed once for each `faces`
    tensor and remembered while it lives.

    Args:
        rest_vertices: Vertices at rest, any unit of length, shape [V, 3], float32 or float64.
        posed_vertices: The same vertices posed, shape [V, 3].
        faces: Vertex indices, shape [F, 3]; F may be 0.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    sizes: dict[str, int] = {}
    check_shape("rest_vertices", rest_vertices, "V", 3, sizes=sizes)
    check_shape("posed_vertices", posed_vertices, "V", 3, sizes=sizes, hint="One for each rest vertex.")
    check_float("rest_vertices", rest_vertices)
    check_float("posed_vertices", posed_vertices, rest_vertices)
    if validate:
        check_finite(rest_vertices=rest_vertices, posed_vertices=posed_vertices)
    check_shape("faces", faces, "F", 3, hint="Three vertex indices a face.")
    corners = incidence("faces", faces, len(rest_vertices), "vertices")
    return FaceRotations(*_FaceRotations.apply(rest_vertices.contiguous(), posed_vertices.contiguous(), corners))
