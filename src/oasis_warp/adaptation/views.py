"""Views of fixed geometry: where only colours change, a picture is linear in them and is blended once."""

import math

from oasis_warp.core.types import Camera, Gaussians
from oasis_warp.ops import BlendWeights, blend_weights


def view_weights(gaussians: Gaussians, camera: Camera) -> BlendWeights:
    """The weights of every Gaussian in every pixel; afterwards a picture costs one sparse product."""
    like = gaussians.means
    return blend_weights(
        like, gaussians.quats, gaussians.scales, gaussians.opacities,
        camera.viewmat.to(like), camera.K.to(like), camera.width, camera.height,
    )  # fmt: skip


def reference_azimuths(count: int) -> list[float]:
    """Angles of `count` views around the hand, evenly spaced, the photo's own (0) left out [rad]."""
    return [2 * math.pi * k / (count + 1) for k in range(1, count + 1)]
