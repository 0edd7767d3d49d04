"""Gaussians and cameras -> projected Gaussians, differentiable in means, shapes and viewmats.

A shape is a quaternion with three scales, or a covariance.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, Int32, UInt8
from torch import Tensor

from oasis_warp.ops._runtime.declaration import Array, Operator, empty_gradients
from oasis_warp.ops._runtime.launch import contiguous, has_cuda_kernels, has_vectors
from oasis_warp.ops._runtime.projection_backends import (
    Incoming,
    Limits,
    Outputs,
    ProjectionGradients,
    ProjectionInputs,
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
from oasis_warp.ops.checks import check_finite


class Projection(NamedTuple):
    """Gaussians on the image planes of C cameras. A Gaussian that is not drawn has radius 0 and zeros."""

    means2d: Float[Tensor, "C N 2"]
    """Centres [px]."""
    covars2d: Float64[Tensor, "C N 3"]
    """Covariances xx, xy, yy with the low-pass [px^2]; float64, or the gradient of a needle would cancel."""
    depths: Float[Tensor, "C N"]
    """Camera z, also of Gaussians that are not drawn."""
    conics: Float[Tensor, "C N 3"]
    """Inverse covariances xx, xy, yy; for reading, without gradient, as all below."""
    radii: Int32[Tensor, "C N 2"]
    """Half the sides of the box outside which the Gaussian is fainter than 1/255 [px], rounded up."""
    records: UInt8[Tensor, "B"]
    """For the blending: see `records`."""

    def tables(self) -> Tables:
        """The records."""
        return tables(self.records, *self.depths.shape, self.depths.dtype)


def check_values(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor,
    viewmats: Tensor, Ks: Tensor,
) -> None:  # fmt: skip
    """Refuse values that would give a plausible but wrong picture.

    Raises:
        ValueError: names the argument: NaN, infinities and magnitudes above 1e15, zero quaternions, negative variances,
            opacities outside [0, 1], zero focal lengths.
    """
    check_finite(means=means, quats=quats, scales=scales, covars=covars, opacities=opacities, viewmats=viewmats, Ks=Ks)
    if quats is not None:
        zeros = int((quats.detach() == 0).all(-1).sum())
        if zeros:
            raise ValueError(f"quats: expected nonzero rows, got {zeros} zero rows. (1, 0, 0, 0) is the identity.")
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
    check_focal_lengths("Ks", Ks)


def check_focal_lengths(name: str, Ks: Tensor) -> None:
    """Refuse intrinsics [..., 3, 3] with a focal length of 0.

    Raises:
        ValueError: names the argument.
    """
    if bool((Ks.detach()[..., [0, 1], [0, 1]] == 0).any()):
        raise ValueError(f"{name}: expected focal lengths other than 0, got 0.")


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
    ortho: bool,
    limits: list[float],  # as `Limits`
    validate: bool,
) -> Outputs:
    scene = ProjectionInputs(means, quats, scales, covars, viewmats, Ks, width, height, int(ortho))
    check_arrays(scene, opacities=(opacities, means.shape[:1], means.dtype))
    out = empty_outputs(means, viewmats, width, height)
    if has_cuda_kernels(means) or (len(means) and len(viewmats) and has_vectors(means)):
        # The kernel checks values as it reads them; the slow checks then say what is wrong with them.
        run = project_cuda if means.is_cuda else project_vectors
        sound = run(scene.contiguous(), opacities.contiguous(), Limits(*limits), out, validate)
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
    means: Tensor, quats: Any, scales: Any, covars: Any, opacities: Any, viewmats: Tensor, Ks: Any, width: int,
    height: int, *_: Any,
) -> Outputs:  # fmt: skip
    return empty_outputs(means, viewmats, width, height)


def _project_backward(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, viewmats: Tensor, Ks: Tensor,
    radii: Tensor, width: int, height: int, ortho: bool, g_means2d: Tensor | None, g_covars2d: Tensor | None,
    g_depths: Tensor | None, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    scene = ProjectionInputs(means, quats, scales, covars, viewmats, Ks, width, height, int(ortho))
    shape = len(viewmats), len(means)
    check_arrays(
        scene,
        radii=(radii, (*shape, 2), torch.int32),
        g_means2d=(g_means2d, (*shape, 2), means.dtype),
        g_covars2d=(g_covars2d, (*shape, 3), torch.float64),
        g_depths=(g_depths, shape, means.dtype),
    )
    gradients = empty_gradients((means, quats, scales, covars, viewmats), needs)
    if not (len(means) and len(viewmats)):
        return [gradient.zero_() for gradient in gradients]
    incoming = Incoming(*contiguous(g_means2d, g_covars2d, g_depths))
    run = backward_vectors if has_vectors(means) else backward_cuda if has_cuda_kernels(means) else backward_generic
    run(scene.contiguous(), radii.contiguous(), incoming, ProjectionGradients(*gradients), needs_cameras=needs[-1])
    return gradients


_OPERATOR = Operator(
    "project",
    _project,
    _project_fake,
    _project_backward,
    inputs={
        "means": Array("N 3", grad=True),
        "quats": Array("N 4", grad=True, optional=True),
        "scales": Array("N 3", grad=True, optional=True),
        "covars": Array("N 3 3", grad=True, optional=True),
        "opacities": Array("N"),
        "viewmats": Array("C 4 4", grad=True),
        "Ks": Array("C 3 3"),
    },
    outputs={"means2d": "C N 2", "covars2d": "C N 3", "depths": "C N"},
    auxiliary={"conics": "C N 3", "radii": "C N 2", "records": "B"},
    validates_itself=True,
    caller="rasterization",
    public=False,
)


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
    ortho: bool = False,
    validate: bool = False,
) -> Projection:
    """Gaussians projected to each camera's image plane (Zwicker et al. 2001); arguments as in `rasterization`.

    Shapes are quats and scales, or covars. Of covars the symmetric part is read, so gradients by them are symmetric.

    Raises:
        ValueError: shapes, types or devices that do not belong together; with `validate`, as `check_values`.
    """
    return Projection(
        *_OPERATOR(
            means, quats, scales, covars, opacities, viewmats, Ks, width, height, ortho,
            [near_plane, far_plane, radius_clip, eps2d], validate,
        )
    )  # fmt: skip
