"""Posing of Gaussians that are bound to the faces and vertices of a mesh."""

from typing import Any, Literal, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.posing import face_stretch as stretch_kernels
from oasis_warp.ops._runtime.declaration import Array, Operator, empty_gradients
from oasis_warp.ops._runtime.incidence import gaussians_at_vertices, incidence, sum_at_items
from oasis_warp.ops._runtime.launch import contiguous, has_cuda_kernels, has_vectors, launch_ranges
from oasis_warp.ops._runtime.mesh_gaussians import (
    PosingInputs,
    backward_float32,
    backward_float64,
    find_gaussians,
    pose_float32,
    pose_float64,
)
from oasis_warp.ops.checks import check_choice

HALF_POWERS = {"sqrt_area": 1, "area": 2, "none": 0}
"""Twice the exponent of the area ratio in each scale law."""
FACES = Array("F 3", index="V", hint="Three vertex indices a face.")
FACE_INDEX = Array("Q", index="F", hint="One face a Gaussian.")
BARYCENTRICS = Array("Q 3", grad=True)


class PosedOnMesh(NamedTuple):
    """Gaussians in a pose: those on vertices first, then those on faces."""

    means: Float[Tensor, "*B N 3"]
    quats: Float[Tensor, "*B N 4"]
    scales: Float[Tensor, "*B N 3"]


def _outputs(*inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
    posed_vertices, quats = inputs[0], inputs[6]
    shape = *posed_vertices.shape[:-2], len(quats)
    return quats.new_empty((*shape, 3)), quats.new_empty((*shape, 4)), quats.new_empty((*shape, 3))


def _pose_on_mesh(
    posed_vertices: Tensor, faces: Tensor, face_index: Tensor, barycentrics: Tensor, vertex_quats: Tensor,
    area_ratio: Tensor, quats: Tensor, scales: Tensor, vertex_index: Tensor | None, offsets: Tensor | None,
    vertex_area_ratio: Tensor | None, half_powers: int, validate: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    arguments = (
        posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, vertex_index, offsets,
        vertex_area_ratio, half_powers, validate,
    )  # fmt: skip
    on_cuda = has_cuda_kernels(quats)
    if posed_vertices.ndim == 3 and not on_cuda:
        return _POSE_ON_MESH.each_pose(*arguments)
    gaussians = find_gaussians(faces, face_index, vertex_index, posed_vertices.shape[-2], transposed=False)
    inputs = PosingInputs(
        posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio
    )
    posed = _outputs(*arguments)
    run = pose_float32 if on_cuda or has_vectors(quats) else pose_float64
    run(inputs, gaussians, half_powers, posed)
    return posed


def _pose_on_mesh_backward(
    posed_vertices: Tensor, faces: Tensor, face_index: Tensor, barycentrics: Tensor, vertex_quats: Tensor,
    area_ratio: Tensor, quats: Tensor, scales: Tensor, vertex_index: Tensor | None, offsets: Tensor | None,
    vertex_area_ratio: Tensor | None, half_powers: int, g_posed_means: Tensor | None, g_posed_quats: Tensor | None,
    g_posed_scales: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    saved = (
        posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, vertex_index, offsets,
        vertex_area_ratio,
    )  # fmt: skip
    inputs = PosingInputs(
        posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales, offsets, vertex_area_ratio
    )
    gradients = empty_gradients(inputs, needs)
    if not len(quats) or not len(posed_vertices):  # empty scratch has no address, by which kernels know what is needed
        return [gradient.zero_() for gradient in gradients]
    incoming = g_posed_means, g_posed_quats, g_posed_scales
    on_cuda = has_cuda_kernels(quats)
    if posed_vertices.ndim == 3 and not on_cuda:
        return _POSE_ON_MESH.each_pose_backward(*saved, half_powers, *incoming, needs)
    needed, found = PosingInputs(*needs), PosingInputs(*gradients)
    at_vertices = needed.vertices or needed.vertex_quats or needed.vertex_area_ratio
    gaussians = find_gaussians(faces, face_index, vertex_index, posed_vertices.shape[-2], transposed=at_vertices)
    if on_cuda or has_vectors(quats):
        return list(backward_float32(inputs, gaussians, half_powers, incoming, found))
    zeros = _outputs(*saved)
    given = [z.zero_() if g is None else g for g, z in zip(incoming, zeros, strict=True)]
    return list(backward_float64(inputs, gaussians, half_powers, given, found, needed))


_POSE_ON_MESH = Operator(
    "pose_on_mesh",
    _pose_on_mesh,
    _outputs,
    _pose_on_mesh_backward,
    inputs={
        "posed_vertices": Array("*B V 3", grad=True),
        "faces": FACES,
        "face_index": FACE_INDEX,
        "barycentrics": BARYCENTRICS,
        "vertex_quats": Array("*B V 4", grad=True, hint="Quaternions are wxyz."),
        "area_ratio": Array("*B F", grad=True, hint="One ratio a face."),
        "vertex_index": Array("P", index="V", optional=True, hint="One vertex a Gaussian."),
        "quats": Array("P+Q 4", grad=True, hint="Quaternions are wxyz."),
        "scales": Array("P+Q 3", grad=True),
        "offsets": Array("P 3", grad=True, optional=True),
        "vertex_area_ratio": Array("*B V", grad=True, optional=True),
    },
    outputs={"posed_means": "*B P+Q 3", "posed_quats": "*B P+Q 4", "posed_scales": "*B P+Q 3"},
    reference="posing.pose_on_mesh",
)


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
    """Pose Gaussians that are bound to the faces and vertices of a mesh (OASIS, MM '26, eq. 7, appendix).

    On a face, the mean is the barycentric mean of the posed corners. The quaternion is dq * canonical, dq the
    normalised barycentric mean of the corners' rotations, sign-aligned to the corner with the largest weight. The scale
    is the canonical one times the square root of the face's area ratio (a length goes with the root of an area), the
    ratio itself with "area" (the law as printed), or 1 with "none"; ratios are bounded to [1e-4, 1e4]. A fourth law,
    which stretches Gaussians with the face, leaves no axes and scales: `pose_on_mesh_covars`.

    On a vertex, the mean is the posed vertex plus the offset, rotated as the vertex; so is the quaternion, and the
    scale follows the vertex's area ratio by the same law.

    Differentiable in every float argument. The Gaussians of each face and vertex are found once for each `face_index`
    tensor and cached while it lives.

    With an axis of poses B before `posed_vertices` and the results of `face_rotations` for them, one call carries the
    Gaussians into every pose, and every output has that axis too. The results are those of as many calls.

    Args:
        posed_vertices: Vertices of the posed mesh [m], shape [V, 3], or of B poses of it, shape [B, V, 3].
        faces: Vertex indices, shape [F, 3].
        face_index: The face that each Gaussian is bound to, shape [Q]; Q may be 0.
        barycentrics: Weights of that face's corners, rows of sum 1 and not negative, shape [Q, 3].
        vertex_quats: Unit rotations from rest to posed, wxyz, shape [V, 4] or [B, V, 4]; from `face_rotations`.
        area_ratio: Posed area over rest area, shape [F] or [B, F]; from `face_rotations`.
        quats: Canonical rotations, wxyz, shape [N, 4], N = P + Q: first of the Gaussians on vertices, then of those on
            faces. Their norms carry over.
        scales: Canonical standard deviations [m], shape [N, 3].
        scale_law: How scales follow areas.
        vertex_index: The vertex that each of the first P Gaussians is bound to, shape [P]; None for P = 0.
        offsets: Shift of each of them from its vertex at rest [m], shape [P, 3]. Goes with `vertex_index`.
        vertex_area_ratio: Posed area over rest area around each vertex, shape [V] or [B, V]; from `face_rotations`.
            Goes with `vertex_index`.
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once for each tensor.

    Raises:
        ValueError: a wrong shape, dtype, index or law, a value that is not finite, or only some of the three arguments
            for Gaussians on vertices.
    """
    if len({vertex_index is None, offsets is None, vertex_area_ratio is None}) > 1:
        name = "offsets" if (offsets is None) != (vertex_index is None) else "vertex_area_ratio"
        expected, got = ("None", "a tensor") if vertex_index is None else ("a tensor", "None")
        raise ValueError(f"{name}: expected {expected}, got {got}. It goes with vertex_index.")
    _POSE_ON_MESH.check(
        posed_vertices=posed_vertices, faces=faces, face_index=face_index, barycentrics=barycentrics,
        vertex_quats=vertex_quats, area_ratio=area_ratio, vertex_index=vertex_index, quats=quats, scales=scales,
        offsets=offsets, vertex_area_ratio=vertex_area_ratio,
    )  # fmt: skip
    check_choice("scale_law", scale_law, tuple(HALF_POWERS))
    return PosedOnMesh(
        *_POSE_ON_MESH(
            posed_vertices, faces, face_index, barycentrics, vertex_quats, area_ratio, quats, scales, vertex_index,
            offsets, vertex_area_ratio, HALF_POWERS[scale_law], validate,
        )
    )  # fmt: skip


class PosedCovars(NamedTuple):
    """Posed Gaussians with full covariances, which need not be rotated and scaled canonical ones."""

    means: Float[Tensor, "Q 3"]
    covars: Float[Tensor, "Q 3 3"]


def _covars_outputs(
    rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, face_index: Tensor, *_: Any
) -> tuple[Tensor, Tensor]:
    q = len(face_index)
    return rest_vertices.new_empty((q, 3)), rest_vertices.new_empty((q, 3, 3))


def _stretch_arguments(
    rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, face_index: Tensor, *others: Tensor
) -> list[Any]:
    """The first arguments of both kernels."""
    corners = incidence("faces", faces, len(rest_vertices), "vertices").table
    face_of = incidence("face_index", face_index, len(faces), "faces").table
    rest, posed, *floats = contiguous(rest_vertices, posed_vertices, *others)
    return [rest, posed, corners, face_of, *floats]


def _pose_covars(
    rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, face_index: Tensor, barycentrics: Tensor,
    quats: Tensor, scales: Tensor, validate: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    out = _covars_outputs(rest_vertices, posed_vertices, faces, face_index)
    arguments = _stretch_arguments(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales)
    launch_ranges(stretch_kernels.pose, len(face_index), [*arguments, *out], like=rest_vertices)
    return out


def _pose_covars_backward(
    rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor, face_index: Tensor, barycentrics: Tensor,
    quats: Tensor, scales: Tensor, g_means: Tensor | None, g_covars: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    q, zeros = len(face_index), _covars_outputs(rest_vertices, posed_vertices, faces, face_index)
    incoming = [z.zero_() if g is None else g.contiguous() for g, z in zip((g_means, g_covars), zeros, strict=True)]
    gradients = empty_gradients((rest_vertices, posed_vertices, barycentrics, quats, scales), needs)
    rows = [rest_vertices.new_empty((q if needed else 0, 9)) for needed in needs[:2]]
    arguments = _stretch_arguments(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales)
    launch_ranges(stretch_kernels.pose_backward, q, [*arguments, *incoming, *rows, *gradients[2:]], like=rest_vertices)
    corners = incidence("faces", faces, len(rest_vertices), "vertices")
    at_vertices = gaussians_at_vertices(corners, incidence("face_index", face_index, len(faces), "faces"), None)
    for k in range(2):
        if needs[k]:
            gradients[k] = sum_at_items(rows[k].view(-1, 3), at_vertices)
    return gradients


_POSE_ON_MESH_COVARS = Operator(
    "pose_on_mesh_covars",
    _pose_covars,
    _covars_outputs,
    _pose_covars_backward,
    inputs={
        "rest_vertices": Array("V 3", grad=True),
        "posed_vertices": Array("V 3", grad=True, hint="One for each rest vertex."),
        "faces": FACES,
        "face_index": FACE_INDEX,
        "barycentrics": BARYCENTRICS,
        "quats": Array("Q 4", grad=True, hint="Quaternions are wxyz."),
        "scales": Array("Q 3", grad=True),
    },
    outputs={"means": "Q 3", "covars": "Q 3 3"},
    reference="posing.pose_on_mesh_covars",
)


def pose_on_mesh_covars(
    rest_vertices: Float[Tensor, "V 3"],
    posed_vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    face_index: Int[Tensor, "Q"],
    barycentrics: Float[Tensor, "Q 3"],
    quats: Float[Tensor, "Q 4"],
    scales: Float[Tensor, "Q 3"],
    *,
    validate: bool = True,
) -> PosedCovars:
    """Posed Gaussians on the faces of a mesh, stretched with their faces: the scale law "jacobian".

    The covariance becomes F covariance F^T, F the linear map that takes the face's edges and unit normal at rest to
    those of the posed face. A Gaussian grows only along the directions in which its face does, and keeps its
    thickness. That is no longer a rotation and three scales along its axes, hence covariances, which `rasterization`
    takes as `covars`. The mean is the barycentric mean of the posed corners, as in `pose_on_mesh`, which has the other
    laws. A face that is flat (area 0 but for rounding) at rest or posed leaves covariances as they are.

    Differentiable in every float argument.

    Args:
        rest_vertices: Vertices at rest [m], shape [V, 3], float32 or float64.
        posed_vertices: The same vertices posed [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        face_index: The face that each Gaussian is bound to, shape [Q]; Q may be 0.
        barycentrics: Weights of that face's corners, rows of sum 1 and not negative, shape [Q, 3].
        quats: Canonical rotations, wxyz, of any positive norm, shape [Q, 4].
        scales: Canonical standard deviations [m], shape [Q, 3].
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once for each tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    _POSE_ON_MESH_COVARS.check(
        rest_vertices=rest_vertices, posed_vertices=posed_vertices, faces=faces, face_index=face_index,
        barycentrics=barycentrics, quats=quats, scales=scales,
    )  # fmt: skip
    return PosedCovars(
        *_POSE_ON_MESH_COVARS(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales, validate)
    )
