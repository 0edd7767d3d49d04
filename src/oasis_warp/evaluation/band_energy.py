"""How much contrast skin has, by the size of its detail: what tells a hand from one of clay; and its blemishes.

The logarithm of the luminance is split by differences of Gaussians (`core.bands`), to which what lies outside of the
skin adds nothing, its outline included. Blemishes spoil a hand at a glance: haze around it, wounds on an opened palm,
and a back of another colour.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from oasis_warp.core.color import cielab, linear_light, luminance
from oasis_warp.core.windows import largest_around

SIZE = 256
"""Side of the square pictures in which contrasts are measured [px]."""
BANDS = ("<1", "1-2", "2-4", "4-8")
"""Names of the bands: detail that a Gaussian of the larger sigma blurs and one of the smaller does not."""
DARKEST = 0.002
"""Least luminance whose logarithm is taken: half of what the sRGB code 8 of 255 shows, below which is noise."""

KEPT = 0.95
"""Share of the pixels that count, those of least contrast: in photos the rest are mostly outlines inside the hand, as a
fitted mesh misses them by a few pixels."""
MIN_PIXELS = 800
"""Fewest pixels whose contrasts are measured: some 4 % of a hand that fills its picture."""

Contrasts = tuple[float, ...]
"""Root mean square of the logarithm of the luminance in each of `BANDS`, over the pixels that count, in percent."""


def log_brightness(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Natural logarithm of the luminance of sRGB colours: a gain of the light changes no contrast."""
    return luminance(image.clamp(0, 1)).clamp_min(DARKEST).log()


def contrasts(parts: Sequence[tuple[Float[Tensor, "4 H W"], Bool[Tensor, "H W"]]]) -> Contrasts | None:
    """Contrasts over some pixels of one or several pictures together; None of fewer than `MIN_PIXELS`.

    Args:
        parts: Bands of each picture, from `split_bands`, and the pixels that count.
    """
    values = torch.cat([bands[:, where] for bands, where in parts], 1).double()
    if values.shape[1] < MIN_PIXELS:
        return None
    kept = values.square().sort(1).values[:, : round(KEPT * values.shape[1])]
    return tuple(100 * value for value in kept.mean(1).sqrt().tolist())


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
    near = largest_around(silhouette.to(alpha), HAZE_REACH) > 0
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
