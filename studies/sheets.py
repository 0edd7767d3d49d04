"""The sheets of pictures in the documentation: photos, priors' guesses, several photos of a hand, detail, paint.

Draws docs/_static/photographing.jpg, priors.jpg, fusion.jpg, detail.jpg and edits.jpg, or those named by `--of`.
Nothing is measured.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.cli.summary import GROUND, Panel, make_sheet, panel_side
from oasis_warp.core.camera import crop_camera, project
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import Camera, HandPose, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.editing import edit
from oasis_warp.estimation.hand_crop import CROP_MARGIN, crop_hand, detail_size, initial_offsets
from oasis_warp.evaluation.same_hand import photos_in
from oasis_warp.fitted_avatar import make_avatar
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.reconstruction import Reconstruction, reconstruct, reconstruct_same_hand
from studies.harness import AvatarOptions, Row
from studies.inputs import PHOTOS, SAME_HAND, fit_largest, photo_named, prior_named
from studies.painted_truth import Chart, encoded, paint_photo, photographed
from studies.tables import write_jpeg

Name = Literal["photographing", "priors", "fusion", "detail", "edits"]
Rows = Iterator[list[Panel]]
FINER = 3
"""Avatars are drawn so many times as large and averaged."""
AZIMUTHS = (90, 180)
"""Azimuths of the views beside the photo's own [degrees]."""
FUSED = tuple(
    SAME_HAND / "a1_wood_right" / f"{stem}.jpg" for stem in ("02_flat_closed", "03_flat_closed_back", "05_c_shape_open")
)
FACING = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Fingers up, palm to the camera."""
PHOTOGRAPHED = (
    ("palm_open_left_02.png", "good: sharp, even light, fingers apart"), ("back_flat_right_04.jpg", "good: the back"),
    ("ok_sign_left_10.jpg", "good: a pose of your own"), ("backlit_victory_14.jpg", "light from behind: a dark avatar"),
    ("thumb_up_left_06.jpg", "a closed hand: its palm is guessed"),
    ("small_pointing_right_13.jpg", "far away: little detail"),
)  # fmt: skip
"""Photos of the tests and what is said below them."""
CLOSE = (
    ("synthetic:2", 12, "nail"), ("synthetic:7", 10, "creases"), ("back_flat_right_04.jpg", 10, "knuckle"),
    ("back_flat_right_04.jpg", 12, "nail"),
)  # fmt: skip
"""Photo, landmark in the middle and name of each row of details."""
CLOSE_SHARE, SYNTHETIC_SIZE = 0.17, 1280
"""Side of these details over that of the hand's square, and of the synthetic photos [px]."""
TURNED = 0.7
"""Angle of the last panel of a row [rad]: the finer part must not show its border."""
PAINTED = (
    ("palm_open_left_02.png", "tattoo"), ("palm_open_left_02.png", "writing"), ("back_flat_right_04.jpg", "ring"),
    ("back_flat_right_04.jpg", "nail polish"),
)  # fmt: skip
"""Photos and what is painted on them."""
PAINTED_POSES = (("open", 0.5), ("fist", 0.0), ("point", -0.3))
"""And the azimuth of the view [rad]."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    of: tuple[Name, ...] = ("photographing", "priors", "fusion", "detail", "edits")
    static: Path = Path("docs/_static")
    """Folder to draw to."""


def cut(photo: Photo, square: tuple[float, float, float], side: int, caption: str) -> Panel:
    """A square of a photo: left, top and side [px]."""
    return Panel(to_uint8(resample_square(photo.rgb.float() / 255, *square, side)).numpy(), caption)


@torch.no_grad()
def view(avatar: Avatar, pose: HandPose, camera: Camera, side: int, caption: str) -> Panel:
    """The avatar as `camera` sees it, in another resolution."""
    large = crop_camera(camera, 0.0, 0.0, float(camera.width), FINER * side)
    pixels = to_uint8(avatar.render(large, pose, GROUND).image).numpy()
    return Panel(np.asarray(cv2.resize(pixels, (side, side), interpolation=cv2.INTER_AREA)), caption)


def around(avatar: Avatar, pose: HandPose, azimuth: float, side: int, caption: str) -> Panel:
    """The avatar from an azimuth [rad]."""
    return view(avatar, pose, avatar.orbit_camera(pose, azimuth, size=side), side, caption)


def photographing_rows(config: ReconstructConfig, width: int) -> Rows:
    """Photos that are good, and photos that are less so."""
    side, panels = panel_side(3, width), []
    for name, words in PHOTOGRAPHED:
        photo = read_photo(PHOTOS / name)
        height, length = photo.rgb.shape[0], min(photo.rgb.shape[:2])
        square = ((photo.rgb.shape[1] - length) / 2, (height - length) / 2, float(length))
        panels.append(cut(photo, square, side, words))
    yield panels[:3]
    yield panels[3:]


def prior_rows(config: ReconstructConfig, width: int) -> Rows:
    """Each single photo, and for both priors the guess and what adaptation makes of it, in three views each."""
    hand, side = bundled_hand(), panel_side(13, width)
    for path in photos_in(PHOTOS):
        photo = read_photo(path)
        try:
            fit = fit_largest(photo)
        except InputError as error:
            print(f"left out: {error}")
            continue
        offsets = initial_offsets(hand, fit)
        crop = crop_hand(photo, fit, offsets, config)
        row = [cut(photo, square_around(fit.mask, CROP_MARGIN), side, "photo")]
        for name in ("none", "learned"):
            guess = prior_named(name)(crop)
            adapted = adapt(hand, [guess], [crop])
            for label, gaussians, light in (("guess", guess, None), ("adapted", adapted.gaussians, adapted.light)):
                avatar = make_avatar(fit, offsets, crop, gaussians, light)
                pose, caption = avatar.source_pose, f"{name}: {label}"
                row.append(view(avatar, pose, avatar.source_camera, side, caption))
                row += [around(avatar, pose, math.radians(azimuth), side, caption) for azimuth in AZIMUTHS]
        yield row


def fusion_rows(config: ReconstructConfig, width: int) -> Rows:
    """Photos, and below them the open hand of the avatar of each, and of all, from the palm and from the back."""
    side, photos = panel_side(len(FUSED) + 1, width), [read_photo(path) for path in FUSED]
    alone = [reconstruct(photo, config) for photo in photos]
    shown = [cut(p, square_around(m.fit.mask, CROP_MARGIN), side, "photo") for p, m in zip(photos, alone, strict=True)]
    yield [*shown, Panel(np.full((side, side, 3), 255, np.uint8), "")]
    avatars = {f"photo {k + 1}": made.avatar for k, made in enumerate(alone)}
    avatars["all photos"] = reconstruct_same_hand(photos, config).avatar
    for azimuth in (0.0, math.pi):
        yield [around(avatar, facing(avatar), azimuth, side, name) for name, avatar in avatars.items()]


def facing(avatar: Avatar) -> HandPose:
    """The open hand, its palm to the camera."""
    mirror = torch.tensor([-1.0 if avatar.side == "left" else 1.0, 1, 1])
    return HandPose(named_pose(avatar.hand, "open"), mirror[:, None] * FACING * mirror, torch.tensor([0.0, 0.0, 0.5]))


def detail_rows(config: ReconstructConfig, width: int) -> Rows:
    """Around some landmarks: photo, avatar of 256 px and of the photo's own size, and the latter from beside."""
    known, side = {}, panel_side(4, width)
    for name, landmark, label in CLOSE:
        if name not in known:
            photo = photo_named(name, size=SYNTHETIC_SIZE, device=config.device)
            known[name] = photo, *(reconstruct(photo, replace(config, size=size)) for size in (256, "auto"))
        photo, plain, fine = known[name]
        fit, size = fine.fit, detail_size(fine.fit, config)
        xy, length = fit.landmarks.xy[landmark], CLOSE_SHARE * square_around(fit.mask, CROP_MARGIN)[2]
        square = float(xy[0]) - length / 2, float(xy[1]) - length / 2, length
        camera = crop_camera(fit.camera, *square, side)
        yield [
            cut(photo, square, side, f"{label}: photo, {size} px"),
            view(plain.avatar, fit.pose, camera, side, "avatar, 256 px"),
            view(fine.avatar, fit.pose, camera, side, f"avatar, {size} px"),
            view(fine.avatar, fit.pose, turned_about(fine, xy, camera), side, "from beside"),
        ]


def turned_about(made: Reconstruction, xy: Tensor, camera: Camera) -> Camera:
    """`camera`, turned by `TURNED` about the point of the surface that the photo shows at `xy` [px]."""
    vertices = made.avatar.mesh(made.fit.pose).vertices.cpu()
    uv, _ = project(made.fit.camera, vertices)
    hidden = made.quality.visibility.cpu() == 0
    middle = vertices[((uv - xy).norm(dim=1) + 1e6 * hidden).argmin()]
    rotation = from_axis_angle(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(TURNED))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, middle - rotation @ middle
    return camera._replace(viewmat=viewmat @ camera.viewmat.cpu())


def edit_rows(config: ReconstructConfig, width: int) -> Rows:
    """Photo, painted photo, the avatar in the same view and in other poses."""
    known, side = {}, panel_side(3 + len(PAINTED_POSES), width)
    for name, drawing in PAINTED:
        if name not in known:
            known[name] = photographed(PHOTOS / name)
        hand = known[name]
        painted = encoded(paint_photo(hand, Chart(hand, drawing)))
        made = edit(hand.avatar, painted, photo=hand.photo)
        square = made.square[:3]
        row = [cut(hand.photo, square, side, "photo"), cut(painted, square, side, f"painted: {drawing}")]
        row.append(view(made.avatar, hand.pose, made.avatar.source_camera, side, "avatar"))
        for gesture, azimuth in PAINTED_POSES:
            pose = hand.pose._replace(angles=named_pose(hand.hand, gesture))
            row.append(around(made.avatar, pose, azimuth, side, gesture))
        yield row


class Sheet(NamedTuple):
    """One of the pictures."""

    rows: Callable[[ReconstructConfig, int], Rows]
    width: int
    """Width of the picture [px]."""
    title: str
    subtitle: str = ""


SHEETS: dict[Name, Sheet] = {
    "photographing": Sheet(photographing_rows, 1100, "Photos of hands", "good ones, and three that cost quality"),
    "priors": Sheet(prior_rows, 1800, "Priors", "their guesses, and what adaptation makes of them"),
    "fusion": Sheet(fusion_rows, 1000, "Avatars of one photo each, and of all"),
    "detail": Sheet(detail_rows, 1000, "Detail", "before and after, and from beside"),
    "edits": Sheet(edit_rows, 1280, "Painted on a photo, worn by the avatar"),
}


def run(options: Options) -> list[Row]:
    """Draw the sheets."""
    for name in options.of:
        sheet = SHEETS[name]
        rows = list(sheet.rows(options.config(), sheet.width))
        write_jpeg(options.static / f"{name}.jpg", make_sheet(sheet.title, sheet.subtitle, rows, sheet.width))
    return []


SECTIONS = ()
