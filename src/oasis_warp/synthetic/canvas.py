"""What is painted on: the texels of the atlas on a device, with all that is known of them whoever the person is."""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding_bag

from oasis_warp.synthetic.atlas import Atlas, bundled_atlas
from oasis_warp.synthetic.body import FINGERS, smoothstep
from oasis_warp.synthetic.hand_lines import THUMB
from oasis_warp.synthetic.ops.surface_patterns import PointGrid, point_grid

GRID_CELL = 2.0
"""Of the grid that lines are drawn on [mm]: about as wide as most lines reach."""
PALM_EDGE = 0.09
"""`Atlas.palm` up to which no noise makes a texel belong to the palm."""
WRIST_EDGE = 14.0
"""Distance behind the wrist beyond which none does [mm]."""


class Canvas(NamedTuple):
    """The N texels that show skin; lengths in millimetres. Shares are 0 to 1."""

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
    """Texels that may belong to somebody's palm."""
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

    def to(self, device: torch.device | str) -> "Canvas":
        """The same canvas on another device."""
        return Canvas(*(value.to(device) for value in self))

    def spread(self, values: Float[Tensor, "C K"]) -> Float[Tensor, "C N"]:
        """Values of the vertices of hand and forearm, interpolated at the texels."""
        spread = embedding_bag(self.corners, values.T.contiguous(), per_sample_weights=self.weights, mode="sum")
        return spread.T.contiguous()

    def image(self, values: Float[Tensor, "N C"]) -> Float[Tensor, "H W C"]:
        """Values of the texels as a picture of the atlas."""
        return values[self.fill]


def _canvas(atlas: Atlas) -> Canvas:
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
            # The first knuckle lies on the hand, too.
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
    return Canvas(
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
def canvas_on(device: str) -> Canvas:
    """The canvas of `bundled_atlas` on a device: seconds the first time."""
    return _canvas(bundled_atlas()) if device == "cpu" else canvas_on("cpu").to(device)
