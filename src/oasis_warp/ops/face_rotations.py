"""Rotations and area ratios of faces and vertices between a rest mesh and a posed one."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels import face_rotation as kernels
from oasis_kernels import face_rotation_vectors as vector_kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._incidence import Incidence, incidence, sum_at_items
from oasis_warp.ops._launch import even_cuts, has_vectors, launch_ranges, run_native, view
from oasis_warp.ops._registration import adjoint, differentiable, needs_gradient, operator
from oasis_warp.ops._values import check_finite
from oasis_warp.ops._words import place, task_count


class FaceRotations(NamedTuple):
    """How the surface turned and grew. Quaternions are unit, wxyz, rest to posed."""

    vertex_quats: Float[Tensor, "V 4"]
    face_quats: Float[Tensor, "F 4"]
    area_ratio: Float[Tensor, "F"]
    """Posed area over rest area."""
    vertex_area_ratio: Float[Tensor, "V"]
    """The same of all faces round a vertex together; 1 where there is none."""


Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _outputs(rest: Tensor, posed: Tensor, faces: Tensor, keep: bool, validate: bool) -> Outputs:
    """Empty tensors for the results and for what the adjoint needs: signs of corners, sums at vertices."""
    n_vertices, n_faces = len(rest), len(faces)
    return (
        rest.new_empty((n_vertices, 4)),
        rest.new_empty((n_faces, 4)),
        rest.new_empty(n_faces),
        rest.new_empty(n_vertices),
        rest.new_empty(3 * n_faces if keep else 0),
        rest.new_empty((2 if keep else 0, n_vertices)),
    )


def _mesh_words(rest: Tensor, posed: Tensor, corners: Incidence, state: Tensor) -> dict[str, int]:
    """What the vectorised kernels are told of the two meshes."""
    n_vertices, n_faces = len(rest), len(corners.table)
    return {
        "n_vertices": n_vertices,
        "n_faces": n_faces,
        "rest_vertices": place(rest, 3 * n_vertices),
        "posed_vertices": place(posed, 3 * n_vertices),
        "faces": place(corners.table, 3 * n_faces, torch.int32),
        "offsets": place(corners.offsets, n_vertices + 1, torch.int32),
        "corners": place(corners.entries, 3 * n_faces, torch.int32),
        "state": place(state, vector_kernels.STATE, torch.int64),
    }


def _face_rotations(
    rest: Tensor, posed: Tensor, faces: Tensor, keep: bool, validate: bool
) -> Outputs:
    if validate:
        check_finite(rest_vertices=rest, posed_vertices=posed)
    corners = incidence("faces", faces, len(rest), "vertices")
    rest, posed = rest.contiguous(), posed.contiguous()
    n_vertices, n_faces = len(rest), len(faces)
    out = _outputs(rest, posed, faces, keep, validate)
    vertex_quats, face_quats, area_ratio, vertex_area_ratio, signs, sums = out
    if has_vectors(rest):
        rows_of_faces = rest.new_empty((n_faces, 8))
        state = torch.zeros(vector_kernels.STATE, dtype=torch.int64)
        words = _mesh_words(rest, posed, corners, state) | {
            "rows_of_faces": place(rows_of_faces, 8 * n_faces),
            "vertex_quats": place(vertex_quats, 4 * n_vertices),
            "face_quats": place(face_quats, 4 * n_faces),
            "area_ratio": place(area_ratio, n_faces),
            "vertex_area_ratio": place(vertex_area_ratio, n_vertices),
            "signs": place(signs if keep else None, 3 * n_faces),
            "sums": place(sums if keep else None, 2 * n_vertices),
        }
        run_native(vector_kernels.turn, words, task_count(n_faces, n_vertices))
        return out

    areas = rest.new_empty((n_faces, 3), dtype=torch.float64)
    launch_ranges(
        kernels.face_rotations,
        even_cuts(n_faces),
        [*map(view, (rest, posed, corners.table, face_quats, area_ratio, areas))],
        like=rest,
    )
    # What has no rotation of its own gets that of the largest face, so that a rigid motion still acts rigidly.
    fallback = areas[:, 0].argmax(keepdim=True) if n_faces else faces.new_empty(0, dtype=torch.int64)
    if n_faces:
        face_quats.copy_(torch.where(areas[:, :1] > 0, face_quats, face_quats[fallback]))
    launch_ranges(
        kernels.vertex_rotations,
        even_cuts(n_vertices),
        [
            *map(view, (face_quats, areas, corners.offsets, corners.entries, fallback.to(torch.int32))),
            *map(view, (vertex_quats, vertex_area_ratio, signs, sums)),
        ],
        like=rest,
    )
    return out


def _gradients(rest: Tensor, posed: Tensor, needs_rest: bool, needs_posed: bool) -> tuple[Tensor, Tensor]:
    return (
        rest.new_empty((len(rest) if needs_rest else 0, 3)),
        posed.new_empty((len(posed) if needs_posed else 0, 3)),
    )


def _fake_backward(rest: Tensor, posed: Tensor, *others: Any) -> tuple[Tensor, Tensor]:
    return _gradients(rest, posed, *others[-2:])


def _face_rotations_backward(
    rest: Tensor,
    posed: Tensor,
    faces: Tensor,
    vertex_quats: Tensor,
    face_quats: Tensor,
    vertex_area_ratio: Tensor,
    signs: Tensor,
    sums: Tensor,
    grad_vertex_quats: Tensor | None,
    grad_face_quats: Tensor | None,
    grad_area_ratio: Tensor | None,
    grad_vertex_area_ratio: Tensor | None,
    needs_rest: bool,
    needs_posed: bool,
) -> tuple[Tensor, Tensor]:
    corners = incidence("faces", faces, len(rest), "vertices")
    rest, posed = rest.contiguous(), posed.contiguous()
    n_vertices, n_faces = len(rest), len(faces)
    if has_vectors(rest):
        by_vertex_quats, by_face_quats, by_ratio, by_vertex_ratio = (
            None if grad is None else grad.contiguous()
            for grad in (grad_vertex_quats, grad_face_quats, grad_area_ratio, grad_vertex_area_ratio)
        )
        at_vertices = rest.new_empty((n_vertices, 8))
        rest_edges = rest.new_empty((n_faces, 8)) if needs_rest else None
        posed_edges = rest.new_empty((n_faces, 8)) if needs_posed else None
        state = torch.zeros(vector_kernels.STATE, dtype=torch.int64)
        found = _gradients(rest, posed, needs_rest, needs_posed)
        words = _mesh_words(rest, posed, corners, state) | {
            "vertex_quats": place(vertex_quats, 4 * n_vertices),
            "face_quats": place(face_quats, 4 * n_faces),
            "vertex_area_ratio": place(vertex_area_ratio, n_vertices),
            "signs": place(signs, 3 * n_faces),
            "sums": place(sums, 2 * n_vertices),
            "g_vertex_quats": place(by_vertex_quats, 4 * n_vertices),
            "g_face_quats": place(by_face_quats, 4 * n_faces),
            "g_area_ratio": place(by_ratio, n_faces),
            "g_vertex_area_ratio": place(by_vertex_ratio, n_vertices),
            "at_vertices": place(at_vertices, 8 * n_vertices),
            "rest_edges": place(rest_edges, 8 * n_faces),
            "posed_edges": place(posed_edges, 8 * n_faces),
            "g_rest": place(found[0] if needs_rest else None, 3 * n_vertices),
            "g_posed": place(found[1] if needs_posed else None, 3 * n_vertices),
        }
        run_native(vector_kernels.turn_backward, words, task_count(n_faces, n_vertices))
        return found

    def given(grad: Tensor | None, like: Tensor) -> Tensor:
        return torch.zeros_like(like) if grad is None else grad.contiguous()

    grad_sums = rest.new_empty((n_vertices, 6), dtype=torch.float64)
    launch_ranges(
        kernels.vertex_rotations_backward,
        even_cuts(n_vertices),
        [
            *map(view, (vertex_quats, vertex_area_ratio, sums, given(grad_vertex_quats, vertex_quats))),
            *map(view, (given(grad_vertex_area_ratio, vertex_area_ratio), grad_sums)),
        ],
        like=rest,
    )
    rest_rows = rest.new_empty((n_faces if needs_rest else 0, 9))
    posed_rows = rest.new_empty((n_faces if needs_posed else 0, 9))
    by_ratio = torch.zeros_like(face_quats[:, 0]) if grad_area_ratio is None else grad_area_ratio.contiguous()
    launch_ranges(
        kernels.face_rotations_backward,
        even_cuts(n_faces),
        [
            *map(view, (rest, posed, corners.table, face_quats, signs, grad_sums)),
            *map(view, (given(grad_face_quats, face_quats), by_ratio, rest_rows, posed_rows)),
        ],
        like=rest,
    )
    return (
        sum_at_items(rest_rows.view(-1, 3), corners) if needs_rest else rest_rows.view(-1, 3),
        sum_at_items(posed_rows.view(-1, 3), corners) if needs_posed else posed_rows.view(-1, 3),
    )


_operator = operator("face_rotations", _face_rotations, _outputs)
_adjoint = adjoint("face_rotations_backward", _face_rotations_backward, _fake_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    vertex_quats, face_quats, _, vertex_area_ratio, signs, sums = output
    ctx.mark_non_differentiable(signs, sums)
    ctx.save_for_backward(*inputs[:3], vertex_quats, face_quats, vertex_area_ratio, signs, sums)


def _backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    needs_rest, needs_posed = ctx.needs_input_grad[:2]
    rest, posed = _adjoint(*ctx.saved_tensors, *grads[:4], needs_rest, needs_posed)
    return (
        rest if needs_rest else None,  # rest
        posed if needs_posed else None,  # posed
        None,  # faces
        None,  # keep
        None,  # validate
    )


differentiable(_operator, _backward, _save)


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
    where there is no face at all. The area ratio is (A' + d) / (A + d), d = 0.5e-6 times the longest rest edge squared;
    that of a vertex has the sums over its faces above and below.

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
    check_shape("faces", faces, "F", 3, hint="Three vertex indices a face.")
    keep = needs_gradient(rest_vertices, posed_vertices)
    return FaceRotations(*_operator(rest_vertices, posed_vertices, faces, keep, validate)[:4])
