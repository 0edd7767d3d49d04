"""What the photos' cameras see: kept as Gaussians change, or changed into the photos by shade that fades elsewhere."""

# SciPy's stubs do not know that `distance_transform_edt` returns distances.
# pyright: reportOptionalSubscript=false, reportOptionalIterable=false, reportGeneralTypeIssues=false

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import interpolate

from oasis_warp.adaptation.sharpen import lit_as_photo
from oasis_warp.adaptation.unlit import MIN_ALPHA
from oasis_warp.avatar.anchors import rim_fade, vertex_to_gaussians
from oasis_warp.avatar.densify import Densified
from oasis_warp.avatar.pose import pose_gaussians, with_shade_baked
from oasis_warp.avatar.vertex_light import posed_lighting
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.ops import BlendWeights, blend_colors
from oasis_warp.render import render, view_weights

ROUNDS, OVERSHOOT = 8, 1.5
"""Steps towards the photo, and how much longer each is than the mean of what is missing."""
RIM = 2.2 / 256
"""Distance from the mask's border up to which a pixel may hold background, as a share of the crop's side. Such pixels,
and as far outside, take the nearest sure skin: with the photo's pixels hands had a rim of the room behind them."""
SOFT = 2 / 256
"""Standard deviation of the blur of the skin that they take, as a share of the crop's side."""
UNSURE = 0.6
"""Weight of these pixels at the border and outside; inside it grows to 1, that of sure ones."""
FINER, LARGEST = 2, 768
"""How many times as fine as the photo pictures are matched first, up to so many pixels a side. Of outlines that fall
between the photo's pixels thin bright lines were left in finer pictures."""
WRIST = 0.02
"""Distance from the wrist's end up to which nothing changes, and over which the change grows [m]."""
FEWEST, HARDLY_SEEN = 0.05, 1.0
"""Sums of a Gaussian's weights over the pixels that count: less than the first says nothing about its colour. To keep a
picture, Gaussians with less than the second change less: at borders of seen skin a pattern like scales appeared."""
MIN_COLOR = 0.01
"""Least colour whose logarithm is taken."""
MOST, MOST_KEPT = 3.0, 0.3
"""Largest logarithms by which shade and colours change. With more, creases of dark skin, which have next to no blue,
got specks of it."""


class _View(NamedTuple):
    """A camera's picture that Gaussians are to show."""

    weights: BlendWeights
    colors: Float[Tensor, "N 3"]
    """Of the Gaussians before, in the picture's light."""
    goal: Float[Tensor, "H W 3"]
    """The picture, as far as the Gaussians cover it."""
    counts: Float[Tensor, "H W 1"]
    """How much each pixel counts."""


@torch.no_grad()
def match_photos(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    crops: Sequence[HandCrop],
    lights: Sequence[HandLight],
    gains: Float[Tensor, "K 3"],
) -> CanonicalGaussians:
    """Change the shade of Gaussians until their pictures are the photos.

    Without this step, skin that was fitted beside its place is a crack or a double contour in the photo's view. Beside
    the mask's border, where pixels may hold background, Gaussians are to show the nearest sure skin. Only the shade
    changes, which fades as the hand or the camera moves.

    Args:
        hand: Model of the surface.
        gaussians: Adapted to the photos, with unseen skin painted; as they are if they have no shade.
        crops: K photos, with one surface at rest.
        lights: Light of each.
        gains: How many times as bright as the first each is.
    """
    finer = [_enlarged(crop) for crop in crops]
    if any(len(large.mask) > len(crop.mask) for large, crop in zip(finer, crops, strict=True)):
        gaussians = _match_once(hand, gaussians, finer, lights, gains)
    return _match_once(hand, gaussians, crops, lights, gains)


def _match_once(
    hand: HandModel, gaussians: CanonicalGaussians, crops: Sequence[HandCrop], lights: Sequence[HandLight],
    gains: Float[Tensor, "K 3"],
) -> CanonicalGaussians:  # fmt: skip
    if gaussians.shade is None:
        return gaussians
    rest, faces, views = crops[0].rest.vertices, hand.faces.to(crops[0].image.device), []
    for crop, light, gain in zip(crops, lights, gains, strict=True):
        posed = crop.posed.vertices
        lit = lit_as_photo(gaussians, faces, light, posed_lighting(rest, posed, faces, light))
        weights = view_weights(pose_gaussians(lit, faces, rest, posed), crop.camera)
        image, counts = _skin_alone(crop)
        views.append(_View(weights, (lit.colors * gain).clamp(0, 1), image * weights.alphas, counts))
    fade = rim_fade(rest[None], hand.rim.to(rest.device), WRIST, WRIST)[0, :, None]
    logs = _missing(views, FEWEST) * vertex_to_gaussians(fade, faces, gaussians)
    return gaussians._replace(shade=gaussians.shade * logs.exp())


@torch.no_grad()
def keep_pictures(
    hand: HandModel, before: CanonicalGaussians, after: Densified, crops: Sequence[HandCrop],
    openly: Float[Tensor, "V 1"],
) -> CanonicalGaussians:  # fmt: skip
    """The finer Gaussians `after`, with the new ones in such colours that photos' cameras see what they saw `before`.

    Fine Gaussians have the averages of those that were there, which blurs what the photos show.

    Args:
        hand: Model of the surface.
        before: Fitted to the photos.
        after: The same with finer ones.
        crops: K photos, with one surface at rest.
        openly: How far colours change; the rest is shade, if there is any. Where the photos end both change fast, and
            the colours got pale specks.
    """
    faces, views, made = hand.faces.to(crops[0].image.device), [], after.gaussians
    old, new = with_shade_baked(before), with_shade_baked(made)
    for crop in crops:
        surfaces = faces, crop.rest.vertices, crop.posed.vertices
        image, alpha = render(pose_gaussians(old, *surfaces), crop.camera)
        weights, alpha = view_weights(pose_gaussians(new, *surfaces), crop.camera), alpha[..., None]
        goal = image / alpha.clamp_min(MIN_ALPHA) * weights.alphas
        views.append(_View(weights, new.colors, goal, (alpha > MIN_ALPHA).to(alpha)))
    logs = _missing(views, HARDLY_SEEN).clamp(-MOST_KEPT, MOST_KEPT)
    logs[: len(logs) - after.n_new] = 0
    share = vertex_to_gaussians(openly, faces, made) if made.shade is not None else 1
    changed = made._replace(colors=(made.colors * (share * logs).exp()).clamp(0, 1))
    return changed if made.shade is None else changed._replace(shade=made.shade * ((1 - share) * logs).exp())


def _enlarged(crop: HandCrop) -> HandCrop:
    """The same photo with finer pixels in between; itself from `LARGEST` on."""
    size = min(FINER * len(crop.mask), LARGEST)
    if size <= len(crop.mask):
        return crop
    planes = torch.cat([crop.image, crop.mask[..., None], crop.above_wrist[..., None]], -1).permute(2, 0, 1)[None]
    planes = interpolate(planes, (size, size), mode="bicubic", align_corners=False)[0].permute(1, 2, 0).clamp(0, 1)
    return crop._replace(
        image=planes[..., :3], mask=planes[..., 3], above_wrist=planes[..., 4],
        camera=crop_camera(crop.camera, 0.0, 0.0, float(len(crop.mask)), size),
    )  # fmt: skip


def _skin_alone(crop: HandCrop) -> tuple[Float[Tensor, "S S 3"], Float[Tensor, "S S 1"]]:
    """The photo with the nearest skin at and beyond the mask's border, and how much each pixel counts.

    A mask of the whole crop has no border: all of it counts. Of an empty one nothing does.
    """
    rim, mask = RIM * len(crop.mask), crop.mask.cpu().numpy() > 0.5
    if mask.all() or not mask.any():  # distances to a border are undefined
        return crop.image, torch.full_like(crop.image[..., :1], float(mask.all()))
    depth = distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]  # the photo's border cuts the hand
    sure = depth > rim if (depth > rim).any() else mask
    away, nearest = distance_transform_edt(~sure, return_indices=True)
    image = crop.image.cpu().numpy()
    beside = cv2.GaussianBlur(image[tuple(nearest)], (0, 0), SOFT * len(mask))
    counts = np.where(away < 2 * rim + 1, (depth / rim).clip(UNSURE, 1), 0)
    skin = torch.from_numpy(np.where(sure[..., None], image, beside))
    return skin.to(crop.image), torch.from_numpy(counts).to(crop.image)[..., None]


def _missing(views: Sequence[_View], least: float) -> Float[Tensor, "N 3"]:
    """What the logarithms of the Gaussians' colours miss in pictures; little if their weights sum to less than `least`.

    Each step moves the colour of a Gaussian, as a picture shows it, by the mean of what its pixels miss, weighted as
    they blend it (SIRT, Gilbert 1972). Several pictures share a Gaussian as the squares of the weights that it has in
    each: nearly all of it goes to the one that shows it best, so they do not undo each other's change.
    """
    totals = torch.stack([view.weights.transpose @ view.counts.view(-1, 1) for view in views])
    shares = totals.square() / totals.square().sum(0).clamp_min(FEWEST**2) * (totals > FEWEST)
    logs = torch.zeros_like(views[0].colors)
    for (weights, start, goal, counts), total, share in zip(views, totals, shares, strict=True):
        colors = start
        for _ in range(ROUNDS):
            missing = (goal - blend_colors(weights, colors)) * counts
            step = (weights.transpose @ missing.view(-1, 3)) / total.clamp_min(least)
            colors = (colors + OVERSHOOT * step * share).clamp(0, 1)
        logs += (colors.clamp_min(MIN_COLOR) / start.clamp_min(MIN_COLOR)).log().clamp(-MOST, MOST)
    return logs
