"""Carry Gaussians on the faces of a mesh into a pose, stretched with their faces: covariances come out."""

from typing import Any, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.posing import face_stretch as kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._runtime.incidence import incidence, riders_at_vertices, sum_at_items
from oasis_warp.ops._runtime.launch import even_cuts, launch_ranges, view
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator
from oasis_warp.ops._runtime.values import check_finite


class PosedCovars(NamedTuple):
    """Gaussians in a pose; their covariances need not be those of turned and scaled ones."""

    means: Float[Tensor, "Q 3"]
    covars: Float[Tensor, "Q 3 3"]


def _outputs(rest: Tensor, posed: Tensor, faces: Tensor, face_index: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    q = len(face_index)
    return rest.new_empty((q, 3)), rest.new_empty((q, 3, 3))


def _pose_covars(
    rest: Tensor,
    posed: Tensor,
    faces: Tensor,
    face_index: Tensor,
    barycentrics: Tensor,
    quats: Tensor,
    scales: Tensor,
    validate: bool,
) -> tuple[Tensor, Tensor]:
    if validate:
        check_finite(
            rest_vertices=rest, posed_vertices=posed, barycentrics=barycentrics, quats=quats, scales=scales
        )
    corners = incidence("faces", faces, len(rest), "vertices").table
    riders = incidence("face_index", face_index, len(faces), "faces").table
    out = _outputs(rest, posed, faces, face_index)
    floats = [tensor.contiguous() for tensor in (rest, posed, barycentrics, quats, scales)]
    launch_ranges(
        kernels.pose,
        even_cuts(len(riders)),
        [*map(view, (*floats[:2], corners, riders, *floats[2:], *out))],
        like=rest,
    )
    return out


def _gradients(*inputs: Any) -> list[Tensor]:
    """An empty tensor for each float input, of no rows where no gradient is wanted."""
    floats = (*inputs[:2], *inputs[4:7])
    return [
        tensor.new_empty((len(tensor) if needed else 0, tensor.shape[1]))
        for tensor, needed in zip(floats, inputs[-1], strict=True)
    ]


def _pose_covars_backward(
    rest: Tensor,
    posed: Tensor,
    faces: Tensor,
    face_index: Tensor,
    barycentrics: Tensor,
    quats: Tensor,
    scales: Tensor,
    grad_means: Tensor | None,
    grad_covars: Tensor | None,
    needs: list[bool],
) -> list[Tensor]:
    corners = incidence("faces", faces, len(rest), "vertices").table
    riders = incidence("face_index", face_index, len(faces), "faces").table
    q = len(riders)
    given = [
        out.zero_() if grad is None else grad.contiguous()
        for out, grad in zip(_outputs(rest, posed, faces, face_index), (grad_means, grad_covars), strict=True)
    ]
    found = _gradients(rest, posed, faces, face_index, barycentrics, quats, scales, needs)
    rows = [rest.new_empty((q if needed else 0, 9)) for needed in needs[:2]]
    floats = [tensor.contiguous() for tensor in (rest, posed, barycentrics, quats, scales)]
    launch_ranges(
        kernels.pose_backward,
        even_cuts(q),
        [*map(view, (*floats[:2], corners, riders, *floats[2:], *given, *rows, *found[2:]))],
        like=rest,
    )
    at_vertices = riders_at_vertices(faces, face_index, None, len(rest))
    for k in range(2):
        if needs[k]:
            found[k] = sum_at_items(rows[k].view(-1, 3), at_vertices)
    return found


_operator = operator("pose_on_mesh_covars", _pose_covars, _outputs)
_adjoint = adjoint("pose_on_mesh_covars_backward", _pose_covars_backward, _gradients)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:7])


def _backward(ctx: Any, grad_means: Tensor | None, grad_covars: Tensor | None) -> tuple[Tensor | None, ...]:
    needs = [*ctx.needs_input_grad[:2], *ctx.needs_input_grad[4:7]]
    found = _adjoint(*ctx.saved_tensors, grad_means, grad_covars, needs)
    rest, posed, *others = (grad if needed else None for grad, needed in zip(found, needs, strict=True))
    return (
        rest,
        posed,
        None,  # faces
        None,  # face_index
        *others,
        None,  # validate
    )


differentiable(_operator, _backward, _save)


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
    """Gaussians on the faces of a mesh, carried into its pose and stretched with it: the scale law "jacobian".

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
        face_index: The face each Gaussian rides on, shape [Q]; Q may be 0.
        barycentrics: Weights of that face's corners, rows of sum 1 and not negative, shape [Q, 3].
        quats: Canonical rotations, wxyz, of any positive norm, shape [Q, 4].
        scales: Canonical standard deviations [m], shape [Q, 3].
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    sizes: dict[str, int] = {}
    check_shape("rest_vertices", rest_vertices, "V", 3, sizes=sizes)
    check_shape("posed_vertices", posed_vertices, "V", 3, sizes=sizes, hint="One for each rest vertex.")
    check_shape("faces", faces, "F", 3, hint="Three vertex indices a face.")
    check_shape("face_index", face_index, "Q", sizes=sizes, hint="One face a Gaussian.")
    check_shape("barycentrics", barycentrics, "Q", 3, sizes=sizes)
    check_shape("quats", quats, "Q", 4, sizes=sizes, hint="Quaternions are wxyz.")
    check_shape("scales", scales, "Q", 3, sizes=sizes)
    for name, tensor in (
        ("rest_vertices", rest_vertices),
        ("posed_vertices", posed_vertices),
        ("barycentrics", barycentrics),
        ("quats", quats),
        ("scales", scales),
    ):
        check_float(name, tensor, rest_vertices)
    return PosedCovars(
        *_operator(rest_vertices, posed_vertices, faces, face_index, barycentrics, quats, scales, validate)
    )
