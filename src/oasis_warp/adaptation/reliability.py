"""Where a photo surely shows the skin that the fitted surface has there.

A fitted hand lies some pixels beside the photo's. At its outlines the photo then shows the background instead, or of a
finger before the palm the finger: taken over, they are stains and ghosts in every other pose.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from oasis_warp.avatar.anchors import PRIOR_SIZE
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandCrop
from oasis_warp.ops import depth_map

BEHIND_REACH = 5 / PRIOR_SIZE
"""From the outline of what lies before, over the picture's side."""
BEHIND_GAP = 0.01
"""Depth by which something must lie behind an outline to be another part of the hand [m]."""
STAIN_REACH = 6 / PRIOR_SIZE
"""From the mask's border, over the picture's side."""
STAIN_WINDOW = 13 / PRIOR_SIZE
"""Side of the square over which the background is averaged, twice."""
FEW, MANY = 0.15, 0.5
"""Share of background in a pixel's colour from which it counts less, and from which it does not count."""
SAME_COLOR = 0.01
"""Squared distance of colours below which skin and background cannot be told apart [sRGB^2]."""
OUTSIDE = 0.05
"""Share of hand in a pixel below which it shows the background."""


def mask_unreliable(hand: HandModel, drawn: Float[Tensor, "S S 3"], crop: HandCrop) -> HandCrop:
    """The same crop with a mask that leaves out what may be background, or a part of the hand before another.

    Args:
        hand: Whose surface it is.
        drawn: What the hand looks like in the light of the photo, everywhere on it.
        crop: The photo.
    """
    sure = (1 - _background_share(drawn, crop)) * ~_behind_outline(hand, crop)
    return crop._replace(mask=crop.mask * sure)


def _background_share(drawn: Float[Tensor, "S S 3"], crop: HandCrop) -> Float[Tensor, "S S"]:
    """0 to 1: how far, near the border, the photo's colour lies on the way from the hand's to the background's."""
    side = len(crop.mask)
    outside = (crop.mask < OUTSIDE).to(drawn)
    planes = torch.cat([crop.image * outside[..., None], outside[..., None]], -1).permute(2, 0, 1)[None]
    window = 2 * round(STAIN_WINDOW * side / 2) + 1
    for _ in range(2):
        planes = avg_pool2d(planes, window, stride=1, padding=window // 2)
    background = (planes[0, :3] / planes[0, 3:].clamp_min(1e-6)).permute(1, 2, 0)
    way = background - drawn
    share = ((crop.image - drawn) * way).sum(-1) / way.square().sum(-1).clamp_min(SAME_COLOR)
    reach = max(1, round(STAIN_REACH * side))
    near = max_pool2d(outside[None, None], 2 * reach + 1, stride=1, padding=reach)[0, 0]
    return ((share - FEW) / (MANY - FEW)).clamp(0, 1) * near


def _behind_outline(hand: HandModel, crop: HandCrop) -> Tensor:
    """Whether a pixel lies just past the outline of something nearer than it, [S, S]."""
    camera, vertices = crop.camera, crop.posed.vertices
    seen = depth_map(
        vertices, hand.faces.to(vertices.device), camera.viewmat, camera.K, camera.width, camera.height, validate=False
    )
    on_hand = seen.face_ids >= 0
    reach = max(1, round(BEHIND_REACH * camera.width))
    nearness = torch.where(on_hand, -seen.depth, -torch.inf)[None, None]
    nearest = -max_pool2d(nearness, 2 * reach + 1, stride=1, padding=reach)[0, 0]
    return on_hand & (seen.depth - nearest > BEHIND_GAP)
