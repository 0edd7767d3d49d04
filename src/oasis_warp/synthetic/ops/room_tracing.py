"""Images of simple rooms, lit by the same light as the hand in front of them, which casts its shadow on them."""

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.scene import rooms as kernels
from oasis_warp.ops._runtime.declaration import Array, Operator
from oasis_warp.ops._runtime.launch import even_cuts, launch_ranges, view
from oasis_warp.synthetic.ops.skin_shading import Lamps

SOLID_WORDS = int(kernels.SOLID_WORDS)
SHAPES = ("nothing", "box", "ball", "cylinder")
PATTERNS = (
    "paint", "planks", "tiles", "cloth", "specks", "stripes", "books", "keys", "text", "picture", "panes", "leaves",
    "panels", "carpet",
)  # fmt: skip


def _vec3(tensor: Tensor) -> object:
    return view(tensor.contiguous(), wp.vec3f)


def _trace(
    solids: Tensor, focals: Tensor, sky: Tensor, lamp_positions: Tensor, lamp_colors: Tensor, lamp_ranges: Tensor,
    lamp_spreads: Tensor, lamp_viewmats: Tensor, lamp_focals: Tensor, lamp_depths: Tensor, hidden: Tensor,
    focus: Tensor, apertures: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    sharp, out = hidden.new_empty((*hidden.shape, 3)), hidden.new_empty((*hidden.shape, 3))
    depth = torch.empty_like(hidden)
    cuts = even_cuts(hidden.numel())
    covered = view(hidden.contiguous())
    launch_ranges(
        kernels.trace,
        cuts,
        [
            view(solids.contiguous()), view(focals.contiguous()), _vec3(sky), _vec3(lamp_positions), _vec3(lamp_colors),
            view(lamp_ranges.contiguous()), view(lamp_spreads.contiguous()),
            view(lamp_viewmats.contiguous(), wp.mat44f), view(lamp_focals.contiguous()),
            view(lamp_depths.flatten(0, 1).contiguous()), covered, view(sharp, wp.vec3f), view(depth),
        ],
        like=hidden,
    )  # fmt: skip
    inputs = [view(depth), covered, view(focus.contiguous()), view(apertures.contiguous()),
              view(sharp, wp.vec3f), view(out, wp.vec3f)]  # fmt: skip
    launch_ranges(kernels.defocus, cuts, inputs, like=hidden)
    return out, depth


def _trace_fake(solids, focals, sky, *rest):
    hidden = rest[7]
    return hidden.new_empty((*hidden.shape, 3)), torch.empty_like(hidden)


_OPERATOR = Operator(
    "trace_rooms",
    _trace,
    _trace_fake,
    inputs={
        "solids": Array(f"B N {SOLID_WORDS}"),
        "focals": Array("B"),
        "sky": Array("B 9 3"),
        "hidden": Array("B H W"),
        "focus": Array("B"),
        "apertures": Array("B"),
    },
    outputs={"light": "B H W 3", "depth": "B H W"},
    public=False,
)


@torch.no_grad()
def trace_rooms(
    solids: Float[Tensor, "B N 27"],
    focals: Float[Tensor, "B"],
    sky: Float[Tensor, "B 9 3"],
    lamps: Lamps,
    hidden: Float[Tensor, "B H W"],
    focus: Float[Tensor, "B"],
    apertures: Float[Tensor, "B"],
) -> Float[Tensor, "B H W 3"]:
    """Linear light of rooms of solids, out of focus with their distance. Not differentiable.

    Args:
        solids: float32 rows of `SOLID_WORDS` numbers in the camera's frame, laid out in `oasis_kernels.scene.rooms`;
            rows of shape 0 are empty.
        focals: Of the camera [px], whose axis is the picture's middle.
        sky: Coefficients of the light from all around.
        lamps: The lamps, with their depth buffers of the hand.
        hidden: Share of each pixel that the hand covers; covered ones are left black.
        focus: Depth that is sharp [m].
        apertures: Radius of the blur of things far off, over the width of the picture.

    Raises:
        ValueError: wrong shapes.
    """
    _OPERATOR.check(solids=solids, focals=focals, sky=sky, hidden=hidden, focus=focus, apertures=apertures)
    light, _ = _OPERATOR(solids, focals, sky, *lamps, hidden, focus, apertures)
    return light
