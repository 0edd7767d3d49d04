"""Rotations and area ratios of faces and vertices between a rest mesh and a posed one."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.posing import face_rotation as kernels
from oasis_kernels.posing import face_rotation_native as native_kernels
from oasis_warp.ops._runtime import launch
from oasis_warp.ops._runtime.declaration import Array, Operator, empty_gradients, needs_gradient
from oasis_warp.ops._runtime.incidence import Incidence, incidence, sum_at_items
from oasis_warp.ops._runtime.launch import launch_ranges
from oasis_warp.ops.checks import check_float, check_shape


class RestMesh(NamedTuple):
    """A mesh at rest that receives no gradient; see `rest_mesh`."""

    vertices: Float[Tensor, "V 3"]
    triangles: Float[Tensor, "T 12"]
    """The frame and shape of every face as the kernels read them; T is 0 in float64, as its kernels need none."""


class FaceRotations(NamedTuple):
    """Rotation and growth of a surface. Quaternions are unit, wxyz, rest to posed."""

    vertex_quats: Float[Tensor, "*B V 4"]
    face_quats: Float[Tensor, "*B F 4"]
    area_ratio: Float[Tensor, "*B F"]
    """Posed area over rest area."""
    vertex_area_ratio: Float[Tensor, "*B V"]
    """The same of all faces around a vertex together; 1 where there is none."""


Outputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _outputs(rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, _: Any, keep: bool, *__: Any) -> Outputs:
    batch, n_vertices, n_faces = posed_vertices.shape[:-2], len(rest_vertices), len(faces)
    return (
        rest_vertices.new_empty((*batch, n_vertices, 4)),
        rest_vertices.new_empty((*batch, n_faces, 4)),
        rest_vertices.new_empty((*batch, n_faces)),
        rest_vertices.new_empty((*batch, n_vertices)),
        rest_vertices.new_empty((*batch, 3 * n_faces if keep else 0)),
        rest_vertices.new_empty((*batch, 2 if keep else 0, n_vertices)),
    )


def _mesh_params(rest: Tensor, posed: Tensor, corners: Incidence, triangles: Tensor | None) -> dict[str, Any]:
    """The parameters that all float32 kernels share; inputs are contiguous."""
    return {
        "n_vertices": len(rest), "n_faces": len(corners.table), "rest_vertices": rest, "posed_vertices": posed,
        "faces": corners.table, "triangles": triangles, "offsets": corners.offsets, "corners": corners.entries,
    }  # fmt: skip


def _face_rotations(
    rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, triangles: Tensor | None, keep: bool, validate: bool
) -> Outputs:
    on_cuda = launch.has_cuda_kernels(rest_vertices)
    if posed_vertices.ndim == 3 and not on_cuda:
        return _OPERATOR.each_pose(rest_vertices, posed_vertices, faces, triangles, keep, validate)
    corners = incidence("faces", faces, len(rest_vertices), "vertices")
    out = _outputs(rest_vertices, posed_vertices, faces, triangles, keep)
    (rest, posed), (triangles,) = launch.contiguous(rest_vertices, posed_vertices), launch.aligned(triangles)
    if not (on_cuda or launch.has_vectors(rest)):
        _rotate_float64(rest, posed, corners, out)
        return out
    n_vertices, n_faces = len(rest), len(faces)
    n_poses = posed.shape[:-2].numel()
    names = "vertex_quats", "face_quats", "area_ratio", "vertex_area_ratio", "signs", "sums"
    params = _mesh_params(rest, posed, corners, triangles) | dict(zip(names, out, strict=True))
    params["rows_of_faces"] = rest.new_empty((n_poses * n_faces, 8))
    if on_cuda:
        blocks = n_poses * launch.block_count(n_faces, native_kernels.BLOCK)
        params["flat_blocks"] = corners.table.new_empty(blocks)
        stream = launch.current_stream(rest.device)
        launch.run_cuda(native_kernels.rotate_faces, params, blocks, stream)
        blocks = n_poses * launch.block_count(n_vertices, native_kernels.BLOCK)
        launch.run_cuda(native_kernels.rotate_vertices, params, blocks, stream)
    else:
        params["state"] = launch.phase_state(native_kernels.STATE)
        launch.run_native(native_kernels.rotate, params, launch.task_count(n_faces, n_vertices))
    return out


def _rotate_float64(rest: Tensor, posed: Tensor, corners: Incidence, out: Outputs) -> None:
    """Fill `out` with the generic kernels."""
    vertex_quats, face_quats, area_ratio, vertex_area_ratio, signs, sums = out
    n_vertices, n_faces = len(rest), len(corners.table)
    areas = rest.new_empty((n_faces, 3), dtype=torch.float64)
    inputs = [rest, posed, corners.table, face_quats, area_ratio, areas]
    launch_ranges(kernels.face_rotations, n_faces, inputs, like=rest)
    # What has no rotation of its own gets that of the largest face, so that a rigid motion still acts rigidly.
    fallback = areas[:, 0].argmax(keepdim=True) if n_faces else areas.new_empty(0, dtype=torch.int64)
    if n_faces:
        face_quats.copy_(torch.where(areas[:, :1] > 0, face_quats, face_quats[fallback]))
    inputs = [
        face_quats, areas, corners.offsets, corners.entries, fallback.to(torch.int32), vertex_quats, vertex_area_ratio,
        signs, sums,
    ]  # fmt: skip
    launch_ranges(kernels.vertex_rotations, n_vertices, inputs, like=rest)


def _face_rotations_backward(
    rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, triangles: Tensor | None, vertex_quats: Tensor,
    face_quats: Tensor, vertex_area_ratio: Tensor, signs: Tensor, sums: Tensor, g_vertex_quats: Tensor | None,
    g_face_quats: Tensor | None, g_area_ratio: Tensor | None, g_vertex_area_ratio: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    on_cuda = launch.has_cuda_kernels(rest_vertices)
    saved = {
        "vertex_quats": vertex_quats, "face_quats": face_quats, "vertex_area_ratio": vertex_area_ratio,
        "signs": signs, "sums": sums,
    }  # fmt: skip
    incoming = g_vertex_quats, g_face_quats, g_area_ratio, g_vertex_area_ratio
    if posed_vertices.ndim == 3 and not on_cuda:
        return _OPERATOR.each_pose_backward(
            rest_vertices, posed_vertices, faces, triangles, *saved.values(), *incoming, needs
        )
    corners = incidence("faces", faces, len(rest_vertices), "vertices")
    rest, posed = launch.contiguous(rest_vertices, posed_vertices)
    triangles, *incoming = launch.aligned(triangles, *incoming)
    if not (on_cuda or launch.has_vectors(rest)):
        return _backward_float64(rest, posed, corners, saved, incoming, needs)
    g_rest, g_posed = empty_gradients((rest, posed), [False, needs[1]])
    n_vertices, n_faces, batch = len(rest), len(faces), posed.shape[:-2]
    n_poses = batch.numel()
    if needs[0]:
        g_rest = rest.new_empty((*batch, n_vertices, 3))
    rest_edges, posed_edges = (rest.new_empty((n_poses * n_faces, 8)) if needed else None for needed in needs)
    names = "g_vertex_quats", "g_face_quats", "g_area_ratio", "g_vertex_area_ratio"
    params = _mesh_params(rest, posed, corners, triangles) | saved | dict(zip(names, incoming, strict=True)) | {
        "rest_edges": rest_edges, "posed_edges": posed_edges, "g_rest": g_rest, "g_posed": g_posed,
    }  # fmt: skip
    if on_cuda:
        stream = launch.current_stream(rest.device)
        blocks = n_poses * launch.block_count(n_faces, native_kernels.BLOCK)
        launch.run_cuda(native_kernels.rotate_faces_backward, params, blocks, stream)
        blocks = n_poses * launch.block_count(n_vertices, native_kernels.BLOCK)
        launch.run_cuda(native_kernels.gather_edges, params, blocks, stream)
    else:
        params |= {"at_vertices": rest.new_empty((n_vertices, 8)), "state": launch.phase_state(native_kernels.STATE)}
        launch.run_native(native_kernels.rotate_backward, params, launch.task_count(n_faces, n_vertices))
    return [torch.sum(g_rest, 0) if batch and needs[0] else g_rest, g_posed]


def _backward_float64(
    rest: Tensor, posed: Tensor, corners: Incidence, saved: dict[str, Tensor], incoming: list[Tensor | None],
    needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    """The adjoint with the generic kernels."""
    vertex_quats, face_quats, vertex_area_ratio, signs, sums = saved.values()
    likes = vertex_quats, face_quats, face_quats[:, 0], vertex_area_ratio
    g_vertex_quats, g_face_quats, g_area_ratio, g_vertex_area_ratio = (
        torch.zeros(like.shape, dtype=like.dtype, device=like.device) if g is None else g
        for g, like in zip(incoming, likes, strict=True)
    )
    n_vertices, n_faces = len(rest), len(corners.table)
    g_sums = rest.new_empty((n_vertices, 6), dtype=torch.float64)
    inputs = [vertex_quats, vertex_area_ratio, sums, g_vertex_quats, g_vertex_area_ratio, g_sums]
    launch_ranges(kernels.vertex_rotations_backward, n_vertices, inputs, like=rest)
    rest_rows, posed_rows = (rest.new_empty((n_faces if needed else 0, 9)) for needed in needs)
    inputs = [
        rest, posed, corners.table, face_quats, signs, g_sums, g_face_quats, g_area_ratio, rest_rows, posed_rows,
    ]  # fmt: skip
    launch_ranges(kernels.face_rotations_backward, n_faces, inputs, like=rest)
    return [
        sum_at_items(rows.view(-1, 3), corners) if needed else rows.view(-1, 3)
        for rows, needed in zip((rest_rows, posed_rows), needs, strict=True)
    ]


_OPERATOR = Operator(
    "face_rotations",
    _face_rotations,
    _outputs,
    _face_rotations_backward,
    inputs={
        "rest_vertices": Array("V 3", grad=True),
        "posed_vertices": Array("*B V 3", grad=True, hint="One for each rest vertex."),
        "faces": Array("F 3", index="V", hint="Three vertex indices a face."),
    },
    outputs={
        "vertex_quats": "*B V 4", "face_quats": "*B F 4", "area_ratio": "*B F", "vertex_area_ratio": "*B V",
    },
    auxiliary={"signs": "*B 3F", "sums": "*B 2 V"},
    reference="posing.face_rotations",
)  # fmt: skip


def face_rotations(
    rest_vertices: Float[Tensor, "V 3"] | RestMesh,
    posed_vertices: Float[Tensor, "*B V 3"],
    faces: Int[Tensor, "F 3"],
    *,
    validate: bool = True,
) -> FaceRotations:
    """Rotation of every face and vertex from rest to posed, and the growth of every face.

    A face rotates by the rotation that takes its normal to the posed normal and, in its plane, is the polar factor of
    the map of its edges (OASIS, MM '26, appendix): the same whichever corner is listed first. Its quaternion has
    w >= 0. A vertex rotates by the normalised mean of its faces' quaternions, weighted with their areas at rest and
    sign-aligned to the largest of them. A face that is flat (area 0 but for rounding) at rest or posed has no weight
    and no gradient. It gets the rotation of the face with the largest rest area, as do vertices without any other face;
    the identity if there is no face at all. The area ratio is (A' + d) / (A + d), d = 0.5e-6 times the longest rest
    edge squared; that of a vertex has the sums over its faces above and below.

    Differentiable in `rest_vertices` and `posed_vertices`. The faces around each vertex are found once for each `faces`
    tensor and cached while it lives.

    Args:
        rest_vertices: Vertices at rest, any unit of length, shape [V, 3], float32 or float64; or the `rest_mesh` of
            these vertices and faces, if one mesh is posed many times.
        posed_vertices: The same vertices posed, shape [V, 3]; or B poses of them, shape [B, V, 3]: then every output
            has that axis too, with the results of as many calls.
        faces: Vertex indices, shape [F, 3]; F may be 0.
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once for each tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    rest, triangles = rest_vertices if isinstance(rest_vertices, RestMesh) else (rest_vertices, None)
    sizes = _OPERATOR.check(rest_vertices=rest, posed_vertices=posed_vertices, faces=faces)
    if triangles is not None and not len(triangles):  # as in float64
        triangles = None
    if triangles is not None:
        check_shape("rest_vertices.triangles", triangles, "F", 12, sizes=sizes, hint="Of the rest_mesh of these faces.")
        check_float("rest_vertices.triangles", triangles, rest)
    keep = needs_gradient(rest, posed_vertices)
    return FaceRotations(*_OPERATOR(rest, posed_vertices, faces, triangles, keep, validate)[:4])


def _empty_table(rest_vertices: Tensor, faces: Tensor, validate: bool) -> Tensor:
    n_rows = len(faces) if rest_vertices.dtype == torch.float32 else 0
    return rest_vertices.new_empty((n_rows, native_kernels.TRIANGLE))


def _rest_mesh(rest_vertices: Tensor, faces: Tensor, validate: bool) -> Tensor:
    corners = incidence("faces", faces, len(rest_vertices), "vertices").table
    out, rest = _empty_table(rest_vertices, faces, validate), rest_vertices.contiguous()
    params = {"n_vertices": len(rest), "n_faces": len(faces), "rest_vertices": rest, "faces": corners, "out": out}
    if launch.has_vectors(rest):
        params["state"] = launch.phase_state(native_kernels.STATE)
        launch.run_native(native_kernels.measure, params, launch.task_count(len(faces)))
    elif launch.has_cuda_kernels(rest):
        blocks = launch.block_count(len(faces), native_kernels.BLOCK)
        launch.run_cuda(native_kernels.measure_triangles, params, blocks, launch.current_stream(rest.device))
    return out


_REST_MESH = Operator(
    "rest_mesh",
    _rest_mesh,
    _empty_table,
    inputs={
        "rest_vertices": Array("V 3"),
        "faces": Array("F 3", index="V", hint="Three vertex indices a face."),
    },
    outputs={"triangles": "T 12"},
)


def rest_mesh(rest_vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], *, validate: bool = True) -> RestMesh:
    """A mesh at rest that is posed many times: `face_rotations` takes it in place of the rest vertices.

    It holds what `face_rotations` needs of the rest mesh, computed once instead of for every pose. Not differentiable:
    if rest vertices need a gradient, pass them to `face_rotations` themselves.

    Args:
        rest_vertices: Vertices at rest, any unit of length, shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3]; F may be 0. Pass the same ones to `face_rotations`.
        validate: Check the values of the vertices too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    _REST_MESH.check(rest_vertices=rest_vertices, faces=faces)
    rest = rest_vertices.detach()
    return RestMesh(rest, _REST_MESH(rest, faces, validate))
