"""What spoils a hand at a glance: haze around it, wounds on an opened palm, and a back of another colour."""

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from oasis_warp.core.color import cielab, linear_light

HAZE_REACH = 5
"""Distance from the outline of the mesh beyond which nothing should be drawn [px of a picture of 512]."""
DARK_SHARE = 0.01
"""Share of the palm that is compared with its median."""
FEWEST = 300
"""Fewest pixels of a place that is measured."""


def haze(alpha: Float[Tensor, "H W"], silhouette: Bool[Tensor, "H W"], elsewhere: Bool[Tensor, "H W"]) -> float:
    """Sum of the alpha farther than `HAZE_REACH` outside the silhouette, over the silhouette's pixels.

    What lies `elsewhere`, at the end of the wrist, does not count.
    """
    window, near = 2 * HAZE_REACH + 1, silhouette.to(alpha)[None, None]
    for size, padding in (((window, 1), (HAZE_REACH, 0)), ((1, window), (0, HAZE_REACH))):
        near = max_pool2d(near, size, 1, padding)
    near = near[0, 0] > 0
    return float(alpha[~near & ~elsewhere].sum() / silhouette.sum().clamp_min(1))


def darkest_over_median(image: Float[Tensor, "H W 3"], where: Bool[Tensor, "H W"]) -> float | None:
    """Brightness (L*) of the darkest `DARK_SHARE` of the pixels over that of their median; None of too few."""
    if int(where.sum()) < FEWEST:
        return None
    light = cielab(image[where])[:, 0]
    return float(light.quantile(DARK_SHARE) / light.median().clamp_min(1e-3))


def redness(image: Float[Tensor, "H W 3"], where: Bool[Tensor, "H W"]) -> float | None:
    """Mean a* of CIELAB; None of too few pixels."""
    return float(cielab(image[where])[:, 1].mean()) if int(where.sum()) >= FEWEST else None


def mean_light(image: Float[Tensor, "H W 3"], where: Bool[Tensor, "H W"]) -> Float[Tensor, "3"] | None:
    """Mean of the linear light of each channel; None of too few pixels."""
    return linear_light(image[where]).mean(0) if int(where.sum()) >= FEWEST else None
