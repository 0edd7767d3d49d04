"""Images of simple rooms, lit by the same light as the hand in front of them, which casts its shadow on them."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.scene import rooms as kernels
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.launch import launch_ranges
from oasis_warp.synthetic.ops.views import Lamps, scalars, vectors

SOLID_WORDS = int(kernels.SOLID_WORDS)
SHAPES = ("nothing", "box", "ball", "cylinder")
PATTERNS = (
    "paint", "planks", "tiles", "cloth", "specks", "stripes", "books", "keys", "text", "picture", "panes", "leaves",
    "panels", "carpet",
)  # fmt: skip


_DECLARATION = Declaration(
    "trace_rooms",
    inputs={
        "solids": Array(f"B N {SOLID_WORDS}"),
        "focals": Array("B"),
        "sky": Array("B 9 3"),
        "hidden": Array("B H W"),
        "focus": Array("B"),
        "apertures": Array("B"),
    },
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
        focals: Focal lengths of the camera [px]; its axis is the picture's middle.
        sky: Coefficients of the light from all around.
        lamps: The lamps, with their depth buffers of the hand.
        hidden: Share of each pixel that the hand covers; covered ones are left black.
        focus: Depth that is sharp [m].
        apertures: Radius of the blur of things far off, over the width of the picture.

    Raises:
        ValueError: wrong shapes.
    """
    _DECLARATION.check(solids=solids, focals=focals, sky=sky, hidden=hidden, focus=focus, apertures=apertures)
    sharp, out = hidden.new_empty((*hidden.shape, 3)), hidden.new_empty((*hidden.shape, 3))
    depth, covered = scalars(torch.empty_like(hidden)), scalars(hidden)
    count = hidden.numel()
    inputs = [scalars(solids), scalars(focals), vectors(sky), lamps.struct(), covered, vectors(sharp), depth]
    launch_ranges(kernels.trace, count, inputs, like=hidden)
    inputs = [depth, covered, scalars(focus), scalars(apertures), vectors(sharp), vectors(out)]
    launch_ranges(kernels.defocus, count, inputs, like=hidden)
    return out
