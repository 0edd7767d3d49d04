"""Carry Gaussians that ride on the faces and vertices of a mesh into a pose."""

from typing import Any, Literal, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.posing import barycentric as kernels
from oasis_warp.core.checks import check_choice, check_float, check_shape
from oasis_warp.ops._runtime.incidence import sum_at_items
from oasis_warp.ops._runtime.launch import even_cuts, has_cuda_kernels, has_vectors, launch_ranges, view
from oasis_warp.ops._runtime.poses import at_pose, pose_by_pose
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator
from oasis_warp.ops._runtime.riders import (
    SHARED,
    Floats,
    Riders,
    find_riders,
    pose_backward_vectorised,
    pose_vectorised,
)
from oasis_warp.ops._runtime.riders_cuda import pose_backward_on_cuda, pose_on_cuda
from oasis_warp.ops._runtime.values import check_finite

HALF_POWERS = {"sqrt_area": 1, "area": 2, "none": 0}
"""Twice the exponent of the area ratio in each scale law."""


class PosedOnMesh(NamedTuple):
    """Gaussians in a pose: those on vertices first, then those on faces."""

    means: Float[Tensor, "*B N 3"]
    quats: Float[Tensor, "*B N 4"]
    scales: Float[Tensor, "*B N 3"]


def _posed_like(posed_vertices: Tensor, quats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    shape = *posed_vertices.shape[:-2], len(quats)
    return quats.new_empty((*shape, 3)), quats.new_empty((*shape, 4)), quats.new_empty((*shape, 3))


def _fake(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
    return _posed_like(inputs[0], inputs[6])


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
    riders = find_riders(faces, face_index, vertex_index, posed_vertices.shape[-2], transposed=False)
    inputs = Floats(
        posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio
    )
    posed = _posed_like(posed_vertices, quats)
    if has_cuda_kernels(quats):
        pose_on_cuda(inputs, riders, half_powers, posed)
        return posed
    if posed_vertices.ndim == 3:

        def one(k: int) -> tuple[Tensor, Tensor, Tensor]:
            floats = inputs.at_pose(k)
            return _pose_on_mesh(
                floats.vertices, faces, face_index, barycentrics, floats.vertex_quats, floats.area_ratio, quats, scales,
                vertex_index, offsets, floats.vertex_area_ratio, half_powers, validate=False,
            )  # fmt: skip

        pose_by_pose(posed, len(posed_vertices), one)
        return posed
    inputs = inputs.contiguous()
    if has_vectors(quats):
        pose_vectorised(inputs, riders, half_powers, posed)
        return posed

    p = riders.p
    if riders.on_vertices is not None:
        launch_ranges(
            kernels.pose_on_vertices,
            even_cuts(p),
            [*_vertex_arguments(inputs, riders), half_powers, *map(view, posed)],
            like=quats,
        )
    launch_ranges(
        kernels.pose_on_faces,
        even_cuts(riders.q),
        [*_face_arguments(inputs, riders), half_powers, *(view(out[p:]) for out in posed)],
        like=quats,
    )
    return posed


def _vertex_arguments(inputs: Floats, riders: Riders) -> list[Any]:
    assert riders.on_vertices is not None
    return [
        view(tensor)
        for tensor in (
            inputs.vertices, riders.on_vertices.table, inputs.vertex_quats, inputs.vertex_area_ratio, inputs.offsets,
            inputs.quats, inputs.scales,
        )
    ]  # fmt: skip


def _face_arguments(inputs: Floats, riders: Riders) -> list[Any]:
    p = riders.p
    return [
        view(tensor)
        for tensor in (
            inputs.vertices, riders.corners.table, riders.on_faces.table, inputs.barycentrics, inputs.vertex_quats,
            inputs.area_ratio, inputs.quats[p:], inputs.scales[p:],
        )
    ]  # fmt: skip


_FLOATS = (0, 3, 4, 5, 6, 7, 9, 10)
"""Places of `Floats` among the inputs."""


def _fake_backward(*inputs: Any) -> list[Tensor]:
    """An empty tensor for each of `Floats`, of no elements where no gradient is wanted."""
    floats = [inputs[place] for place in _FLOATS]
    return [
        inputs[0].new_empty(tensor.shape if needed and tensor is not None else (0,))
        for tensor, needed in zip(floats, inputs[-1], strict=True)
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
    inputs = Floats(
        posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio
    )
    found = [
        quats.new_empty(tensor.shape if needed and tensor is not None else (0,))
        for tensor, needed in zip(inputs, needs, strict=True)
    ]
    if not len(quats) or not len(posed_vertices):  # empty scratch has no address, by which kernels know what is wanted
        return [grad.zero_() for grad in found]
    wanted = Floats(*needs)
    at_vertices = wanted.vertices or wanted.vertex_quats or wanted.vertex_area_ratio
    riders = find_riders(faces, face_index, vertex_index, posed_vertices.shape[-2], transposed=at_vertices)
    grads = grad_means, grad_quats, grad_scales
    g = [grad if needed else None for grad, needed in zip(found, needs, strict=True)]
    if has_cuda_kernels(quats):
        by_inputs = pose_backward_on_cuda(inputs, riders, half_powers, grads, g)
        return [empty if grad is None else grad for grad, empty in zip(by_inputs, found, strict=True)]
    if posed_vertices.ndim == 3:

        def one(k: int) -> list[Tensor]:
            floats = inputs.at_pose(k)
            of_pose = (at_pose(grad, k) for grad in grads)
            return _pose_on_mesh_backward(
                floats.vertices, faces, face_index, barycentrics, floats.vertex_quats, floats.area_ratio, quats, scales,
                vertex_index, offsets, floats.vertex_area_ratio, half_powers, *of_pose, needs,
            )  # fmt: skip

        pose_by_pose(found, len(posed_vertices), one, SHARED)
        return found
    inputs = inputs.contiguous()
    grads = [None if grad is None else grad.contiguous() for grad in grads]
    if has_vectors(quats):
        pose_backward_vectorised(inputs, riders, half_powers, grads, g)
        return found

    given = [
        like.zero_() if grad is None else grad
        for grad, like in zip(grads, _posed_like(posed_vertices, quats), strict=True)
    ]
    p, q = riders.p, riders.q

    def rows(needed: bool, n: int, width: int) -> Tensor:
        return quats.new_empty((n if needed else 0, width))

    def out(needed: bool, grad: Tensor, width: int) -> Tensor:
        return grad if needed else quats.new_empty((0, width))

    # Rows for vertices: first those of Gaussians on vertices, then three for each on a face.
    vertex_rows = rows(wanted.vertices, p + 3 * q, 3)
    turn_rows = rows(wanted.vertex_quats, p + 3 * q, 4)
    ratio_rows = rows(wanted.area_ratio, q, 1)
    vertex_ratio_rows = rows(wanted.vertex_area_ratio, p, 1)
    g = Floats(*found)
    g_quats, g_scales = out(wanted.quats, g.quats, 4), out(wanted.scales, g.scales, 3)
    if riders.on_vertices is not None:
        launch_ranges(
            kernels.pose_on_vertices_backward,
            even_cuts(p),
            [
                *_vertex_arguments(inputs, riders),
                half_powers,
                *map(view, (*given, vertex_rows, turn_rows, vertex_ratio_rows)),
                *map(view, (out(wanted.offsets, g.offsets, 3), g_quats, g_scales)),
            ],
            like=quats,
        )
    launch_ranges(
        kernels.pose_on_faces_backward,
        even_cuts(q),
        [
            *_face_arguments(inputs, riders),
            half_powers,
            *(view(grad[p:]) for grad in given),
            *map(view, (vertex_rows[p:].view(-1, 9), turn_rows[p:].view(-1, 12), ratio_rows)),
            *map(view, (out(wanted.barycentrics, g.barycentrics, 3), g_quats[p:], g_scales[p:])),
        ],
        like=quats,
    )
    sums = {
        "vertices": (vertex_rows, riders.at_vertices),
        "vertex_quats": (turn_rows, riders.at_vertices),
        "area_ratio": (ratio_rows, riders.on_faces),
        "vertex_area_ratio": (vertex_ratio_rows, riders.on_vertices),
    }
    for name, (summands, index) in sums.items():
        if getattr(wanted, name):
            found[Floats._fields.index(name)] = sum_at_items(summands, index).view_as(getattr(g, name))
    return found


_operator = operator("pose_on_mesh", _pose_on_mesh, _fake)
_adjoint = adjoint("pose_on_mesh_backward", _pose_on_mesh_backward, _fake_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:11])
    ctx.half_powers = inputs[11]


def _backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = [ctx.needs_input_grad[place] for place in _FLOATS]
    found = _adjoint(*ctx.saved_tensors, ctx.half_powers, *grads, needs)
    out: list[Tensor | None] = [None] * len(ctx.needs_input_grad)
    for place, needed, grad in zip(_FLOATS, needs, found, strict=True):
        out[place] = grad if needed else None
    return tuple(out)


differentiable(_operator, _backward, _save)


def pose_on_mesh(
    posed_vertices: Float[Tensor, "*B V 3"],
    faces: Int[Tensor, "F 3"],
    face_index: Int[Tensor, "Q"],
    barycentrics: Float[Tensor, "Q 3"],
    vertex_quats: Float[Tensor, "*B V 4"],
    area_ratio: Float[Tensor, "*B F"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    scale_law: Literal["sqrt_area", "area", "none"] = "sqrt_area",
    *,
    vertex_index: Int[Tensor, "P"] | None = None,
    offsets: Float[Tensor, "P 3"] | None = None,
    vertex_area_ratio: Float[Tensor, "*B V"] | None = None,
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

    With an axis of poses B before `posed_vertices` and all that `face_rotations` made of them, the same Gaussians are
    carried into every pose in one call, and every output has that axis too; it is what as many calls give.

    Args:
        posed_vertices: Vertices of the posed mesh [m], shape [V, 3], or of B poses of it, shape [B, V, 3].
        faces: Vertex indices, shape [F, 3].
        face_index: The face each Gaussian rides on, shape [Q]; Q may be 0.
        barycentrics: Weights of that face's corners, rows of sum 1 and not negative, shape [Q, 3].
        vertex_quats: Unit rotations from rest to posed, wxyz, shape [V, 4] or [B, V, 4]; from `face_rotations`.
        area_ratio: Posed area over rest area, shape [F] or [B, F]; from `face_rotations`.
        quats: Canonical rotations, wxyz, shape [N, 4], N = P + Q: first of the Gaussians on vertices, then of those on
            faces. Their norms carry over.
        scales: Canonical standard deviations [m], shape [N, 3].
        scale_law: How scales follow areas.
        vertex_index: The vertex each of the first P Gaussians rides on, shape [P]; None for P = 0.
        offsets: Shift of each of them from its vertex at rest [m], shape [P, 3]. Goes with `vertex_index`.
        vertex_area_ratio: Posed area over rest area round each vertex, shape [V] or [B, V]; from `face_rotations`. Goes
            with `vertex_index`.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype, index or law, a value that is not finite, or only some of the three arguments
            for Gaussians on vertices.
    """
    sizes: dict[str, int] = {}
    batch = ("B",) if posed_vertices.ndim == 3 else ()
    check_shape("posed_vertices", posed_vertices, *batch, "V", 3, sizes=sizes)
    check_shape("faces", faces, "F", 3, sizes=sizes, hint="Three vertex indices a face.")
    check_shape("face_index", face_index, "Q", sizes=sizes, hint="One face a Gaussian.")
    check_shape("barycentrics", barycentrics, "Q", 3, sizes=sizes)
    check_shape("vertex_quats", vertex_quats, *batch, "V", 4, sizes=sizes, hint="Quaternions are wxyz.")
    check_shape("area_ratio", area_ratio, *batch, "F", sizes=sizes, hint="One ratio a face.")
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
        ("vertex_area_ratio", vertex_area_ratio, posed_vertices.shape[:-1]),
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
