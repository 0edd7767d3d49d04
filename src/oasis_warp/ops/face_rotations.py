"""Rotations and area ratios of faces and vertices between a rest mesh and a posed one."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.posing import face_rotation as kernels
from oasis_kernels.posing import face_rotation_native as native_kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._runtime.incidence import Incidence, incidence, sum_at_items
from oasis_warp.ops._runtime.launch import (
    current_stream,
    even_cuts,
    has_cuda_kernels,
    has_vectors,
    launch_ranges,
    run_cuda,
    run_native,
    view,
)
from oasis_warp.ops._runtime.poses import at_pose, pose_by_pose, summed_over_poses
from oasis_warp.ops._runtime.registration import adjoint, differentiable, needs_gradient, operator
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops._runtime.words import aligned, place, pointer, task_count
from oasis_warp.ops.rest_mesh import RestMesh


class FaceRotations(NamedTuple):
    """How the surface turned and grew. Quaternions are unit, wxyz, rest to posed."""

    vertex_quats: Float[Tensor, "*B V 4"]
    face_quats: Float[Tensor, "*B F 4"]
    area_ratio: Float[Tensor, "*B F"]
    """Posed area over rest area."""
    vertex_area_ratio: Float[Tensor, "*B V"]
    """The same of all faces round a vertex together; 1 where there is none."""


Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _outputs(
    rest: Tensor, posed: Tensor, faces: Tensor, triangles: Tensor | None, keep: bool, validate: bool
) -> Outputs:
    """Empty tensors for the results and for what the adjoint needs: signs of corners, sums at vertices."""
    batch, n_vertices, n_faces = posed.shape[:-2], len(rest), len(faces)
    return (
        rest.new_empty((*batch, n_vertices, 4)),
        rest.new_empty((*batch, n_faces, 4)),
        rest.new_empty((*batch, n_faces)),
        rest.new_empty((*batch, n_vertices)),
        rest.new_empty((*batch, 3 * n_faces if keep else 0)),
        rest.new_empty((*batch, 2 if keep else 0, n_vertices)),
    )


def _mesh_words(
    rest: Tensor, posed: Tensor, corners: Incidence, triangles: Tensor | None, state: Tensor
) -> dict[str, int]:
    """What the vectorised kernels are told of the two meshes."""
    n_vertices, n_faces = len(rest), len(corners.table)
    return {
        "n_vertices": n_vertices,
        "n_faces": n_faces,
        "rest_vertices": place(rest, 3 * n_vertices),
        "posed_vertices": place(posed, 3 * n_vertices),
        "faces": place(corners.table, 3 * n_faces, torch.int32),
        "triangles": place(triangles, native_kernels.TRIANGLE * n_faces),
        "offsets": place(corners.offsets, n_vertices + 1, torch.int32),
        "corners": place(corners.entries, 3 * n_faces, torch.int32),
        "state": place(state, native_kernels.STATE, torch.int64),
    }


def _blocks(n: int) -> int:
    """Of a CUDA kernel, for so many faces or vertices."""
    return -(-n // native_kernels.BLOCK)


def _face_rotations(
    rest: Tensor, posed: Tensor, faces: Tensor, triangles: Tensor | None, keep: bool, validate: bool
) -> Outputs:
    if validate:
        check_finite(rest_vertices=rest, posed_vertices=posed)
    corners = incidence("faces", faces, len(rest), "vertices")
    rest, posed, triangles = rest.contiguous(), posed.contiguous(), aligned(triangles)
    n_vertices, n_faces = len(rest), len(faces)
    out = _outputs(rest, posed, faces, triangles, keep, validate)
    if has_cuda_kernels(rest):
        _turn_on_cuda(rest, posed, corners, triangles, out if keep else (*out[:4], None, None))
        return out
    if posed.ndim == 3:
        pose_by_pose(
            out, len(posed), lambda k: _face_rotations(rest, posed[k], faces, triangles, keep, validate=False)
        )
        return out

    vertex_quats, face_quats, area_ratio, vertex_area_ratio, signs, sums = out
    if has_vectors(rest):
        rows_of_faces = rest.new_empty((n_faces, 8))
        state = torch.zeros(native_kernels.STATE, dtype=torch.int64)
        words = _mesh_words(rest, posed, corners, triangles, state) | {
            "rows_of_faces": place(rows_of_faces, 8 * n_faces),
            "vertex_quats": place(vertex_quats, 4 * n_vertices),
            "face_quats": place(face_quats, 4 * n_faces),
            "area_ratio": place(area_ratio, n_faces),
            "vertex_area_ratio": place(vertex_area_ratio, n_vertices),
            "signs": place(signs if keep else None, 3 * n_faces),
            "sums": place(sums if keep else None, 2 * n_vertices),
        }
        run_native(native_kernels.turn, words, task_count(n_faces, n_vertices))
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


def _cuda_words(rest: Tensor, posed: Tensor, corners: Incidence, triangles: Tensor | None) -> dict[str, int]:
    """What the CUDA kernels are told of the two meshes."""
    return {
        "n_vertices": len(rest),
        "n_faces": len(corners.table),
        "rest_vertices": pointer(rest),
        "posed_vertices": pointer(posed),
        "faces": pointer(corners.table),
        "triangles": pointer(triangles),
        "offsets": pointer(corners.offsets),
        "corners": pointer(corners.entries),
    }


def _turn_on_cuda(
    rest: Tensor, posed: Tensor, corners: Incidence, triangles: Tensor | None, out: Sequence[Tensor | None]
) -> None:
    n_vertices, n_faces = len(rest), len(corners.table)
    n_poses = len(posed) if posed.ndim == 3 else 1
    blocks = n_poses * _blocks(n_faces)
    rows_of_faces = rest.new_empty((n_poses * n_faces, 8))
    flat_blocks = corners.table.new_empty(blocks)
    vertex_quats, face_quats, area_ratio, vertex_area_ratio, signs, sums = map(pointer, out)
    words = _cuda_words(rest, posed, corners, triangles) | {
        "face_quats": face_quats,
        "area_ratio": area_ratio,
        "rows_of_faces": pointer(rows_of_faces),
        "flat_blocks": pointer(flat_blocks),
        "vertex_quats": vertex_quats,
        "vertex_area_ratio": vertex_area_ratio,
        "signs": signs,
        "sums": sums,
    }
    stream = current_stream(rest.device)
    run_cuda(native_kernels.turn_faces, words, blocks, stream)
    run_cuda(native_kernels.turn_vertices, words, n_poses * _blocks(n_vertices), stream)


def _gradients(rest: Tensor, posed: Tensor, needs_rest: bool, needs_posed: bool) -> tuple[Tensor, Tensor]:
    return (
        rest.new_empty((len(rest) if needs_rest else 0, 3)),
        posed.new_empty((len(posed) if needs_posed else 0, *posed.shape[1:])),
    )


def _fake_backward(rest: Tensor, posed: Tensor, *others: Any) -> tuple[Tensor, Tensor]:
    return _gradients(rest, posed, *others[-2:])


def _face_rotations_backward(
    rest: Tensor,
    posed: Tensor,
    faces: Tensor,
    triangles: Tensor | None,
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
    rest, posed, triangles = rest.contiguous(), posed.contiguous(), aligned(triangles)
    n_vertices, n_faces = len(rest), len(faces)
    kept = vertex_quats, face_quats, vertex_area_ratio, signs, sums
    grads = grad_vertex_quats, grad_face_quats, grad_area_ratio, grad_vertex_area_ratio
    if has_cuda_kernels(rest):
        return _turn_backward_on_cuda(rest, posed, corners, triangles, kept, grads, needs_rest, needs_posed)
    if posed.ndim == 3:
        found = _gradients(rest, posed, needs_rest, needs_posed)

        def one(k: int) -> tuple[Tensor, Tensor]:
            of_pose = (at_pose(part, k) for part in (*kept, *grads))
            return _face_rotations_backward(rest, posed[k], faces, triangles, *of_pose, needs_rest, needs_posed)

        pose_by_pose(found, len(posed), one, shared=(True, False))
        return found

    if has_vectors(rest):
        by_vertex_quats, by_face_quats, by_ratio, by_vertex_ratio = (
            None if grad is None else grad.contiguous()
            for grad in (grad_vertex_quats, grad_face_quats, grad_area_ratio, grad_vertex_area_ratio)
        )
        at_vertices = rest.new_empty((n_vertices, 8))
        rest_edges = rest.new_empty((n_faces, 8)) if needs_rest else None
        posed_edges = rest.new_empty((n_faces, 8)) if needs_posed else None
        state = torch.zeros(native_kernels.STATE, dtype=torch.int64)
        found = _gradients(rest, posed, needs_rest, needs_posed)
        words = _mesh_words(rest, posed, corners, triangles, state) | {
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
        run_native(native_kernels.turn_backward, words, task_count(n_faces, n_vertices))
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


def _turn_backward_on_cuda(
    rest: Tensor,
    posed: Tensor,
    corners: Incidence,
    triangles: Tensor | None,
    kept: Sequence[Tensor],
    grads: Sequence[Tensor | None],
    needs_rest: bool,
    needs_posed: bool,
) -> tuple[Tensor, Tensor]:
    n_vertices, n_faces = len(rest), len(corners.table)
    batched = posed.ndim == 3
    n_poses = len(posed) if batched else 1
    vertex_quats, face_quats, vertex_area_ratio, signs, sums = kept
    given = [aligned(grad) for grad in grads]
    rest_edges, posed_edges = (
        rest.new_empty((n_poses * n_faces, 8)) if needed else None for needed in (needs_rest, needs_posed)
    )
    by_rest = rest.new_empty((*posed.shape[:-2], n_vertices, 3)) if needs_rest else None
    by_posed = _gradients(rest, posed, False, needs_posed)[1]
    words = _cuda_words(rest, posed, corners, triangles) | {
        "vertex_quats": pointer(vertex_quats),
        "face_quats": pointer(face_quats),
        "vertex_area_ratio": pointer(vertex_area_ratio),
        "signs": pointer(signs),
        "sums": pointer(sums),
        "g_vertex_quats": pointer(given[0]),
        "g_face_quats": pointer(given[1]),
        "g_area_ratio": pointer(given[2]),
        "g_vertex_area_ratio": pointer(given[3]),
        "rest_edges": pointer(rest_edges),
        "posed_edges": pointer(posed_edges),
        "g_rest": pointer(by_rest),
        "g_posed": pointer(by_posed),
    }
    stream = current_stream(rest.device)
    run_cuda(native_kernels.turn_faces_backward, words, n_poses * _blocks(n_faces), stream)
    run_cuda(native_kernels.gather_edges, words, n_poses * _blocks(n_vertices), stream)
    return rest.new_empty((0, 3)) if by_rest is None else summed_over_poses(by_rest, batched), by_posed


_operator = operator("face_rotations", _face_rotations, _outputs)
_adjoint = adjoint("face_rotations_backward", _face_rotations_backward, _fake_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    vertex_quats, face_quats, _, vertex_area_ratio, signs, sums = output
    ctx.mark_non_differentiable(signs, sums)
    ctx.save_for_backward(*inputs[:4], vertex_quats, face_quats, vertex_area_ratio, signs, sums)


def _backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    needs_rest, needs_posed = ctx.needs_input_grad[:2]
    rest, posed = _adjoint(*ctx.saved_tensors, *grads[:4], needs_rest, needs_posed)
    return (
        rest if needs_rest else None,  # rest
        posed if needs_posed else None,  # posed
        None,  # faces
        None,  # triangles
        None,  # keep
        None,  # validate
    )


differentiable(_operator, _backward, _save)


def face_rotations(
    rest_vertices: Float[Tensor, "V 3"] | RestMesh,
    posed_vertices: Float[Tensor, "*B V 3"],
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
        rest_vertices: Vertices at rest, any unit of length, shape [V, 3], float32 or float64; or the `rest_mesh` of
            these vertices and faces, where one mesh is posed many times.
        posed_vertices: The same vertices posed, shape [V, 3]; or B poses of them, shape [B, V, 3]: then every output
            has that axis too, and is what as many calls give.
        faces: Vertex indices, shape [F, 3]; F may be 0.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    sizes: dict[str, int] = {}
    rest, triangles = rest_vertices if isinstance(rest_vertices, RestMesh) else (rest_vertices, None)
    check_shape("rest_vertices", rest, "V", 3, sizes=sizes)
    batch = ("B",) if posed_vertices.ndim == 3 else ()
    check_shape("posed_vertices", posed_vertices, *batch, "V", 3, sizes=sizes, hint="One for each rest vertex.")
    check_float("rest_vertices", rest)
    check_float("posed_vertices", posed_vertices, rest)
    check_shape("faces", faces, "F", 3, sizes=sizes, hint="Three vertex indices a face.")
    if triangles is not None and not len(triangles):  # as in float64
        triangles = None
    if triangles is not None:
        check_shape("rest_vertices.triangles", triangles, "F", 12, sizes=sizes, hint="Of the rest_mesh of these faces.")
        check_float("rest_vertices.triangles", triangles, rest)
    keep = needs_gradient(rest, posed_vertices)
    return FaceRotations(*_operator(rest, posed_vertices, faces, triangles, keep, validate)[:4])
