"""The texels of the atlas on a device, their labels, and lines drawn on them. Lengths are millimetres."""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding_bag

from oasis_warp.synthetic.atlas import Atlas, bundled_atlas
from oasis_warp.synthetic.body import FINGERS, THUMB, smoothstep
from oasis_warp.synthetic.ops.surface_patterns import PointGrid, point_grid, surface_dabs
from oasis_warp.synthetic.skin_lines import CORNER_WORDS, KINDS, LINE_WORDS, PLACE_CELL, STRENGTH_CELL, Lines

GRID_CELL = 2.0
"""Cell of the grid that lines are drawn on [mm]: about the reach of most lines."""
PALM_EDGE = 0.09
"""Texels with `Atlas.palm` up to this never belong to the palm, whatever the noise."""
WRIST_EDGE = 14.0
"""Nor do texels farther than this behind the wrist [mm]."""
_FAINT = 1e-3
"""Lines up to this strength are not drawn."""


class Texels(NamedTuple):
    """The N texels that show skin."""

    points: Float[Tensor, "N 3"]
    palm: Float[Tensor, "N"]
    """0 on the back, 1 on the palm, soft between."""
    hand: Float[Tensor, "N"]
    """1 on the hand, 0 on the arm."""
    tip: Float[Tensor, "N"]
    knuckle: Float[Tensor, "N"]
    on_finger: Float[Tensor, "N"]
    finger: Int[Tensor, "N"]
    """As `Atlas.finger`."""
    palmar: Int[Tensor, "P"]
    """Texels that belong to the palm of some people."""
    palmar_points: Float[Tensor, "P 3"]
    nails: Int[Tensor, "M"]
    """Texels on the back of the fingers' last bones."""
    nail_fingers: Int[Tensor, "M"]
    nail_places: Float[Tensor, "M 2"]
    """Along and across the last bone."""
    corners: Int[Tensor, "N 3"]
    weights: Float[Tensor, "N 3"]
    fill: Int[Tensor, "H W"]
    grid: PointGrid

    def to(self, device: torch.device | str) -> "Texels":
        """The same texels on another device."""
        return Texels(*(value.to(device) for value in self))

    def spread(self, values: Float[Tensor, "C K"]) -> Float[Tensor, "C N"]:
        """Interpolate vertex values of hand and forearm at the texels."""
        spread = embedding_bag(self.corners, values.T.contiguous(), per_sample_weights=self.weights, mode="sum")
        return spread.T.contiguous()

    def image(self, values: Float[Tensor, "N C"]) -> Float[Tensor, "H W C"]:
        """Texel values as an image of the atlas."""
        return values[self.fill]


def _build_texels(atlas: Atlas) -> Texels:
    points, finger = atlas.points, atlas.finger
    tip, knuckle = torch.zeros(len(points)), torch.zeros(len(points))
    nails, places = [], []
    for number in range(len(FINGERS)):
        here = finger == number
        for place in range(3):
            bone = atlas.body.bones[number][place]
            if place == 0 and number == THUMB:
                continue
            local = torch.from_numpy(bone.local(atlas.positions)).float()
            t, side, back = local.unbind(1)
            # The first knuckle lies partly on the palm's segment.
            where = here if place else (t.abs() < 16) & (side.abs() < 18)
            long = (6.5, 6.5, 4.0)[place]
            bump = torch.exp(-(((t - float(place == 0)) / long) ** 2) - (side / 8) ** 2) * smoothstep(0.0, 3.0, back)
            knuckle = knuckle + where * bump * (0.8 if place else 0.5)
            if place == 2:
                tip = torch.maximum(tip, here * smoothstep(bone.length * 0.25, bone.length * 0.85, t))
                nails.append(torch.nonzero(here & (back > 0))[:, 0])
                places.append(local[nails[-1], :2])
    x = points[:, 0]
    palmar = torch.nonzero((atlas.palm > PALM_EDGE) & (x < WRIST_EDGE))[:, 0]
    return Texels(
        points=points,
        palm=atlas.palm,
        hand=smoothstep(6.0, -6.0, x),
        tip=tip,
        knuckle=knuckle.clamp(max=1.2),
        on_finger=atlas.finger_weight.clamp(0, 1) * (finger >= 0),
        finger=finger,
        palmar=palmar,
        palmar_points=points[palmar],
        nails=torch.cat(nails),
        nail_fingers=torch.repeat_interleave(torch.arange(len(FINGERS)), torch.tensor([len(n) for n in nails])),
        nail_places=torch.cat(places),
        corners=atlas.corners,
        weights=atlas.weights,
        fill=atlas.fill,
        grid=point_grid(points, GRID_CELL),
    )


@functools.cache
def texels_on(device: str) -> Texels:
    """The texels of `bundled_atlas` on a device; takes seconds the first time."""
    return _build_texels(bundled_atlas()) if device == "cpu" else texels_on("cpu").to(device)


def draw_lines(lines: Lines, grid: PointGrid) -> dict[str, Float[Tensor, "N"]]:
    """The profile of the strongest nearby line of each kind, at the points of a surface."""
    numbers = torch.from_numpy(lines.numbers).to(grid.points.device)
    first_corner = lines.n_lines * LINE_WORDS
    first_knot = first_corner + lines.n_corners * CORNER_WORDS
    rows, corners = numbers[:first_corner].view(-1, LINE_WORDS), numbers[first_corner:first_knot]
    samples = _sample_lines(rows, corners.view(-1, CORNER_WORDS), numbers[first_knot:], lines.n_samples)
    return dict(zip(KINDS, surface_dabs(grid, *samples, len(KINDS)).unbind(0), strict=True))


class _Samples(NamedTuple):
    centers: Tensor
    widths: Tensor
    strengths: Tensor
    kinds: Tensor


def _sample_lines(lines: Tensor, corners: Tensor, knots: Tensor, total: int) -> _Samples:
    """Points along all lines, evenly spaced on each.

    Args:
        lines: The first rows of `Lines.numbers`, [L, 15].
        corners: The rows after them, [C, 4].
        knots: The rest of the numbers.
        total: Number of samples.
    """
    device = lines.device
    of = torch.repeat_interleave(torch.arange(len(lines), device=device), lines[:, 9].long(), output_size=total)
    n_corners, length, width, strength, taper, wobble, kind, place_knots, _, count, first, first_corner, shift, \
        first_knot, loud = lines[of].unbind(1)  # fmt: skip
    u = (torch.arange(total, device=device) - first) / (count - 1)
    t = u * length

    # All lines are laid end to end, with gaps, so that one search finds the corners around every sample.
    whole = torch.repeat_interleave(
        torch.arange(len(lines), device=device), lines[:, 0].long(), output_size=len(corners)
    )
    along = corners[:, 3].contiguous()
    corner = torch.searchsorted(along + lines[whole, 12], t + shift, right=True) - 1
    corner = torch.minimum(torch.maximum(corner, first_corner.long()), (first_corner + n_corners).long() - 2)
    share = ((t - along[corner]) / (along[corner + 1] - along[corner]).clamp_min(1e-12)).clamp(0, 1)
    start, end = corners[corner, :3], corners[corner + 1, :3]
    places = start + share[:, None] * (end - start)

    def walk(cell: float, first: Tensor) -> Tensor:
        step = t / cell
        low = step.floor()
        index = (first + 1 + low).long()  # the first knot lies one cell before the line
        return knots[index] + (step - low) * (knots[index + 1] - knots[index])

    wander = torch.stack([walk(PLACE_CELL, first_knot + k * place_knots) for k in range(3)], 1)
    strength_knot = first_knot + 3 * place_knots
    fade = (torch.minimum(u, 1 - u) / taper).clamp(0, 1) ** 0.7
    strengths = strength * fade * (1 + loud * walk(STRENGTH_CELL, strength_knot))
    return _Samples(
        (places + wobble[:, None] * wander).float(),
        (width * (1 + 0.2 * walk(PLACE_CELL, strength_knot + lines[of, 8]))).float(),
        torch.where(strengths > _FAINT, strengths, 0.0).float(),
        kind.int(),
    )
