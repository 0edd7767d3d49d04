"""How well the surface is known: how much of it the photo shows, how sure the rest is, and warnings."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
import torch
from jaxtyping import Float
from scipy.sparse.csgraph import dijkstra
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from oasis_warp.avatar.appearance import label_regions, region_masks
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandCrop, Render

SEEN = 0.5
"""Confidence of an observation from which a place counts as seen; below it the photo only grazes it."""
REACH = 0.015
"""Distance along the surface over which what the photo shows says e times less [m]."""
TOLERATED = 0.08
"""Colour difference between avatar and photo that makes a place e times less trusted [sRGB]."""
LITTLE_SEEN = 20.0
"""Share of the surface below which the photo shows little of it [%]: 25 to 38 on fifteen photos of whole hands."""
DARK, CLIPPED, CLIP = 0.15, 0.1, 0.99
"""Mean brightness of a hand that is too dark; share of its pixels at the upper end, from CLIP on, that is too many."""
BLURRED, BLUR_SIDE, BLUR_WINDOW = 0.70, 512, 9
"""Blur [0 to 1] from which a photo counts as blurred, side of the crop at which it is measured, at most, and length of
the test's own blur [px]. Fifteen hands of 206 to 562 px have .41 to .62, and blurred by 2 px .74 and more."""
LUMA = (0.299, 0.587, 0.114)
SKIN_REDNESS = 1.03
"""Red over green and over blue, below which a hand is not skin in ordinary light: 1.10 and more on the same photos."""
MIN_TRUST = 1e-6


class SurfaceQuality(NamedTuple):
    """How well each vertex of the surface is known."""

    visibility: Float[Tensor, "V"]
    """1 seen by the photo from the front, falling to 0 where it grazes the surface or does not show it."""
    uncertainty: Float[Tensor, "V"]
    """0 where the avatar is as the photo shows it, 1 where only the prior knows anything."""
    invented: Float[Tensor, "V"] | None = None
    """1 where skin is painted because no photo shows it well, 0 where it is as a photo shows it; None if none is."""


@torch.no_grad()
def assess_surface(hand: HandModel, crop: HandCrop, drawn: Float[Tensor, "S S 3"]) -> SurfaceQuality:
    """How well the photo shows each place of the surface: a first guess that needs no ground truth.

    Trust in a vertex is the observation's confidence times exp(-|avatar - photo| / TOLERATED). It spreads along the
    surface, divided by e every REACH: uncertainty is 1 - max_w trust(w) exp(-d(v, w) / REACH), with the distances d
    along edges. One run of Dijkstra's algorithm from all vertices at once finds it.

    Args:
        hand: Model of the surface.
        crop: The photo.
        drawn: The avatar in the photo's view, over the photo.
    """
    seen = observe(hand, crop._replace(image=crop.image - drawn))
    residual = seen.colors.square().mean(-1).sqrt()
    trust = (seen.confidence * torch.exp(-residual / TOLERATED)).cpu().double().numpy()
    vertices, edges = crop.rest.vertices.cpu().double(), surface.mesh_edges(hand.faces.cpu())
    lengths = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).numpy()
    n, known = len(vertices), np.flatnonzero(trust > MIN_TRUST)
    # A source beside the graph, as far from each vertex as its trust has already fallen; an edge of 0 would be none.
    start = np.maximum(-REACH * np.log(trust[known]), 1e-12)
    ends = np.concatenate([edges[:, 0], np.full(len(known), n)]), np.concatenate([edges[:, 1], known])
    graph = sparse.csr_array((np.concatenate([lengths, start]), ends), shape=(n + 1, n + 1))
    away = dijkstra(graph, directed=False, indices=n)[:n]
    uncertainty = torch.from_numpy(1 - np.exp(-away / REACH)).to(seen.confidence)
    return SurfaceQuality(seen.confidence, uncertainty)


def over_photo(drawn: Render, crop: HandCrop) -> Float[Tensor, "S S 3"]:
    """A picture that was drawn over black, over the photo instead."""
    return drawn.image + (1 - drawn.alpha)[..., None] * crop.image


def combine_quality(qualities: Sequence[SurfaceQuality]) -> SurfaceQuality:
    """How well each vertex is known from several photos: as from the photo that shows it best."""
    visibility, uncertainty = (torch.stack([quality[k] for quality in qualities]) for k in range(2))
    return SurfaceQuality(visibility.amax(0), uncertainty.amin(0))


def coverage_percent(hand: HandModel, areas: Float[Tensor, "V"], quality: SurfaceQuality) -> dict[str, float]:
    """Shares of the surface [%]: seen, grazed, not seen, painted; seen of palm, back, nails; and the mean uncertainty.

    `areas` are those of the vertices at rest.
    """
    area, visibility = areas.cpu(), quality.visibility.cpu()
    seen, grazed = (visibility >= SEEN).float(), ((visibility > 0) & (visibility < SEEN)).float()

    def mean(values: Tensor, weight: Tensor) -> float:
        return float((values * weight).sum() / weight.sum())

    found = {"seen_percent": 100 * mean(seen, area), "grazed_percent": 100 * mean(grazed, area)}
    found["extrapolated_percent"] = 100 - found["seen_percent"] - found["grazed_percent"]
    for name, weight in region_masks(label_regions(hand)).items():
        found[f"{name}_seen_percent"] = 100 * mean(seen, area * weight)
    if quality.invented is not None:
        found["invented_percent"] = 100 * mean(quality.invented.cpu(), area)
    found["uncertainty_mean"] = mean(quality.uncertainty.cpu(), area)
    return found


def coverage_of_photos(
    areas: Float[Tensor, "V"], confidence: Float[Tensor, "K V"], share: Float[Tensor, "K V"]
) -> list[dict[str, float]]:
    """Shares of the surface [%] that each of K photos shows, and shows best; see `VertexObservations`."""
    best = (confidence * share).argmax(0)

    def percent(where: Tensor) -> float:
        return 100 * float((areas * where).sum() / areas.sum())

    return [
        {"seen_percent": percent(shown), "best_percent": percent(shown & (best == k))}
        for k, shown in enumerate(confidence >= SEEN)
    ]


def coverage_warnings(found: dict[str, float]) -> list[str]:
    """Warnings about the numbers of `coverage_percent`."""
    if found["seen_percent"] >= LITTLE_SEEN:
        return []
    percent = f"{found['seen_percent']:.0f} %"
    return [f"little was seen: the photo shows {percent} of the hand's surface, the rest is guessed"]


@torch.no_grad()
def photo_warnings(image: Float[Tensor, "S S 3"], mask: Float[Tensor, "S S"], side: float) -> list[str]:
    """Warnings about the photo of a hand: dark, over-exposed, not the colour of skin, blurred.

    Args:
        image: The square crop around the hand.
        mask: Share of each pixel that is hand.
        side: Side of that square in the photo [px].
    """
    inside = inner_mask(mask) > 0.5
    if not bool(inside.any()):
        return ["the hand is only a few pixels wide: its colours are mixed with the background"]
    pixels, notes = image[inside], []
    red, green, blue = pixels.mean(0).tolist()
    brightness = red * LUMA[0] + green * LUMA[1] + blue * LUMA[2]
    clipped = float((pixels.amax(1) > CLIP).float().mean())
    if brightness < DARK:
        notes.append(f"dark photo: the hand has {100 * brightness:.0f} % of full brightness, its colours are noisy")
    if clipped > CLIPPED:
        notes.append(f"over-exposed photo: {100 * clipped:.0f} % of the hand is almost white and has no detail")
    if red < SKIN_REDNESS * max(green, blue):
        notes.append("the hand does not have the colour of skin: coloured light, or a glove, which is treated as skin")
    if (found := _blur(image, mask, side)) > BLURRED:
        notes.append(f"blurred photo: the avatar will be blurred too (blur {found:.2f}, in sharp photos below 0.65)")
    return notes


def _blur(image: Tensor, mask: Tensor, side: float) -> float:
    """Share of the differences between neighbouring pixels that survives a blur: little where the picture is sharp.

    The share is that of the worse of both axes (Crete et al. 2007, "The blur effect"), at the photo's own size.
    """
    size = min(round(side), BLUR_SIDE, len(image))  # a crop that was made smaller is sharp, not blurred
    planes = torch.cat([(image @ image.new_tensor(LUMA))[None, None], mask[None, None]], 1)
    grey, hand = interpolate(planes, size=(size, size), mode="bilinear", antialias=True)[0]
    inside = inner_mask((hand > 0.5).float(), 4) > 0.5
    worst = 0.0
    for picture, within in ((grey, inside), (grey.T, inside.T)):
        blurred = avg_pool2d(picture[None, None], (BLUR_WINDOW, 1), stride=1, padding=(BLUR_WINDOW // 2, 0))[0, 0]
        sharp, soft = (plane.diff(dim=0).abs()[within[1:]] for plane in (picture, blurred))
        lost = float((sharp - soft).clamp_min(0).sum())
        worst = max(worst, 1 - lost / max(float(sharp.sum()), 1e-9))
    return worst
