"""Masks as the estimator would cut them: another end at the wrist, gaps between fingers filled in, a wandering rim.

`reconstruction.reconstruct` has a mask from GrabCut where training knows the true one; docs/estimator.md says how they
differ. Everything is on the pictures' device, batched, of fixed sizes.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, normalize

from oasis_warp.core.hand_model import KNUCKLES

PATCHES = 8
"""Errors change over this part of a picture's side."""
NUMBERS = 2 + 2 * PATCHES * PATCHES
"""Standard normal numbers that `wandering` needs for a mask."""
_END = (0.007, 0.0065)
"""Mean and spread of where masks end past the wrist point [m]."""
_GAP = 0.025
"""Half the width of the widest gap that is filled in, over the picture's side."""
_GAPS = (-0.8, 1.3)
"""Mean and spread of how readily gaps are filled in: some patches of most hands are, all of few."""
_RIM = (-2.2, 0.9)
"""Mean and spread of the logarithm of how far a rim wanders, over the width of its blur."""
_BLUR = 5
"""Pixels over which a rim is blurred, and at most half of which it wanders."""


def ended(
    mask: Float[Tensor, "N H H"],
    alpha: Float[Tensor, "N H H"],
    landmarks: Float[Tensor, "N 21 3"],
    K: Float[Tensor, "N 3 3"],
    numbers: Float[Tensor, "N"],
    strength: float = 1.0,
) -> Float[Tensor, "N H H"]:
    """Masks that end at a line across the arm, as `segmentation` cuts it, somewhere beyond the wrist.

    Args:
        mask: Share of each pixel that is hand.
        alpha: Share that is hand, arm or clothes.
        landmarks: In the camera's frame [m].
        K: Intrinsics [px].
        numbers: Standard normal ones, of where.
        strength: 1 for errors as they were measured, 0 for none, more for fuller ones.
    """
    seen = landmarks @ K.transpose(1, 2)
    pixels = seen[..., :2] / seen[..., 2:]
    wrist, knuckles = pixels[:, 0], torch.stack([pixels[:, k] for k in KNUCKLES], 1).mean(1)
    up = normalize(knuckles - wrist, dim=-1)
    place = torch.arange(mask.shape[-1], dtype=K.dtype, device=K.device) + 0.5
    x, y = (up[:, k, None] * (place - wrist[:, k, None]) for k in (0, 1))
    past = (_END[0] + _END[1] * numbers) * K[:, 0, 0] / landmarks[:, 0, 2]
    above = (x[:, None] + y[:, :, None] + past[:, None, None] + 0.5).clamp(0, 1)
    return (mask + strength * (alpha * above - mask)).clamp(0, 1)


def wandering(
    mask: Float[Tensor, "N s s"], numbers: Float[Tensor, "N M"], strength: float = 1.0
) -> Float[Tensor, "N s s"]:
    """Masks of crops with some gaps filled in and rims that are off by up to some pixels; `NUMBERS` a mask."""
    size = mask.shape[-1]
    fields = numbers[:, 2:].unflatten(1, (2, PATCHES, PATCHES))
    gaps, rim = interpolate(fields, size=(size, size), mode="bicubic", align_corners=False).unbind(1)
    filled, far = (numbers[:, k, None, None] for k in range(2))
    reach = int(_GAP * size)
    closed = -_grown(-_grown(mask, reach), reach)
    made = mask + (_GAPS[0] + _GAPS[1] * filled + gaps).clamp(0, 1) * (closed - mask)
    soft = avg_pool2d(made[:, None], _BLUR, 1, _BLUR // 2, count_include_pad=False)[:, 0]
    shift = ((_RIM[0] + _RIM[1] * far).exp() * rim).clamp(-0.45, 0.45)
    made = ((soft - 0.5 + shift) * _BLUR + 0.5).clamp(0, 1)
    return (mask + strength * (made - mask)).clamp(0, 1)


def _grown(mask: Tensor, reach: int) -> Tensor:
    """The largest value of a square of 2 `reach` + 1 pixels round each pixel; first columns, then rows."""
    for along in ((reach, 0), (0, reach)):
        mask = max_pool2d(mask[:, None], [2 * k + 1 for k in along], 1, along)[:, 0]
    return mask
