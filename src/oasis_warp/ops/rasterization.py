"""3D Gaussians -> images: the public rasterizer, with gsplat's signature."""

from collections.abc import Sequence
from contextlib import nullcontext
from operator import is_
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels import constants
from oasis_warp.core.color import plain_background
from oasis_warp.core.tracing import is_traced
from oasis_warp.ops._runtime import picture_node
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.picture_call import Options, Scene
from oasis_warp.ops._runtime.rasterization_checks import (
    check_cameras,
    check_coefficients,
    check_colors,
    check_gaussians,
    check_invertible,
)
from oasis_warp.ops._runtime.values import DeferredFiniteCheck, check_finite
from oasis_warp.ops.blending import blend, compensated_opacities, record_absolute_gradients
from oasis_warp.ops.checks import check_choice, refuse_gradient
from oasis_warp.ops.projection import Projection, check_values, project
from oasis_warp.ops.spherical_harmonics import sh_to_rgb

UNSUPPORTED: dict[str, tuple[Any, str]] = {
    "sparse_grad": (False, "Gradients are dense."),
    "distributed": (False, "Draw on one device."),
    "with_ut": (False, "Projection is EWA."), "with_eval3d": (False, "Gaussians are evaluated in the image."),
    "radial_coeffs": (None, "Undistort to a pinhole camera first."),
    "tangential_coeffs": (None, "Undistort to a pinhole camera first."),
    "thin_prism_coeffs": (None, "Undistort to a pinhole camera first."),
    "ftheta_coeffs": (None, "Undistort to a pinhole camera first."),
    "rolling_shutter": (None, "The whole image has one pose."), "viewmats_rs": (None, "The whole image has one pose."),
}  # fmt: skip
"""Unsupported arguments of gsplat: their default, and what to do instead of another value."""
USUAL = tuple(default for default, _ in UNSUPPORTED.values())
RASTERIZE_MODES = "classic", "antialiased"
CAMERA_MODELS = "pinhole", "ortho"
RENDER_MODES = "RGB", "D", "ED", "RGB+D", "RGB+ED"

DECLARATION = Declaration(
    "rasterization",
    inputs={
        "means": Array("N 3", grad=True),
        "quats": Array("N 4", grad=True, optional=True),
        "scales": Array("N 3", grad=True, optional=True),
        "opacities": Array("N", grad=True),
        "colors": Array("N D", grad=True),
        "viewmats": Array("C 4 4", grad=True),
        "Ks": Array("C 3 3"),
        "backgrounds": Array("C D", grad=True, optional=True),
        "covars": Array("N 3 3", grad=True, optional=True),
    },
    outputs={"render": "C H W X", "alphas": "C H W 1"},
    reference="rasterization.rasterization",
)
"""It runs the operators sh_to_rgb, project and blend, which are registered with torch."""


def rasterization(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"] | None,
    scales: Float[Tensor, "N 3"] | None,
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
    covars: Float[Tensor, "N 3 3"] | None = None,
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

    Differentiable, once, in means, quats, scales, covars, opacities, colors, backgrounds and viewmats; what needs no
    gradient costs none. Results are the same bits every time, for any number of threads.

    Args:
        means: Centres [m], shape [N, 3].
        quats: Rotations wxyz of any positive norm, shape [N, 4]; None with `covars`.
        scales: Standard deviations [m], shape [N, 3]; None with `covars`.
        opacities: In [0, 1], shape [N].
        colors: D <= 32 channels, shape [N, D] or [C, N, D]. With `sh_degree`, coefficients of spherical harmonics,
            shape [N, K, 3] or [C, N, K, 3].
        viewmats: World to camera (OpenCV axes), shape [C, 4, 4]; the last row is not read.
        Ks: Intrinsics [px], shape [C, 3, 3]; skew is not read.
        width: Width of the images [px].
        height: Height of the images [px].
        near_plane: Gaussians whose centre is nearer are not drawn [m].
        far_plane: Nor are those farther than this [m].
        radius_clip: Nor those whose box has both half sides at or below this [px].
        eps2d: Variance added to both image axes [px^2].
        packed: Accepted for compatibility with gsplat, without effect: `meta` is never packed.
        tile_size: Side of the square tiles that work is split into [px]; changes only the time.
        backgrounds: Colour behind the Gaussians, shape [C, D]; black where None.
        render_mode: "RGB" draws `colors`, "D" the accumulated camera z, sum z_i alpha_i T_i, "ED" the expected one,
            that sum over alpha (0 where nothing is); "RGB+D" and "RGB+ED" append it as the last channel.
        sh_degree: 0 to 3: the colour of a Gaussian is max(0, 0.5 + its harmonics), seen from the camera's centre (see
            `spherical_harmonics`). None: colors are colours.
        channel_chunk: Like `packed`.
        segmented: Like `packed`.
        covars: Covariances [m^2] instead of quats and scales, which are then not read and may be None, shape [N, 3, 3];
            the symmetric part is used.
        sparse_grad: Not supported: accepted with its default, so that calls written for gsplat need no change.
        absgrad: After backward, `meta["means2d"].absgrad` holds sums over pixels of the magnitudes of gradients, shape
            [C, N, 2], as a criterion for densification (Ye et al. 2024). Backward then lists every pair of a pixel and
            a Gaussian, which costs time and memory.
        rasterize_mode: "classic", or "antialiased": opacities are multiplied by sqrt(det(S) / det(S + eps2d)), S being
            the covariance in the image (Yu et al. 2024), so that Gaussians below a pixel become fainter.
        distributed: Not supported.
        camera_model: "pinhole", or "ortho": x = fx X + cx, y = fy Y + cy in camera axes, whatever the depth.
        with_ut: Not supported.
        with_eval3d: Not supported.
        radial_coeffs: Not supported.
        tangential_coeffs: Not supported.
        thin_prism_coeffs: Not supported.
        ftheta_coeffs: Not supported.
        rolling_shutter: Not supported.
        viewmats_rs: Not supported.
        validate: Check the values of the tensors: refuse NaN, infinities, magnitudes above 1e15, zero quaternions,
            opacities outside [0, 1] and zero focal lengths. Waits for a CUDA device; switch it off for trusted inputs,
            and while a CUDA graph is being captured.

    Returns:
        Images, shape [C, H, W, X] with X = D, 1 or D + 1; alphas, shape [C, H, W, 1], in [0, 1); and a dictionary of
        means2d [C, N, 2], depths [C, N] (both with gradients, and `retain_grad` works; hooks on means2d and
        torch.autograd.grad by it need `absgrad=True`, as float32 on CUDA is else one node of autograd), conics
        [C, N, 3], radii [C, N, 2], opacities [C, N], camera_ids and gaussian_ids (None), tile_size, width, height and
        n_cameras.

    Raises:
        ValueError: names the argument, what was expected and what it was.
    """
    unsupported = (
        sparse_grad, distributed, with_ut, with_eval3d, radial_coeffs,
        tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs,
    )  # fmt: skip
    if not all(map(is_, unsupported, USUAL)):
        refuse_unsupported(unsupported)
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    check_choice("camera_model", camera_model, CAMERA_MODELS)
    if covars is not None:
        quats = scales = None
    together = not absgrad and rasterize_mode == "classic" and isinstance(means, Tensor) and means.is_cuda
    options = Options(
        width, height, near_plane, far_plane, radius_clip, eps2d, tile_size, render_mode, camera_model == "ortho"
    )
    if together and sh_degree is None:
        scene = Scene(means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds)
        drawn = draw_together(scene, options, validate)
        if drawn is not None:
            return drawn
    check_gaussians(means, quats, scales, covars, opacities)
    check_cameras(viewmats, Ks, means, width, height, near_plane, far_plane, radius_clip, eps2d, tile_size)
    refuse_gradient("rasterization", Ks=Ks)
    n_cameras = viewmats.shape[0]
    if sh_degree is not None:
        check_coefficients(colors, sh_degree, means, n_cameras)
        if validate and not is_traced():
            check_finite(colors=colors)  # of which the largest degree may not be read, and -inf would become black
            check_invertible(viewmats)
        colors = sh_to_rgb(sh_degree, means, colors, viewmats)
        if together:
            scene = Scene(means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds)
            drawn = draw_together(scene, options, validate)
            if drawn is not None:
                return drawn
    check_colors(colors, backgrounds, means, n_cameras)
    if validate and render_mode in ("D", "ED") and not is_traced():
        check_finite(colors=colors, backgrounds=backgrounds)  # the blending, which does not get them, cannot check them

    # Projection waits for the result of its own checks: another check on the device costs next to nothing meanwhile.
    deferred = validate and render_mode == "RGB" and means.is_cuda and not is_traced()
    with DeferredFiniteCheck(colors=colors, backgrounds=backgrounds) if deferred else nullcontext():
        projection = project(
            means, quats, scales, opacities, viewmats, Ks, width, height, near_plane=near_plane, far_plane=far_plane,
            radius_clip=radius_clip, eps2d=eps2d, covars=covars, ortho=camera_model == "ortho", validate=validate,
        )  # fmt: skip
    opacities = for_each_camera(opacities, n_cameras)
    if rasterize_mode == "antialiased":
        opacities = compensated_opacities(opacities, projection.covars2d, eps2d)
    colors = for_each_camera(colors, n_cameras) if colors.dim() == 2 else colors
    render, alphas = blend_layers(
        projection, opacities, colors, backgrounds, (width, height, tile_size), render_mode, absgrad,
        validate and not deferred,
    )  # fmt: skip
    meta = {
        "camera_ids": None, "gaussian_ids": None, "means2d": projection.means2d, "depths": projection.depths,
        "conics": projection.conics, "radii": projection.radii, "opacities": opacities, "tile_size": tile_size,
        "width": width, "height": height, "n_cameras": n_cameras,
    }  # fmt: skip
    return render, alphas, meta


def draw_together(scene: Scene, options: Options, validate: bool) -> tuple[Tensor, Tensor, dict[str, Any]] | None:
    """Images, alpha and meta by one node of autograd; None where the operators apart must draw them."""
    plan = picture_node.plan_for(scene, options)
    if plan is None:
        return None
    drawn = picture_node.draw(plan, scene, validate)
    if drawn is None:
        means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds = scene
        check_values(means, quats, scales, covars, opacities, viewmats, Ks)
        check_finite(colors=colors, backgrounds=backgrounds)
        raise AssertionError("the kernels have met a bad value that is not in their inputs")
    image, alphas, meta = drawn
    return expect_depth(image, options.render_mode), alphas, meta


def expect_depth(render: Tensor, render_mode: str) -> Tensor:
    """Images whose last two channels are depth and the weights' sum, if the mode asks for the expected depth."""
    if render_mode not in ("ED", "RGB+ED"):
        return render
    # Alpha, as 1 - T, has lost digits where little was drawn.
    depth, cover = render[..., -2:-1], render[..., -1:]
    drawn = cover > 0
    expected = torch.where(drawn, depth / torch.where(drawn, cover, 1), 0)
    return torch.cat([render[..., :-2], expected], -1)


def blend_layers(
    projection: Projection, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, frame: tuple[int, int, int],
    render_mode: str, absgrad: bool, validate: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The images of a render mode, and alpha; `frame` is width, height and tile size."""
    n_cameras = len(colors)
    channels = layers_to_blend(colors, projection.depths, render_mode)
    n_channels = channels.shape[-1]
    if backgrounds is None or render_mode in ("D", "ED"):
        backgrounds = plain_background((0.0,) * n_channels, n_cameras, like=channels)
    elif n_channels > backgrounds.shape[-1]:
        backgrounds = torch.nn.functional.pad(backgrounds, (0, n_channels - backgrounds.shape[-1]))
    render, alphas = blend(projection, opacities, channels, backgrounds, *frame, validate=validate)
    if absgrad and projection.means2d.requires_grad:
        render, alphas = record_absolute_gradients(
            render, alphas, projection, opacities, channels, backgrounds, frame[2]
        )
    return expect_depth(render, render_mode), alphas


def refuse_unsupported(values: Sequence[Any]) -> None:
    """Refuse `values` of the `UNSUPPORTED` arguments other than their defaults, by name."""
    for (name, (default, hint)), value in zip(UNSUPPORTED.items(), values, strict=True):
        if value is None or (isinstance(value, bool | str) and value == default):
            continue
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue
        got = repr(value) if isinstance(value, bool | int | str) else type(value).__name__
        raise ValueError(f"{name}: expected {default!r}, got {got}. Not supported in this version. {hint}")


def for_each_camera(tensor: Tensor, n_cameras: int) -> Tensor:
    """`tensor` with a leading axis of cameras; for one camera a view, whose gradient is no sum."""
    return tensor[None] if n_cameras == 1 else tensor.expand(n_cameras, *tensor.shape)


def layers_to_blend(colors: Tensor, depths: Tensor, render_mode: str) -> Tensor:
    """Channels [C, N, X] of a render mode: colours, depth, and for expected depths a one to divide by."""
    if render_mode == "RGB":
        return colors
    drawn = [] if render_mode in ("D", "ED") else [colors]
    ones = [torch.ones_like(depths)[..., None]] if render_mode in ("ED", "RGB+ED") else []
    return torch.cat([*drawn, depths[..., None], *ones], -1)
