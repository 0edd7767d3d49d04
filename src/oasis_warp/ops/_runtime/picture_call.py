"""Inputs, saved tensors and results of the single-node rasterizer, and the parameters of its kernels."""

from typing import NamedTuple

from torch import Tensor

ORDERS = {
    "project_gaussians": "n n_cameras width height means quats scales covars viewmats Ks ortho opacities near far "
    "radius_clip eps2d alpha_min extent_sigmas largest means2d covars2d depths conics radii sort_depths centers "
    "whitenings boxes counters n_counters n_threads bad colors n_colors backgrounds n_backgrounds",
    "count_pairs": "n total boxes tiles_x tiles_y pair_starts spread counters",
    "place_tiles": "n_tiles tiles_x capacity longest_sorted counters tiles spread cursors report",
    "fill_tiles": "n total boxes sort_depths tiles_x tiles_y capacity spread cursors keys",
    "sort_long_lists": "n tiles tiles_y keys spare tile_gaussians",
    "blend": "n tiles n_cameras centers whitenings opacities colors opacity_step color_step backgrounds tiles_x "
    "tiles_y width height tile_gaussians transmittance stops checkpoints keys image alphas",
    "blend_backward": "n tiles n_cameras centers whitenings opacities colors opacity_step color_step backgrounds "
    "tiles_x tiles_y width height tile_gaussians transmittance stops checkpoints pair_starts boxes g_image g_alpha "
    "pair_records tile_backgrounds",
    "gather": "total capacity boxes pair_starts pair_records whitenings opacities opacities_given g_means2d "
    "g_covars2d g_opacities g_colors",
    "project_gaussians_backward": "n n_cameras width height means quats scales covars viewmats Ks ortho radii "
    "g_means2d g_covars2d g_depths g_means g_quats g_scales g_covars g_cameras",
}
"""Parameters of the kernels in the order in which they are given here."""


class Scene(NamedTuple):
    """Tensors of a call: float32 on one device. Either quats and scales are None, or covars is."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor
    """[N, D] or [C, N, D]."""
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None


class Options(NamedTuple):
    """Numbers of a call."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    tile_size: int
    render_mode: str
    ortho: bool


class Drawn(NamedTuple):
    """A picture, and what its adjoint needs."""

    image: Tensor | None
    """None for the adjoint, as are alphas: a node that holds its own results would never be freed."""
    alphas: Tensor | None
    channels: Tensor
    """Colours that were blended, depths among them: [N, X], the same for all cameras, or [C, N, X]."""
    backgrounds: Tensor | None
    """[C, X]."""
    workspace: Tensor
    lists: Tensor | None
    pairs: int


class Needs(NamedTuple):
    """Which gradients are wanted."""

    means: bool
    quats: bool
    scales: bool
    covars: bool
    opacities: bool
    colors: bool
    viewmats: bool
    backgrounds: bool


class Gradients(NamedTuple):
    """Gradients by the tensors of a `Scene`, None where they are not wanted."""

    means: Tensor | None
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor | None
    colors: Tensor | None
    viewmats: Tensor | None
    Ks: None
    backgrounds: Tensor | None
