"""Carry Gaussians that ride on the faces and vertices of a mesh into a pose."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels import barycentric as kernels
from oasis_kernels import barycentric_vectors as vector_kernels
from oasis_warp.core.checks import check_choice, check_finite, check_float, check_shape
from oasis_warp.ops._incidence import Incidence, incidence, riders_at_vertices, sum_at_items
from oasis_warp.ops._launch import even_cuts, launch_ranges, view
from oasis_warp.ops._native import is_vectorised, run_tasks
from oasis_warp.ops._registration import adjoint, differentiable, operator

HALF_POWERS = {"sqrt_area": 1, "area": 2, "none": 0}
"""Twice the exponent of the area ratio in each scale law."""


class PosedOnMesh(NamedTuple):
    """Gaussians in a pose: those on vertices first, then those on faces."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]


class _Indices(NamedTuple):
    """Who rides on what, checked."""

    corners: Incidence
    on_faces: Incidence
    on_vertices: Tensor | None
    """int32."""


def _indices(faces: Tensor, face_index: Tensor, vertex_index: Tensor | None, n_vertices: int) -> _Indices:
    corners = incidence("faces", faces, n_vertices, "vertices")
    on_faces = incidence("face_index", face_index, len(faces), "faces")
    if vertex_index is None:
        return _Indices(corners, on_faces, None)
    return _Indices(corners, on_faces, incidence("vertex_index", vertex_index, n_vertices, "vertices").table)


def _fake(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
    quats, scales = inputs[6:8]
    n = len(quats)
    return scales.new_empty((n, 3)), quats.new_empty((n, 4)), scales.new_empty((n, 3))


def _pose_on_mesh(
    posed_vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    barycentrics: Tensor,
    vertex_quats: Tensor,
    area_ratio: Tensor,
    quats: Tensor,
    scales: Tensor,
    vertex_index: Tensor | None,
    offsets: Tensor | None,
    vertex_area_ratio: Tensor | None,
    half_powers: int,
    validate: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    if validate:
        check_finite(
            posed_vertices=posed_vertices,
            barycentrics=barycentrics,
            vertex_quats=vertex_quats,
            area_ratio=area_ratio,
            quats=quats,
            scales=scales,
            offsets=offsets,
            vertex_area_ratio=vertex_area_ratio,
        )
    indices = _indices(faces, face_index, vertex_index, len(posed_vertices))
    floats = (posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio)
    vertices, barycentrics, turns, ratios, quats, scales, offsets, vertex_ratios = _contiguous(floats)
    means, turned, grown = _fake(*[None] * 6, quats, scales)
    n = 0 if indices.on_vertices is None else len(indices.on_vertices)
    corners, on_faces = indices.corners.table, indices.on_faces.table
    if is_vectorised(vertices):
        if n:
            run_tasks(
                vector_kernels.on_vertices,
                n,
                [
                    vertices, len(vertices), indices.on_vertices, turns, vertex_ratios, offsets, quats, scales,
                    half_powers, means, turned, grown,
                ],
            )  # fmt: skip
        run_tasks(
            vector_kernels.on_faces,
            len(on_faces),
            [
                vertices, len(vertices), corners, on_faces, turns, ratios, barycentrics, quats[n:], scales[n:],
                half_powers, means[n:], turned[n:], grown[n:],
            ],
        )  # fmt: skip
        return means, turned, grown

    if n:
        launch_ranges(
            kernels.pose_on_vertices,
            even_cuts(n),
            [
                *map(view, (vertices, indices.on_vertices, turns, vertex_ratios, offsets, quats, scales)),
                half_powers,
                *map(view, (means, turned, grown)),
            ],
            like=quats,
        )
    launch_ranges(
        kernels.pose_on_faces,
        even_cuts(len(on_faces)),
        [
            *map(view, (vertices, corners, on_faces, barycentrics, turns, ratios, quats[n:], scales[n:])),
            half_powers,
            *map(view, (means[n:], turned[n:], grown[n:])),
        ],
        like=quats,
    )
    return means, turned, grown


def _contiguous(tensors: Sequence[Tensor | None]) -> list[Any]:
    return [None if tensor is None else tensor.contiguous() for tensor in tensors]


# Places of the float inputs among all, and so of `needs` below.
_FLOATS = (0, 3, 4, 5, 6, 7, 9, 10)


def _fake_backward(*inputs: Any) -> list[Tensor]:
    """An empty tensor for each float input, of no rows where no gradient is needed."""
    needs = inputs[-1]
    floats = [inputs[place] for place in _FLOATS]
    like = floats[0]
    return [
        like.new_empty(tensor.shape if needed else (0,)) for tensor, needed in zip(floats, needs, strict=True)
    ]


def _pose_on_mesh_backward(
    posed_vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    barycentrics: Tensor,
    vertex_quats: Tensor,
    area_ratio: Tensor,
    quats: Tensor,
    scales: Tensor,
    vertex_index: Tensor | None,
    offsets: Tensor | None,
    vertex_area_ratio: Tensor | None,
    half_powers: int,
    grad_means: Tensor | None,
    grad_quats: Tensor | None,
    grad_scales: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    indices = _indices(faces, face_index, vertex_index, len(posed_vertices))
    n = 0 if indices.on_vertices is None else len(indices.on_vertices)
    q = len(face_index)
    g_vertices, g_barycentrics, g_turns, g_ratios, g_quats, g_scales, g_offsets, g_vertex_ratios = (
        posed_vertices.new_empty(tensor.shape) if needed and tensor is not None else None
        for tensor, needed in zip(
            (posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio),
            needs,
            strict=True,
        )
    )
    floats = (posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio)
    vertices, barycentrics, turns, ratios, quats, scales, offsets, vertex_ratios = _contiguous(floats)
    grads = _contiguous((grad_means, grad_quats, grad_scales))
    corners, on_faces = indices.corners.table, indices.on_faces.table
    at_vertices = g_vertices is not None or g_turns is not None or g_vertex_ratios is not None

    def of_riders(tensor: Tensor | None, on_face: bool) -> Tensor | None:
        return None if tensor is None else tensor[n:] if on_face else tensor[:n]

    if is_vectorised(vertices):
        rows = vertices.new_empty((n + q, 8)) if at_vertices else None
        weights = vertices.new_empty((q, 3)) if at_vertices else None
        by_ratio = vertices.new_empty(q) if g_ratios is not None else None
        if n:
            run_tasks(
                vector_kernels.on_vertices_backward,
                n,
                [
                    vertices, len(vertices), indices.on_vertices, turns, vertex_ratios, offsets, quats, scales,
                    half_powers, *grads, rows, g_offsets, g_quats, g_scales,
                ],
            )  # fmt: skip
        run_tasks(
            vector_kernels.on_faces_backward,
            q,
            [
                vertices, len(vertices), corners, on_faces, turns, ratios, barycentrics, quats[n:], scales[n:],
                half_powers, *(of_riders(grad, True) for grad in grads), of_riders(rows, True), weights, by_ratio,
                g_barycentrics, of_riders(g_quats, True), of_riders(g_scales, True),
            ],
        )  # fmt: skip
        if at_vertices:
            riders = riders_at_vertices(faces, face_index, vertex_index, len(vertices))
            run_tasks(
                vector_kernels.gather_vertices,
                len(vertices),
                [
                    riders.offsets, riders.entries, n, rows, barycentrics, weights, g_vertices, g_turns,
                    g_vertex_ratios,
                ],
            )  # fmt: skip
        if g_ratios is not None:
            sums = [indices.on_faces.offsets, indices.on_faces.entries, by_ratio, g_ratios]
            run_tasks(vector_kernels.gather_faces, len(g_ratios), sums)
        found = (g_vertices, g_barycentrics, g_turns, g_ratios, g_quats, g_scales, g_offsets, g_vertex_ratios)
        return [vertices.new_empty(0) if grad is None else grad for grad in found]

    g_means, g_turned, g_grown = (
        like.new_zeros(like.shape) if grad is None else grad
        for grad, like in zip(grads, _fake(*[None] * 6, quats, scales), strict=True)
    )
    # Rows for vertices: first those of Gaussians on vertices, then three for each on a face.
    vertex_rows = vertices.new_empty((n + 3 * q if g_vertices is not None else 0, 3))
    turn_rows = vertices.new_empty((n + 3 * q if g_turns is not None else 0, 4))
    ratio_rows = vertices.new_empty((q if g_ratios is not None else 0, 1))
    vertex_ratio_rows = vertices.new_empty((n if g_vertex_ratios is not None else 0, 1))

    def wanted(grad: Tensor | None, width: int) -> Tensor:
        return vertices.new_empty((0, width)) if grad is None else grad

    if n:
        launch_ranges(
            kernels.pose_on_vertices_backward,
            even_cuts(n),
            [
                *map(view, (vertices, indices.on_vertices, turns, vertex_ratios, offsets, quats, scales)),
                half_powers,
                *map(view, (g_means, g_turned, g_grown, vertex_rows, turn_rows, vertex_ratio_rows)),
                *map(view, (wanted(g_offsets, 3), wanted(g_quats, 4), wanted(g_scales, 3))),
            ],
            like=quats,
        )
    launch_ranges(
        kernels.pose_on_faces_backward,
        even_cuts(q),
        [
            *map(view, (vertices, corners, on_faces, barycentrics, turns, ratios, quats[n:], scales[n:])),
            half_powers,
            *map(view, (g_means[n:], g_turned[n:], g_grown[n:])),
            *map(view, (vertex_rows[n:].view(-1, 9), turn_rows[n:].view(-1, 12), ratio_rows)),
            *map(view, (wanted(g_barycentrics, 3), wanted(g_quats, 4)[n:], wanted(g_scales, 3)[n:])),
        ],
        like=quats,
    )
    riders = riders_at_vertices(faces, face_index, vertex_index, len(vertices))
    if g_vertices is not None:
        g_vertices = sum_at_items(vertex_rows, riders)
    if g_turns is not None:
        g_turns = sum_at_items(turn_rows, riders)
    if g_ratios is not None:
        g_ratios = sum_at_items(ratio_rows, indices.on_faces).view(-1)
    if g_vertex_ratios is not None:
        on_vertices = incidence("vertex_index", vertex_index, len(vertices), "vertices")
        g_vertex_ratios = sum_at_items(vertex_ratio_rows, on_vertices).view(-1)
    found = (g_vertices, g_barycentrics, g_turns, g_ratios, g_quats, g_scales, g_offsets, g_vertex_ratios)
    return [vertices.new_empty(0) if grad is None else grad for grad in found]


_operator = operator("pose_on_mesh", _pose_on_mesh, _fake)
_adjoint = adjoint("pose_on_mesh_backward", _pose_on_mesh_backward, _fake_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:11])
    ctx.half_powers = inputs[11]


def _backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = [ctx.needs_input_grad[place] for place in _FLOATS]
    found = _adjoint(*ctx.saved_tensors, ctx.half_powers, *grads, needs)
    out: list[Tensor | None] = [None] * 13
    for place, needed, grad in zip(_FLOATS, needs, found, strict=True):
        out[place] = grad if needed else None
    return tuple(out)


differentiable(_operator, _backward, _save)


def pose_on_mesh(
    posed_vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    face_index: Int[Tensor, "Q"],
    barycentrics: Float[Tensor, "Q 3"],
    vertex_quats: Float[Tensor, "V 4"],
    area_ratio: Float[Tensor, "F"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    scale_law: Literal["sqrt_area", "area", "none"] = "sqrt_area",
    *,
    vertex_index: Int[Tensor, "P"] | None = None,
    offsets: Float[Tensor, "P 3"] | None = None,
    vertex_area_ratio: Float[Tensor, "V"] | None = None,
    validate: bool = True,
) -> PosedOnMesh:
    """Gaussians on the faces of a mesh, and on its vertices, carried into its pose (OASIS, MM '26, eq. 7, appendix).

    On a face, the mean is the barycentric mean of the posed corners. The quaternion is dq * canonical, dq the
    normalised barycentric mean of the corners' rotations, sign-aligned to the corner with the largest weight. The scale
    is the canonical one times the square root of the face's area ratio (a length goes with the root of an area), the
    ratio itself with "area" (the law as printed), or 1 with "none"; ratios are bounded to [1e-4, 1e4]. The fourth law,
    which stretches Gaussians with the face, leaves no axes and scales: `pose_on_mesh_covars`.

    On a vertex, the mean is the posed vertex plus the offset, turned as the vertex turned; so is the quaternion, and
    the scale follows the vertex's area ratio by the same law.

    Differentiable in every float argument. Which Gaussians ride on what is computed once for each `face_index` tensor
    and remembered while it lives.

    Args:
        posed_vertices: Vertices of the posed mesh [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        face_index: The face each Gaussian rides on, shape [Q]; Q may be 0.
        barycentrics: Weights of that face's corners, rows of sum 1 and not negative, shape [Q, 3].
        vertex_quats: Unit rotations from rest to posed, wxyz, shape [V, 4]; from `face_rotations`.
        area_ratio: Posed area over rest area, shape [F]; from `face_rotations`.
        quats: Canonical rotations, wxyz, shape [N, 4], N = P + Q: first of the Gaussians on vertices, then of those on
            faces. Their norms carry over.
        scales: Canonical standard deviations [m], shape [N, 3].
        scale_law: How scales follow areas.
        vertex_index: The vertex each of the first P Gaussians rides on, shape [P]; None for P = 0.
        offsets: Shift of each of them from its vertex at rest [m], shape [P, 3]. Goes with `vertex_index`.
        vertex_area_ratio: Posed area over rest area round each vertex, shape [V]; from `face_rotations`. Goes with
            `vertex_index`.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype, index or law, a value that is not finite, or only some of the three arguments
            for Gaussians on vertices.
    """
    sizes: dict[str, int] = {}
    check_shape("posed_vertices", posed_vertices, "V", 3, sizes=sizes)
    check_shape("faces", faces, "F", 3, sizes=sizes, hint="Three vertex indices a face.")
    check_shape("face_index", face_index, "Q", sizes=sizes, hint="One face a Gaussian.")
    check_shape("barycentrics", barycentrics, "Q", 3, sizes=sizes)
    check_shape("vertex_quats", vertex_quats, "V", 4, sizes=sizes, hint="Quaternions are wxyz.")
    check_shape("area_ratio", area_ratio, "F", sizes=sizes, hint="One ratio a face.")
    floats = {
        "posed_vertices": posed_vertices,
        "barycentrics": barycentrics,
        "vertex_quats": vertex_quats,
        "area_ratio": area_ratio,
        "quats": quats,
        "scales": scales,
    }
    n = len(face_index)
    if vertex_index is not None:
        check_shape("vertex_index", vertex_index, "P", hint="One vertex a Gaussian.")
        n += len(vertex_index)
    for name, tensor, shape in (
        ("offsets", offsets, (len(vertex_index) if vertex_index is not None else 0, 3)),
        ("vertex_area_ratio", vertex_area_ratio, (len(posed_vertices),)),
    ):
        if (tensor is None) != (vertex_index is None):
            expected, got = ("None", "a tensor") if vertex_index is None else ("a tensor", "None")
            raise ValueError(f"{name}: expected {expected}, got {got}. It goes with vertex_index.")
        if tensor is not None:
            check_shape(name, tensor, *shape)
            floats[name] = tensor
    check_shape("quats", quats, n, 4, hint="Quaternions are wxyz.")
    check_shape("scales", scales, n, 3)
    for name, tensor in floats.items():
        check_float(name, tensor, posed_vertices)
    check_choice("scale_law", scale_law, tuple(HALF_POWERS))
    return PosedOnMesh(
        *_operator(
            posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, vertex_index,
            offsets, vertex_area_ratio, HALF_POWERS[scale_law], validate,
        )
    )  # fmt: skip
