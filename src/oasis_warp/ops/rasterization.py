"""3D Gaussians -> images: the public rasterizer, with gsplat's signature."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import constants
from oasis_warp.core.checks import check_choice, check_finite, check_float, check_positive, check_shape
from oasis_warp.ops.blending import blend
from oasis_warp.ops.projection import Projection, project
from oasis_warp.ops.spherical_harmonics import check_degree, spherical_harmonics

MAX_CHANNELS = 32
MAX_PIXELS = 2**31 - 1

UNSUPPORTED: dict[str, tuple[Any, str]] = {
    "sparse_grad": (False, "Gradients are dense."),
    "absgrad": (False, "The gradient of meta['means2d'] is the plain one."),
    "rasterize_mode": ("classic", "Antialiasing by opacity compensation is not built in."),
    "distributed": (False, "Draw on one device."),
    "camera_model": ("pinhole", "Undistort to a pinhole camera first."),
    "covars": (None, "Pass quats and scales."),
    "with_ut": (False, "Projection is EWA."),
    "with_eval3d": (False, "Gaussians are evaluated in the image."),
    "radial_coeffs": (None, "Undistort to a pinhole camera first."),
    "tangential_coeffs": (None, "Undistort to a pinhole camera first."),
    "thin_prism_coeffs": (None, "Undistort to a pinhole camera first."),
    "ftheta_coeffs": (None, "Undistort to a pinhole camera first."),
    "rolling_shutter": (None, "The whole image has one pose."),
    "viewmats_rs": (None, "The whole image has one pose."),
}
"""Arguments of gsplat that are taken by name: their default, and what to do instead of another value."""


def rasterization(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    colors: Float[Tensor, "N D"] | Float[Tensor, "C N D"] | Float[Tensor, "N K 3"] | Float[Tensor, "C N K 3"],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = constants.EPS2D,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "C D"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    *,
    validate: bool = True,
) -> tuple[Float[Tensor, "C H W X"], Float[Tensor, "C H W 1"], dict[str, Any]]:
    """Images of 3D Gaussians, their alpha, and what was computed on the way.

    Signature and rules are those of gsplat 1.5.3. Each Gaussian is projected by EWA splatting (Zwicker et al. 2001):
    covariance J W S W^T J^T + eps2d with J the Jacobian of the projection at the centre. At distance d from the
    centre its layer has alpha = min(0.999, opacity exp(-d^T covariance^-1 d / 2)), and is skipped below 1/255. Layers
    blend front to back (Kerbl et al. 2023, eq. 3): image = sum c_i alpha_i T_i + T background, with T_i the product of
    1 - alpha of the layers in front; the layer that would bring T to 1e-4 or below ends the pixel and is not drawn.
    Layers are ordered by camera z, ties by index.

    Differentiable, once, in means, quats, scales, opacities, colors, backgrounds and viewmats; what needs no gradient
    costs none. Results are the same bits every time, for any number of threads and any `tile_size`.

    Args:
        means: Centres [m], shape [N, 3].
        quats: Rotations wxyz of any positive norm, shape [N, 4].
        scales: Standard deviations [m], shape [N, 3].
        opacities: In [0, 1], shape [N].
        colors: D <= 32 channels, shape [N, D] or [C, N, D]. With `sh_degree`, coefficients of spherical harmonics,
            shape [N, K, 3] or [C, N, K, 3].
        viewmats: World to camera (OpenCV axes), shape [C, 4, 4]; the last row is not read.
        Ks: Intrinsics [px], shape [C, 3, 3]; skew is not read.
        width: Of the images [px].
        height: Of the images [px].
        near_plane: Gaussians whose centre is nearer are not drawn [m].
        far_plane: Nor are those farther than this [m].
        radius_clip: Nor those whose box has both half sides at or below this [px].
        eps2d: Variance added to both image axes [px^2].
        packed: Accepted for gsplat's sake: changes nothing, and `meta` is never packed.
        tile_size: Side of the square tiles that work is split into [px]; changes only the time.
        backgrounds: Colour behind the Gaussians, shape [C, D]; black where None.
        render_mode: "RGB" draws `colors`, "D" the accumulated camera z, sum z_i alpha_i T_i, "ED" the expected one,
            that sum over alpha (0 where nothing is); "RGB+D" and "RGB+ED" append it as the last channel.
        sh_degree: 0 to 3: the colour of a Gaussian is max(0, 0.5 + its harmonics), seen from the camera's centre (see
            `spherical_harmonics`). None: colors are colours.
        channel_chunk: Like `packed`.
        segmented: Like `packed`.
        sparse_grad: Not supported, as all that follow: known by name so that calls need no change, and refused where
            they are not the default.
        absgrad: Not supported.
        rasterize_mode: Not supported.
        distributed: Not supported.
        camera_model: Not supported.
        covars: Not supported.
        with_ut: Not supported.
        with_eval3d: Not supported.
        radial_coeffs: Not supported.
        tangential_coeffs: Not supported.
        thin_prism_coeffs: Not supported.
        ftheta_coeffs: Not supported.
        rolling_shutter: Not supported.
        viewmats_rs: Not supported.
        validate: Look at the values of the tensors: refuse NaN, infinities, magnitudes above 1e15, zero quaternions,
            opacities outside [0, 1] and zero focal lengths. Waits for a CUDA device; switch it off for trusted inputs.

    Returns:
        render: Shape [C, H, W, X], X being D, 1 or D + 1.
        alphas: Shape [C, H, W, 1], in [0, 1).
        meta: means2d [C, N, 2], depths [C, N] (both with gradients, so that `retain_grad` works), conics [C, N, 3],
            radii [C, N, 2], opacities [C, N], camera_ids and gaussian_ids (None), tile_width, tile_height, tile_size,
            tiles_per_gauss [C, N], isect_offsets [C, tile_height, tile_width], flatten_ids [P], width, height,
            n_cameras.

    Raises:
        ValueError: names the argument, what was expected and what it was.
    """
    arguments = locals()
    for name, (default, hint) in UNSUPPORTED.items():
        refuse_unless_default(name, arguments[name], default, hint)
    check_choice("render_mode", render_mode, ("RGB", "D", "ED", "RGB+D", "RGB+ED"))
    check_gaussians_and_cameras(
        means, quats, scales, opacities, viewmats, Ks, width, height, near_plane, far_plane, radius_clip, eps2d,
        tile_size, validate,
    )  # fmt: skip
    n, n_cameras = len(means), len(viewmats)
    if sh_degree is not None:
        check_coefficients(colors, sh_degree, means, n_cameras)
        colors = seen_colors(sh_degree, means, colors, viewmats, validate)
    check_colors(colors, backgrounds, means, n_cameras, validate)

    projection = project(
        means, quats, scales, opacities, viewmats, Ks, width, height,
        near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d,
    )  # fmt: skip
    opacities = opacities.expand(n_cameras, n)
    channels = layers_to_blend(colors.expand(n_cameras, n, colors.shape[-1]), projection.depths, render_mode)
    if backgrounds is None or render_mode in ("D", "ED"):
        behind = channels.new_zeros(n_cameras, channels.shape[-1])
    else:
        behind = torch.nn.functional.pad(backgrounds, (0, channels.shape[-1] - backgrounds.shape[-1]))
    render, alphas = blend(projection, opacities, channels, behind, width, height, tile_size)
    if render_mode in ("ED", "RGB+ED"):
        # Over the weights' own sum: alpha, as 1 - T, has lost digits where little was drawn.
        depth, cover = render[..., -2:-1], render[..., -1:]
        drawn = cover > 0
        expected = torch.where(drawn, depth / torch.where(drawn, cover, 1), 0)
        render = torch.cat([render[..., :-2], expected], -1)
    return render, alphas, describe(projection, opacities, width, height, tile_size)


def refuse_unless_default(name: str, value: Any, default: Any, hint: str) -> None:
    """Refuse an argument of gsplat that is not built in."""
    if value is None or (isinstance(value, bool | str) and value == default):
        return
    if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
        return
    got = repr(value) if isinstance(value, bool | int | str) else type(value).__name__
    raise ValueError(f"{name}: expected {default!r}, got {got}. Not supported in this version. {hint}")


def check_coefficients(coefficients: Tensor, sh_degree: int, means: Tensor, n_cameras: int) -> None:
    """Shape and type of coefficients of spherical harmonics."""
    sizes = {"N": len(means), "C": n_cameras}
    if isinstance(coefficients, Tensor) and coefficients.dim() == 4:
        check_shape("colors", coefficients, "C", "N", "K", 3, sizes=sizes, hint="Or [N, K, 3].")
    else:
        hint = "With sh_degree they are K coefficients of three channels for each centre."
        check_shape("colors", coefficients, "N", "K", 3, sizes=sizes, hint=hint)
    check_float("colors", coefficients, like=means)
    check_degree("sh_degree", sh_degree, coefficients.shape[-2])


def seen_colors(
    sh_degree: int,
    means: Float[Tensor, "N 3"],
    coefficients: Float[Tensor, "N K 3"] | Float[Tensor, "C N K 3"],
    viewmats: Float[Tensor, "C 4 4"],
    validate: bool,
) -> Float[Tensor, "C N 3"]:
    """Colours of the Gaussians as each camera sees them.

    A far camera's centre cancels against the means in float32: their difference is taken in float64.
    """
    pose = viewmats.double()
    centres, _ = torch.linalg.solve_ex(pose[:, :3, :3], -pose[:, :3, 3:])
    directions = (means.double() - centres.mT).to(means.dtype)
    return (spherical_harmonics(sh_degree, directions, coefficients, validate=validate) + 0.5).clamp_min(0)


def layers_to_blend(colors: Tensor, depths: Tensor, render_mode: str) -> Tensor:
    """Channels [C, N, X] that a render mode draws: colours, depth, and for expected depths a one to divide by."""
    if render_mode == "RGB":
        return colors
    drawn = [] if render_mode in ("D", "ED") else [colors]
    ones = [torch.ones_like(depths)[..., None]] if render_mode in ("ED", "RGB+ED") else []
    return torch.cat([*drawn, depths[..., None], *ones], -1)


def check_gaussians_and_cameras(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    tile_size: int,
    validate: bool,
) -> None:
    """Everything that the rasterizer's kernels rely on, and, with `validate`, the values too."""
    sizes: dict[str, int] = {}
    check_shape("means", means, "N", 3, sizes=sizes)
    check_shape("quats", quats, "N", 4, sizes=sizes, hint="One wxyz row for each centre.")
    check_shape("scales", scales, "N", 3, sizes=sizes, hint="One row for each centre.")
    check_shape("opacities", opacities, "N", sizes=sizes, hint="One number for each centre.")
    check_shape("viewmats", viewmats, "C", 4, 4, sizes=sizes, hint="A single camera is viewmat[None].")
    check_shape("Ks", Ks, "C", 3, 3, sizes=sizes, hint="One matrix for each viewmat.")
    check_float("means", means)
    tensors = {"quats": quats, "scales": scales, "opacities": opacities, "viewmats": viewmats, "Ks": Ks}
    for name, tensor in tensors.items():
        check_float(name, tensor, like=means)
    for name, value in {"width": width, "height": height, "tile_size": tile_size}.items():
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name}: expected a whole number of pixels, at least 1, got {value!r}.")
    if sizes["C"] * width * height > MAX_PIXELS:
        raise ValueError(
            f"width: expected at most {MAX_PIXELS} pixels in all images, got {sizes['C']} x {height} x {width}. "
            "Draw fewer cameras a call."
        )
    check_positive("near_plane", near_plane)
    if not far_plane > near_plane:
        raise ValueError(f"far_plane: expected more than near_plane, {near_plane!r}, got {far_plane!r}.")
    if not radius_clip >= 0:
        raise ValueError(f"radius_clip: expected a number of pixels, at least 0, got {radius_clip!r}.")
    if not 0 <= eps2d < float("inf"):
        raise ValueError(f"eps2d: expected a finite variance, at least 0, got {eps2d!r}.")
    if not validate:
        return
    check_finite(means=means, **tensors)
    if len(means):
        zeros = int((quats.detach() == 0).all(-1).sum())
        if zeros:
            raise ValueError(f"quats: expected rows that are not zero, got {zeros} zero rows. (1, 0, 0, 0) is no turn.")
        low, high = (float(v) for v in opacities.detach().aminmax())
        if low < 0 or high > 1:
            raise ValueError(
                f"opacities: expected values in [0, 1], got {low:g} to {high:g}. Logits go through a sigmoid first."
            )
    focal = Ks.detach()[:, [0, 1], [0, 1]]
    if bool((focal == 0).any()):
        raise ValueError("Ks: expected focal lengths other than 0, got 0.")


def check_colors(
    colors: Tensor, backgrounds: Tensor | None, means: Tensor, n_cameras: int, validate: bool
) -> None:
    """Shapes, types and, with `validate`, values of colours and backgrounds."""
    sizes = {"N": len(means), "C": n_cameras}
    if isinstance(colors, Tensor) and colors.dim() == 2:
        check_shape("colors", colors, "N", "D", sizes=sizes, hint="One row for each centre.")
    else:
        check_shape("colors", colors, "C", "N", "D", sizes=sizes, hint="Or [N, D], the same for all cameras.")
    check_float("colors", colors, like=means)
    if not 1 <= colors.shape[-1] <= MAX_CHANNELS:
        raise ValueError(f"colors: expected 1 to {MAX_CHANNELS} channels, got {colors.shape[-1]}. Draw the rest apart.")
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, "C", "D", sizes=sizes, hint="One row for each camera.")
        check_float("backgrounds", backgrounds, like=means)
    if validate:
        check_finite(colors=colors, backgrounds=backgrounds)


def describe(
    projection: Projection, opacities: Tensor, width: int, height: int, tile_size: int
) -> dict[str, Any]:
    """The `meta` of `rasterization`."""
    return {
        "camera_ids": None,
        "gaussian_ids": None,
        "means2d": projection.means2d,
        "depths": projection.depths,
        "conics": projection.conics,
        "radii": projection.radii,
        "opacities": opacities,
        "tile_size": tile_size,
        "width": width,
        "height": height,
        "n_cameras": len(projection.depths),
    }
