"""The nails of one person: superellipses in the frames of the last bones, fitted to the hand model's nail labels."""

import functools
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from oasis_warp.synthetic.body import FINGERS, bundled_body, smoothstep
from oasis_warp.synthetic.canvas import Canvas
from oasis_warp.synthetic.hand_lines import THUMB
from oasis_warp.synthetic.identity import Identity

_NEAR = 2.0
"""Distance to the outline up to which a nail shows in anything [mm]."""


class Nails(NamedTuple):
    """Each texel's share, [N]."""

    plate: Tensor
    lunula: Tensor
    free: Tensor
    """Edge beyond the bed."""
    across: Tensor
    """-1 to 1 over the plate."""
    rim: Tensor
    """The fold round the plate."""


class _Outline(NamedTuple):
    """Of the nail of each finger, or of a texel's finger [mm]."""

    low: Tensor
    high: Tensor
    middle: Tensor
    half: Tensor
    moon: Tensor
    """Radius of the lunula; 0 for none."""
    edge: Tensor
    """Where the free edge begins."""


@functools.cache
def _labelled() -> np.ndarray:
    """Ends of the labelled vertices along and across each last bone [mm], [5, 4]."""
    body, rows = bundled_body(), []
    hand = body.hand
    for finger in range(len(FINGERS)):
        there = ((hand.nail > 0.6) & (hand.segment == 3 * finger + 3)).numpy()
        along, side, _ = body.bones[finger][2].local(hand.template.double().numpy()[there] * 1e3).T
        rows.append((along.min(), along.max(), side.min(), side.max()))
    return np.array(rows)


def grown_nails(canvas: Canvas, identity: Identity, shifts: np.ndarray) -> Nails:
    """Nails as the identity has them, the root of each moved along its finger by `shifts` [5], in millimetres."""
    start, end, left, right = _labelled().T
    low = start - 1.2 + shifts
    high = end + 0.2 + 0.5 * identity.nail_length
    size = identity.lunula * np.where(np.arange(len(FINGERS)) == THUMB, 0.7, 0.4) * (high - low) / 2
    outline = np.stack([
        low, high, (right + left) / 2, (right - left) / 2 + identity.nail_width, np.where(size > 0.8, 1.3 * size, 0),
        high - max(0.45, 0.5 * identity.nail_length + 0.5),
    ])  # fmt: skip
    device = canvas.points.device
    of = _Outline(*torch.from_numpy(outline).float().to(device)[:, canvas.nail_fingers])
    t, x = canvas.nail_places.unbind(1)
    center, reach, x = (of.high + of.low) / 2, (of.high - of.low) / 2, x - of.middle
    power = identity.nail_shape
    round_ = (x.abs() / of.half) ** power + ((t - center).abs() / reach) ** power
    distance = (round_.clamp_min(1e-6) ** (1 / power) - 1) * of.half  # negative inside
    plate = smoothstep(0.12, -0.12, distance)
    moon = torch.hypot(x * 0.75, t - of.low + reach * 0.1) - of.moon
    near = distance < _NEAR
    values = torch.zeros(len(Nails._fields), len(canvas.points), device=device)
    values[:, canvas.nails] = torch.stack([
        plate,
        (of.moon > 0) * plate * smoothstep(0.5, -0.3, moon),
        plate * smoothstep(-0.15, 0.3, t - of.edge + 0.03 * x**2),
        near * x / of.half,
        near * torch.exp(-(((distance - 0.15) / 0.3) ** 2)),
    ])  # fmt: skip
    return Nails(*values)
