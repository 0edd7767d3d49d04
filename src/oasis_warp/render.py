"""Draw Gaussians: an image, or the weight of every Gaussian in every pixel."""

from torch import Tensor

from oasis_warp.core.color import plain_background
from oasis_warp.core.config import BLACK
from oasis_warp.core.types import Camera, Color, Gaussians, Render
from oasis_warp.ops import BlendWeights, blend_weights, rasterization


def render(gaussians: Gaussians, camera: Camera, *, background: Color = BLACK) -> Render:
    """Draw `gaussians` as `camera` sees them over a plain `background`; differentiable in both.

    Values are not checked here, shapes are.
    """
    means = gaussians.means
    if isinstance(background, Tensor):
        backgrounds = background.to(means)[None]
    else:
        backgrounds = plain_background(background, 1, like=means)
    images, alphas, _ = rasterization(
        means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        camera.viewmat.to(means)[None],
        camera.K.to(means)[None],
        camera.width,
        camera.height,
        backgrounds=backgrounds,
        validate=False,
    )
    return Render(images.squeeze(0), alphas.squeeze((0, 3)))  # whose adjoints, unlike those of indices, fill no zeros


def view_weights(gaussians: Gaussians, camera: Camera) -> BlendWeights:
    """The weights of every Gaussian in every pixel; afterwards a picture costs one sparse product."""
    like = gaussians.means
    return blend_weights(
        like, gaussians.quats, gaussians.scales, gaussians.opacities,
        camera.viewmat.to(like), camera.K.to(like), camera.width, camera.height,
    )  # fmt: skip
