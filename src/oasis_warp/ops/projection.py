"""Gaussians and cameras -> what the rasterizer draws, differentiable in means, shapes and viewmats.

A shape is a quaternion with three scales, or a covariance.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, Int32, UInt8
from torch import Tensor

from oasis_warp.core.checks import check_finite
from oasis_warp.ops._runtime.launch import has_cuda_kernels, has_vectors
from oasis_warp.ops._runtime.project_launch import (
    Incoming,
    Limits,
    Outputs,
    Scene,
    backward_cuda,
    backward_generic,
    backward_vectors,
    check_arrays,
    empty_outputs,
    project_cuda,
    project_generic,
    project_vectors,
)
from oasis_warp.ops._runtime.records import Tables, tables
from oasis_warp.ops._runtime.registration import adjoint, differentiable, operator

INPUTS = "means", "quats", "scales", "covars", "viewmats"
"""Arguments that receive gradients."""
Gradients = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class Projection(NamedTuple):
    """Gaussians on the image planes of C cameras. A Gaussian that is not drawn has radius 0 and zeros."""

    means2d: Float[Tensor, "C N 2"]
    """Centres [px]."""
    covars2d: Float64[Tensor, "C N 3"]
    """Covariances xx, xy, yy with the low-pass [px^2]; float64, or the gradient of a needle would cancel."""
    depths: Float[Tensor, "C N"]
    """Camera z, of Gaussians that are not drawn too."""
    conics: Float[Tensor, "C N 3"]
    """Inverse covariances xx, xy, yy; for reading, without gradient, as all below."""
    radii: Int32[Tensor, "C N 2"]
    """Half the sides of the box outside which the Gaussian is fainter than 1/255 [px], rounded up."""
    records: UInt8[Tensor, "B"]
    """For whoever draws: see `_records`."""

    def tables(self) -> Tables:
        """The records."""
        return tables(self.records, *self.depths.shape, self.depths.dtype)


def check_values(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
) -> None:
    """Refuse values that a kernel would hide in a plausible picture.

    Raises:
        ValueError: names the argument: NaN, infinities and magnitudes above 1e15, zero quaternions, negative variances,
            opacities outside [0, 1], zero focal lengths.
    """
    check_finite(
        means=means, quats=quats, scales=scales, covars=covars, opacities=opacities, viewmats=viewmats, Ks=Ks
    )
    if quats is not None:
        zeros = int((quats.detach() == 0).all(-1).sum())
        if zeros:
            raise ValueError(f"quats: expected rows that are not zero, got {zeros} zero rows. (1, 0, 0, 0) is no turn.")
    if covars is not None:
        negative = int((covars.detach().diagonal(dim1=-2, dim2=-1) < 0).any(-1).sum())
        if negative:
            raise ValueError(
                f"covars: expected variances of at least 0, got {negative} matrices with a negative one. "
                "A covariance is R S S^T R^T."
            )
    if opacities.numel():
        low, high = (float(v) for v in opacities.detach().aminmax())
        if low < 0 or high > 1:
            raise ValueError(
                f"opacities: expected values in [0, 1], got {low:g} to {high:g}. Logits go through a sigmoid first."
            )
    if bool((Ks.detach()[:, [0, 1], [0, 1]] == 0).any()):
        raise ValueError("Ks: expected focal lengths other than 0, got 0.")


def _project(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    limits: list[float],  # as `Limits`
    validate: bool,
) -> Outputs:
    scene = Scene(means, quats, scales, covars, viewmats, Ks, width, height)
    check_arrays(scene, opacities=(opacities, means.shape[:1], means.dtype))
    out = empty_outputs(means, viewmats, width, height)
    if has_cuda_kernels(means) or (len(means) and len(viewmats) and has_vectors(means)):
        # The kernel looks at the values as it reads them; what is wrong with them is for the slow checks to say.
        scene, opacities = scene.contiguous(), opacities.contiguous()
        if means.is_cuda:
            sound = project_cuda(scene, opacities, Limits(*limits), out, validate)
        else:
            sound = project_vectors(scene, opacities, Limits(*limits), out)
        if validate and not sound:
            check_values(means, quats, scales, covars, opacities, viewmats, Ks)
            raise AssertionError("the kernel has met a bad value that is not in its inputs")
        return out
    if validate:
        check_values(means, quats, scales, covars, opacities, viewmats, Ks)
    if len(means) and len(viewmats):
        project_generic(scene.contiguous(), opacities.contiguous(), Limits(*limits), out)
    return out


def _project_fake(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *_: Any,
) -> Outputs:
    return empty_outputs(means, viewmats, width, height)


def _project_backward(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    radii: Tensor,
    g_means2d: Tensor | None,
    g_covars2d: Tensor | None,
    g_depths: Tensor | None,
    wanted: list[bool],
) -> Gradients:
    scene = Scene(means, quats, scales, covars, viewmats, Ks, width, height)
    shape = len(viewmats), len(means)
    check_arrays(
        scene,
        radii=(radii, (*shape, 2), torch.int32),
        g_means2d=(g_means2d, (*shape, 2), means.dtype),
        g_covars2d=(g_covars2d, (*shape, 3), torch.float64),
        g_depths=(g_depths, shape, means.dtype),
    )
    out = _empty_gradients(means, quats, scales, covars, viewmats, wanted)
    if not (len(means) and len(viewmats)):
        for gradient in out:
            gradient.zero_()
        return out
    incoming = Incoming(g_means2d, g_covars2d, g_depths).contiguous()
    run = backward_vectors if has_vectors(means) else backward_cuda if has_cuda_kernels(means) else backward_generic
    named = {name: g for name, g, asked in zip(INPUTS, out, wanted, strict=True) if asked}
    run(scene.contiguous(), radii.contiguous(), incoming, named)
    return out


def _project_backward_fake(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    radii: Tensor,
    g_means2d: Tensor | None,
    g_covars2d: Tensor | None,
    g_depths: Tensor | None,
    wanted: list[bool],
) -> Gradients:
    return _empty_gradients(means, quats, scales, covars, viewmats, wanted)


def _empty_gradients(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    viewmats: Tensor,
    wanted: list[bool],
) -> Gradients:
    """Memory for the gradients by `INPUTS` that are `wanted`, and tensors of size 0 for the others."""
    inputs = means, quats, scales, covars, viewmats
    g_means, g_quats, g_scales, g_covars, g_viewmats = (
        means.new_empty(tensor.shape if asked and tensor is not None else 0)
        for tensor, asked in zip(inputs, wanted, strict=True)
    )
    return g_means, g_quats, g_scales, g_covars, g_viewmats


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    means, quats, scales, covars, _opacities, viewmats, Ks, width, height, *_ = inputs
    projection = Projection(*output)
    ctx.size = width, height
    ctx.save_for_backward(means, quats, scales, covars, viewmats, Ks, projection.radii)
    ctx.mark_non_differentiable(*projection[3:])
    ctx.set_materialize_grads(False)


def _differentiate(
    ctx: Any, g_means2d: Tensor | None, g_covars2d: Tensor | None, g_depths: Tensor | None, *_: None
) -> tuple[Tensor | None, ...]:
    *scene, radii = ctx.saved_tensors
    needs = ctx.needs_input_grad
    wanted = [*needs[:4], needs[5]]
    out = project_backward_op(*scene, *ctx.size, radii, g_means2d, g_covars2d, g_depths, wanted)
    g_means, g_quats, g_scales, g_covars, g_viewmats = (
        g if asked else None for g, asked in zip(out, wanted, strict=True)
    )
    return (
        g_means,
        g_quats,
        g_scales,
        g_covars,
        None,  # opacities: they decide what is drawn, and no more
        g_viewmats,
        None,  # Ks
        None,  # width
        None,  # height
        None,  # limits
        None,  # validate
    )


project_op = operator("project", _project, _project_fake)
project_backward_op = adjoint("project_backward", _project_backward, _project_backward_fake)
differentiable(project_op, _differentiate, _save)


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"] | None,
    scales: Float[Tensor, "N 3"] | None,
    opacities: Float[Tensor, "N"],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    width: int,
    height: int,
    *,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    covars: Float[Tensor, "N 3 3"] | None = None,
    validate: bool = False,
) -> Projection:
    """The Gaussians on each camera's image plane (Zwicker et al. 2001); arguments as in `rasterization`.

    Shapes are quats and scales, or covars, of which the symmetric part is read: gradients by it are symmetric.

    Raises:
        ValueError: shapes, types or devices that do not belong together; with `validate`, as `check_values`.
    """
    return Projection(
        *project_op(
            means, quats, scales, covars, opacities, viewmats, Ks, width, height,
            [near_plane, far_plane, radius_clip, eps2d], validate,
        )
    )  # fmt: skip
