"""Measure how the avatar of one photo looks, from its own side, from others, and in other poses."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.unseen_skin import OwnSkin, paint_hand
from oasis_warp.avatar.anchors import place_anchors
from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.prior import Prior
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
from oasis_warp.fitted_avatar import make_avatar
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
    """Features of its pictures by kind: "input", "side" (but that of the photo), "pose", and "painted", the
    photo's view of a hand that is painted all over."""
    cells: list[Cell]
    """Cells of the contact sheet."""


@torch.no_grad()
def measure_looks(
    photo: Photo, made: Reconstruction, group: str, prior: Prior, seed: int, perceptual: Perceptual | None = None
) -> Looks:
    """Draw the views of the avatar of `photo` and measure them.

    The record holds `contrast` (of `contrast_measures`), blemishes (of `blemish_measures`) and, where there is
    `perceptual`, `lpips` of the photo's view.

    Args:
        photo: What `made` was made of.
        made: By `reconstruct`.
        group: Group of the hand, for the kernel distance.
        prior: That it was made with.
        seed: Seed of its painting.
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
    painted = None if made.skin is None else _draw_painted(photo, made, made.skin, prior, seed, pictures[0])
    record: Record = {
        "side": avatar.side,
        "input_psnr_db": made.errors["input_psnr_inner_db"],
        "seen_percent": made.errors["seen_percent"],
        "contrast": contrast_measures(pictures, crops[0], left, painted),
        **blemish_measures(avatar, pictures),
        "lpips": None if perceptual is None else float(perceptual(first, shown[None], mask[None])[0]),
    }
    samples: dict[str, list[Sample]] = {"input": [], "side": [], "pose": [], "painted": []}
    kinds = [(picture.view.kind, picture) for picture in pictures if picture.view.name != "0"]
    for kind, picture in kinds if painted is None else [*kinds, ("painted", painted)]:
        if kind in samples:
            planes = (picture.image, picture.alpha)
            features = hand_features(*(plane.flip(1) for plane in planes) if left else planes)
            samples[kind].append(Sample(group, mostly_shows(picture.surface), features))
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
        vertices = avatar.mesh(view.pose).vertices.cpu()
        surface = read_surface(hand, vertices, view.camera, visibility, palm, left=left)
        pictures.append(_draw_picture(avatar, view, clear_of_arm(hand, surface, vertices, view.camera)))
    return pictures


def _draw_picture(avatar: Avatar, view: View, surface: Surface) -> Picture:
    drawn = draw(avatar, view)
    large = Render(drawn.image.cpu().clamp(0, 1), drawn.alpha.cpu())
    bare = without_arm(bundled_hand(), large, avatar.mesh(view.pose).vertices.cpu(), view.camera)
    return Picture(view, shrink(bare.image), shrink(bare.alpha), surface, large)


def _draw_painted(
    photo: Photo, made: Reconstruction, skin: OwnSkin, prior: Prior, seed: int, first: Picture
) -> Picture:
    """The photo's view `first`, of the same hand in the same light, painted all over."""
    avatar = made.avatar
    on_device = ReconstructConfig(device="cuda" if avatar.device.type == "cuda" else "cpu")
    crop = crop_hand(photo, made.fit, avatar.surface_offsets.cpu(), on_device, SIZE)
    rest = crop.rest.vertices
    gaussians = paint_hand(bundled_hand(), prior(crop), rest, skin, seed=seed)
    light = None if avatar.light is None else avatar.light._replace(shade=None, facing=None, doubt=None)
    painted = make_avatar(made.fit, avatar.surface_offsets, crop, gaussians, light, torch.ones_like(rest[:, 0]))
    return _draw_picture(painted, first.view, first.surface)


def contrast_measures(
    pictures: Sequence[Picture], crop: HandCrop, left: bool, painted: Picture | None = None
) -> dict[str, Contrasts]:
    """Contrasts by band [%] of parts of the skin.

    - `photo`, `seen`: seen by the photo, in the photo and drawn in its view, on the same pixels;
    - `photo_palm`, `painted_palm`, `photo_back`, `painted_back`: the same on either side, drawn as if it were unseen;
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
    if painted is not None:
        for side, part in side_masks(first.surface).items():
            for name, shown in ((f"photo_{side}", image), (f"painted_{side}", painted.image)):
                regions[name] = [(split_bands(log_brightness(shown), weight), where & part)]
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
