"""Checks of shapes, types and plain numbers for the rasterizer; its operators check the values."""

import torch
from torch import Tensor

from oasis_warp.ops.checks import check_float, check_like, check_number, check_pixels, check_positive, check_shape
from oasis_warp.ops.spherical_harmonics import check_degree

MAX_CHANNELS = 32
MAX_PIXELS = 2**31 - 1
MAX_GAUSSIANS = 2**31 - 1
"""Over all cameras: kernels number them in int32."""


def check_gaussians(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None, opacities: Tensor
) -> None:
    """Refuse Gaussians whose tensors do not belong together."""
    check_shape("means", means, "N", 3)
    check_float("means", means)
    n = means.shape[0]
    check_like("opacities", opacities, (n,), means, "One number for each centre.")
    if covars is not None:
        check_like("covars", covars, (n, 3, 3), means, "One matrix for each centre.")
    elif quats is None or scales is None:
        name = "quats" if quats is None else "scales"
        raise ValueError(f"{name}: expected a tensor, got None. Shapes are quats with scales, or covars.")
    else:
        check_like("quats", quats, (n, 4), means, "One wxyz row for each centre.")
        check_like("scales", scales, (n, 3), means, "One row for each centre.")


def check_cameras(
    viewmats: Tensor, Ks: Tensor, means: Tensor, width: int, height: int, near_plane: float, far_plane: float,
    radius_clip: float, eps2d: float, tile_size: int,
) -> None:  # fmt: skip
    """Refuse cameras, images and limits that kernels cannot draw."""
    check_shape("viewmats", viewmats, "C", 4, 4, hint="A single camera is viewmat[None].")
    check_float("viewmats", viewmats, like=means)
    n_cameras = viewmats.shape[0]
    check_like("Ks", Ks, (n_cameras, 3, 3), means, "One matrix for each viewmat.")
    for name, value in (("width", width), ("height", height), ("tile_size", tile_size)):
        check_pixels(name, value)
    if n_cameras * width * height > MAX_PIXELS:
        raise ValueError(
            f"width: expected at most {MAX_PIXELS} pixels in all images, got {n_cameras} x {height} x {width}. "
            "Draw fewer cameras per call."
        )
    if n_cameras * len(means) > MAX_GAUSSIANS:
        raise ValueError(
            f"means: expected at most {MAX_GAUSSIANS} Gaussians for all cameras, got {n_cameras} x {len(means)}. "
            "Draw fewer cameras per call."
        )
    check_positive("near_plane", near_plane)
    for name, value in (("far_plane", far_plane), ("radius_clip", radius_clip), ("eps2d", eps2d)):
        check_number(name, value)
    if not far_plane > near_plane:
        raise ValueError(f"far_plane: expected more than near_plane, {near_plane!r}, got {far_plane!r}.")
    if not radius_clip >= 0:
        raise ValueError(f"radius_clip: expected a number of pixels, at least 0, got {radius_clip!r}.")
    if not 0 <= eps2d < float("inf"):
        raise ValueError(f"eps2d: expected a finite variance, at least 0, got {eps2d!r}.")


def check_coefficients(coefficients: Tensor, sh_degree: int, means: Tensor, n_cameras: int) -> None:
    """Refuse coefficients of spherical harmonics that do not belong to the Gaussians, cameras and degree."""
    sizes = {"N": means.shape[0], "C": n_cameras}
    if isinstance(coefficients, Tensor) and coefficients.dim() == 4:
        check_shape("colors", coefficients, "C", "N", "K", 3, sizes=sizes, hint="Or [N, K, 3].")
    else:
        hint = "With sh_degree they are K coefficients of three channels for each centre."
        check_shape("colors", coefficients, "N", "K", 3, sizes=sizes, hint=hint)
    check_float("colors", coefficients, like=means)
    check_degree("sh_degree", sh_degree, coefficients.shape[-2])


def check_invertible(viewmats: Tensor) -> None:
    """Refuse cameras without a place, from which harmonics could be seen."""
    if bool((torch.linalg.det(viewmats.detach()[:, :3, :3].double()) == 0).any()):
        raise ValueError("viewmats: expected rotations, with sh_degree, got a matrix that has no inverse.")


def check_colors(colors: Tensor, backgrounds: Tensor | None, means: Tensor, n_cameras: int) -> None:
    """Refuse colours and backgrounds that do not belong to the Gaussians and cameras."""
    sizes = {"N": means.shape[0], "C": n_cameras}
    if isinstance(colors, Tensor) and colors.dim() == 2:
        check_shape("colors", colors, "N", "D", sizes=sizes, hint="One row for each centre.")
    else:
        check_shape("colors", colors, "C", "N", "D", sizes=sizes, hint="Or [N, D], the same for all cameras.")
    check_float("colors", colors, like=means)
    if not 1 <= colors.shape[-1] <= MAX_CHANNELS:
        raise ValueError(f"colors: expected 1 to {MAX_CHANNELS} channels, got {colors.shape[-1]}. Draw the rest apart.")
    if backgrounds is not None:
        check_like("backgrounds", backgrounds, (n_cameras, colors.shape[-1]), means, "One row for each camera.")
