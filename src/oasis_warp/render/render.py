"""Draw Gaussians."""

import torch

from oasis_warp.core.config import BLACK, Color
from oasis_warp.core.types import Camera, Gaussians, Render
from oasis_warp.ops import rasterization


def render(gaussians: Gaussians, camera: Camera, *, background: Color = BLACK) -> Render:
    """Draw `gaussians` as `camera` sees them over a plain `background`; differentiable in both.

    Values are not checked here, shapes are.
    """
    like = gaussians.means
    images, alphas, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        camera.viewmat[None].to(like),
        camera.K[None].to(like),
        camera.width,
        camera.height,
        backgrounds=torch.as_tensor(background, dtype=like.dtype, device=like.device)[None],
        validate=False,
    )
    return Render(images[0], alphas[0, ..., 0])
