"""Self-attention among the points, all of them or a coarse set of them."""

from jaxtyping import Float
from torch import Tensor, nn

from oasis_warp.core.hand_model import HandModel
from oasis_warp.network.attention import Block
from oasis_warp.network.coarse import place_coarse_points, to_coarse, to_fine


class CoarseLevel(nn.Module):
    """The way of point features to a coarse set of points and back; no parameters, and nothing that is saved."""

    pool: Tensor
    blend: Tensor
    weights: Tensor

    def __init__(self, hand: HandModel, count: int):
        super().__init__()
        for name, tensor in place_coarse_points(hand, count)._asdict().items():
            self.register_buffer(name, tensor, persistent=False)

    def down(self, x: Float[Tensor, "B V C"]) -> Float[Tensor, "B N C"]:
        """Means round the coarse points."""
        return to_coarse(x, self.pool)

    def up(self, x: Float[Tensor, "B N C"]) -> Float[Tensor, "B V C"]:
        """Blends of the coarse points."""
        return to_fine(x, self.blend, self.weights)


class Refinement(nn.Module):
    """Blocks of self-attention over Gaussian features.

    On a coarse level the points take over how much their coarse neighbours changed, so that what tells them apart
    stays.
    """

    def __init__(self, width: int, heads: int, layers: int):
        super().__init__()
        self.blocks = nn.Sequential(*(Block(width, heads) for _ in range(layers)))

    def forward(self, x: Float[Tensor, "B V C"], level: CoarseLevel | None) -> Float[Tensor, "B V C"]:
        """Refined features; at all points where `level` is None."""
        if level is None:
            return self.blocks(x)
        coarse = level.down(x)
        return x + level.up(self.blocks(coarse) - coarse)
