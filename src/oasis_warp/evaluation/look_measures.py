"""Measure how the avatar of one photo looks, from its own side, from others, and in other poses."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import place_anchors
from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.quality import SEEN
from oasis_warp.core.bands import split_bands
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import HandCrop, Photo, Render
from oasis_warp.estimation.hand_crop import crop_hand
from oasis_warp.evaluation.band_energy import (
    SIZE,
    Contrasts,
    contrasts,
    darkest_over_median,
    haze,
    log_brightness,
    mean_light,
    redness,
)
from oasis_warp.evaluation.kernel_distance import Sample, hand_features
from oasis_warp.evaluation.pictures import Cell
from oasis_warp.evaluation.real_hands import mostly_shows, side_masks
from oasis_warp.evaluation.summary import Record
from oasis_warp.evaluation.views import (
    DRAWN_SIZE,
    Surface,
    View,
    clear_of_arm,
    draw,
    read_crop,
    read_surface,
    shrink,
    silhouette,
    views_of,
    without_arm,
    wrist_end,
)
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import Perceptual
from oasis_warp.reconstruction import Reconstruction


class Picture(NamedTuple):
    """A drawn view, at the size in which it is measured, and what it shows."""

    view: View
    image: Float[Tensor, "S S 3"]
    """Without the arm."""
    alpha: Float[Tensor, "S S"]
    surface: Surface
    large: Render
    """The same as it was drawn."""


class Looks(NamedTuple):
    """All measurements of one avatar's looks."""

    record: Record
    """Measures; see `measure_looks`."""
    samples: dict[str, list[Sample]]
    """Features of its pictures by kind of view: "input", "side" (but that of the photo) and "pose"."""
    cells: list[Cell]
    """Cells of the contact sheet."""


@torch.no_grad()
def measure_looks(
    photo: Photo, made: Reconstruction, group: str, perceptual: Perceptual | None = None
) -> Looks:
    """Draw the views of the avatar of `photo` and measure them.

    The record holds `contrast` (of `contrast_measures`), blemishes (of `blemish_measures`) and, where there is
    `perceptual`, `lpips` of the photo's view.

    Args:
        photo: What `made` was made of.
        made: By `reconstruct`.
        group: Group of the hand, for the kernel distance.
        perceptual: LPIPS.
    """
    avatar, left = made.avatar, made.avatar.side == "left"
    pictures = draw_pictures(avatar, made.quality.visibility)
    crops = [
        crop_hand(photo, made.fit, avatar.surface_offsets.cpu(), ReconstructConfig(), size)
        for size in (SIZE, DRAWN_SIZE)
    ]
    shown = crops[0].image.flip(1) if left else crops[0].image
    mask, first = crops[0].mask.flip(1) if left else crops[0].mask, pictures[0].image[None]
    record: Record = {
        "side": avatar.side,
        "input_psnr_db": made.errors["input_psnr_inner_db"],
        "seen_percent": made.errors["seen_percent"],
        "contrast": contrast_measures(pictures, crops[0], left),
        **blemish_measures(avatar, pictures),
        "lpips": None if perceptual is None else float(perceptual(first, shown[None], mask[None])[0]),
    }
    samples: dict[str, list[Sample]] = {"input": [], "side": [], "pose": []}
    for picture in pictures:
        if picture.view.kind in samples and picture.view.name != "0":
            planes = (picture.image, picture.alpha)
            features = hand_features(*(plane.flip(1) for plane in planes) if left else planes)
            samples[picture.view.kind].append(Sample(group, mostly_shows(picture.surface), features))
    large = crops[1].image.flip(1) if left else crops[1].image
    cells = [(large, photo.name)] + [(p.large.image, _view_label(p.view)) for p in pictures if p.view.kind != "back"]
    return Looks(record, samples, cells)


def _view_label(view: View) -> str:
    return {"input": "the photo's view", "side": f"{view.name} degrees"}.get(view.kind, view.name)


def draw_pictures(avatar: Avatar, visibility: Float[Tensor, "V"]) -> list[Picture]:
    """Every view of `views_of`, in their order; `visibility` is that of `SurfaceQuality`."""
    hand, pictures = bundled_hand(), []
    palm, left = label_regions(hand).palm, avatar.side == "left"
    for view in views_of(avatar):
        drawn = draw(avatar, view)
        vertices = avatar.mesh(view.pose).vertices.cpu()
        surface = read_surface(hand, vertices, view.camera, visibility, palm, left=left)
        surface = clear_of_arm(hand, surface, vertices, view.camera)
        large = Render(drawn.image.cpu().clamp(0, 1), drawn.alpha.cpu())
        bare = without_arm(hand, large, vertices, view.camera)
        pictures.append(Picture(view, shrink(bare.image), shrink(bare.alpha), surface, large))
    return pictures


def contrast_measures(pictures: Sequence[Picture], crop: HandCrop, left: bool) -> dict[str, Contrasts]:
    """Contrasts by band [%] of parts of the skin.

    - `photo`, `seen`: seen by the photo, in the photo and drawn in its view, on the same pixels;
    - `turned`: seen by the photo, drawn in other poses;
    - `hidden_palm`, `hidden_back`: not seen at all, drawn from all sides in the photo's pose.

    A region of too few pixels is left out.
    """
    source = read_crop(crop)
    interior, image = (plane.flip(1) if left else plane for plane in (source.interior, crop.image))
    first = pictures[0]
    where = interior & first.surface.interior & (first.surface.visibility >= SEEN)
    weight = (interior & first.surface.interior).float()
    regions: dict[str, list[tuple[Tensor, Tensor]]] = {
        name: [(split_bands(log_brightness(shown), weight), where)]
        for name, shown in (("photo", image), ("seen", first.image))
    }
    regions |= {"turned": [], "hidden_palm": [], "hidden_back": []}
    for picture in pictures:
        if picture.view.kind not in ("side", "pose"):
            continue
        surface = picture.surface
        bands = split_bands(log_brightness(picture.image), surface.interior.float())
        if picture.view.kind == "pose":
            regions["turned"].append((bands, surface.interior & (surface.visibility >= SEEN)))
            continue
        for side, part in side_masks(surface).items():
            regions[f"hidden_{side}"].append((bands, part & (surface.visibility <= 0)))
    return {name: made for name, parts in regions.items() if (made := contrasts(parts))}


def blemish_measures(avatar: Avatar, pictures: Sequence[Picture]) -> Record:
    """What spoils a hand at a glance.

    - `haze`: that of the pictures, their mean; `haze_of_mean`: that of the mean prior's Gaussians on this surface;
    - `back_over_front`: light of the hand from behind over that from the photo's side, red, green and blue;
    - `palm_minus_back`: a* of the palm less that of the back, of the open hand from both sides;
    - `darkest`: brightness of the darkest percent of the opened palm over its median.

    None where too little is seen.
    """
    plain, hazes = mean_haze_avatar(avatar), []
    for picture in pictures:
        if picture.view.kind in ("side", "pose"):
            vertices = avatar.mesh(picture.view.pose).vertices.cpu()
            outline = silhouette(avatar.hand.faces.cpu(), vertices, picture.view.camera)
            wrist = wrist_end(avatar.hand, vertices, picture.view.camera)
            alphas = picture.large.alpha, draw(plain, picture.view).alpha.cpu()
            hazes.append([haze(alpha, outline, wrist) for alpha in alphas])
    own, of_mean = (sum(values) / len(values) for values in zip(*hazes, strict=True))
    by_name: Mapping[tuple[str, str], Picture] = {(p.view.kind, p.view.name): p for p in pictures}
    front, behind = by_name["side", "0"], by_name["side", "180"]
    light = [mean_light(p.image, p.surface.interior) for p in (behind, front)]
    opened = by_name["pose", "open"], by_name["back", "open"]
    images = torch.cat([p.image for p in opened])
    places = {side: torch.cat([side_masks(p.surface)[side] for p in opened]) for side in ("palm", "back")}
    red = [redness(images, where) for where in places.values()]
    most = max(opened, key=lambda p: int(side_masks(p.surface)["palm"].sum()))
    return {
        "haze": own,
        "haze_of_mean": of_mean,
        "back_over_front": None if light[0] is None or light[1] is None else (light[0] / light[1]).tolist(),
        "palm_minus_back": None if red[0] is None or red[1] is None else red[0] - red[1],
        "darkest": darkest_over_median(most.image, side_masks(most.surface)["palm"]),
    }


def mean_haze_avatar(avatar: Avatar) -> Avatar:
    """The same hand with the mean prior's Gaussians, black: only their alpha matters."""
    anchors = place_anchors(avatar.hand, avatar.rest)
    return avatar.with_looks(anchors.with_colors(torch.zeros(len(anchors.opacities), 3, device=avatar.device)), None)
