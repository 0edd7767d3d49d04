"""Carry Gaussians that ride on the faces of a mesh into a pose."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_kernels import barycentric as kernels
from oasis_warp.core.checks import check_choice, check_finite, check_float, check_shape
from oasis_warp.ops._incidence import Incidence, incidence, sum_at_items
from oasis_warp.ops._launch import even_cuts, launch_ranges, view

HALF_POWERS = {"sqrt_area": 1, "area": 2, "none": 0}
"""Twice the exponent of the area ratio in each scale law."""


class PosedOnMesh(NamedTuple):
    """Gaussians in a pose."""

    means: Float[Tensor, "Q 3"]
    quats: Float[Tensor, "Q 4"]
    scales: Float[Tensor, "Q 3"]


def _arguments(inputs: Sequence[Tensor], corners: Incidence, riders: Incidence, half_powers: int) -> list[Any]:
    """The arguments that both kernels begin with."""
    posed_vertices, *others = map(view, inputs)
    return [posed_vertices, view(corners.table), view(riders.table), *others, half_powers]


class _PoseOnMesh(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx,
        posed_vertices,
        barycentrics,
        vertex_quats,
        area_ratio,
        quats,
        scales,
        corners: Incidence,
        riders: Incidence,
        half_powers: int,
    ):
        inputs = (posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales)
        posed = (torch.empty_like(barycentrics), torch.empty_like(quats), torch.empty_like(scales))
        arguments = _arguments(inputs, corners, riders, half_powers)
        launch_ranges(kernels.pose, even_cuts(len(quats)), [*arguments, *map(view, posed)], like=quats)
        ctx.save_for_backward(*inputs)
        ctx.corners, ctx.riders, ctx.half_powers = corners, riders, half_powers
        return posed

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_means, grad_quats, grad_scales):
        inputs = ctx.saved_tensors
        n = len(grad_means)
        widths = (9, 3, 12, 1, 4, 3)  # values a Gaussian of each input's gradient; corners side by side
        rows = [
            inputs[0].new_empty((n if needed else 0, width))
            for needed, width in zip(ctx.needs_input_grad[:6], widths, strict=True)
        ]
        vertex_rows, barycentric_rows, vertex_quat_rows, ratio_rows, quat_rows, scale_rows = rows
        launch_ranges(
            kernels.pose_backward,
            even_cuts(n),
            [
                *_arguments(inputs, ctx.corners, ctx.riders, ctx.half_powers),
                view(grad_means.contiguous()),
                view(grad_quats.contiguous()),
                view(grad_scales.contiguous()),
                view(vertex_rows),
                view(vertex_quat_rows),
                view(ratio_rows),
                view(barycentric_rows),
                view(quat_rows),
                view(scale_rows),
            ],
            like=grad_means,
        )

        def at_vertices(gaussian_rows: Tensor, width: int) -> Tensor:
            return sum_at_items(sum_at_items(gaussian_rows, ctx.riders).view(-1, width), ctx.corners)

        posed_vertices, barycentrics, vertex_quats, area_ratio, quats, scales = ctx.needs_input_grad[:6]
        return (
            at_vertices(vertex_rows, 3) if posed_vertices else None,  # posed_vertices
            barycentric_rows if barycentrics else None,  # barycentrics
            at_vertices(vertex_quat_rows, 4) if vertex_quats else None,  # vertex_quats
            sum_at_items(ratio_rows, ctx.riders).view(-1) if area_ratio else None,  # area_ratio
            quat_rows if quats else None,  # quats
            scale_rows if scales else None,  # scales
            None,  # corners
            None,  # riders
            None,  # half_powers
        )


def pose_on_mesh(
    posed_vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    face_index: Int[Tensor, "Q"],
    barycentrics: Float[Tensor, "Q 3"],
    vertex_quats: Float[Tensor, "V 4"],
    area_ratio: Float[Tensor, "F"],
    quats: Float[Tensor, "Q 4"],
    scales: Float[Tensor, "Q 3"],
    scale_law: Literal["sqrt_area", "area", "none"] = "sqrt_area",
    *,
    validate: bool = True,
) -> PosedOnMesh:
    """Gaussians on the faces of a mesh, carried into its pose (OASIS, MM '26, eq. 7 and appendix).

    The mean is the barycentric mean of the face's posed corners. The quaternion is dq * canonical, dq the normalised
    barycentric mean of the corners' rotations, sign-aligned to the corner with the largest weight. The scale is the
    canonical one times the square root of the face's area ratio (a length goes with the root of an area), the ratio
    itself with "area" (the law as printed), or 1 with "none"; ratios are bounded to [1e-4, 1e4].

    Differentiable in every float argument. Which Gaussians ride on a face is computed once for each `face_index`
    tensor and remembered while it lives.

    Args:
        posed_vertices: Vertices of the posed mesh [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        face_index: The face each Gaussian rides on, shape [Q]; Q may be 0.
        barycentrics: Weights of that face's corners, rows of sum 1 and not negative, shape [Q, 3].
        vertex_quats: Unit rotations from rest to posed, wxyz, shape [V, 4]; from `face_rotations`.
        area_ratio: Posed area over rest area, shape [F]; from `face_rotations`.
        quats: Canonical rotations, wxyz, shape [Q, 4]; their norms carry over.
        scales: Canonical standard deviations [m], shape [Q, 3].
        scale_law: How scales follow the area of the face.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype, index or law, or a value that is not finite.
    """
    floats = {
        "posed_vertices": posed_vertices,
        "barycentrics": barycentrics,
        "vertex_quats": vertex_quats,
        "area_ratio": area_ratio,
        "quats": quats,
        "scales": scales,
    }
    sizes: dict[str, int] = {}
    check_shape("posed_vertices", posed_vertices, "V", 3, sizes=sizes)
    check_shape("faces", faces, "F", 3, sizes=sizes, hint="Three vertex indices a face.")
    check_shape("face_index", face_index, "Q", sizes=sizes, hint="One face a Gaussian.")
    check_shape("barycentrics", barycentrics, "Q", 3, sizes=sizes)
    check_shape("vertex_quats", vertex_quats, "V", 4, sizes=sizes, hint="Quaternions are wxyz.")
    check_shape("area_ratio", area_ratio, "F", sizes=sizes, hint="One ratio a face.")
    check_shape("quats", quats, "Q", 4, sizes=sizes, hint="Quaternions are wxyz.")
    check_shape("scales", scales, "Q", 3, sizes=sizes)
    for name, tensor in floats.items():
        check_float(name, tensor, posed_vertices)
    if validate:
        check_finite(**floats)
    check_choice("scale_law", scale_law, tuple(HALF_POWERS))
    corners = incidence("faces", faces, len(posed_vertices), "vertices")
    riders = incidence("face_index", face_index, len(faces), "faces")
    contiguous = (tensor.contiguous() for tensor in floats.values())
    return PosedOnMesh(*_PoseOnMesh.apply(*contiguous, corners, riders, HALF_POWERS[scale_law]))
