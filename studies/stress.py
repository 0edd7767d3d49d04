"""What becomes of avatars of damaged photos.

Damage is done on purpose to a photo and to what is found in it: for avatars, and for the fit alone. Fills
docs/detail.md (stress): likeness of each avatar to its own, damaged photo, inside the outline; likeness of its open
hand, from the photo's side and from behind, after one gain per channel, to the avatar of the undamaged photo; what was
refused without `force`, and what is newly warned about.
"""

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

import cv2
import numpy as np
import torch

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import CanonicalGaussians, Landmarks, Photo
from oasis_warp.estimation.landmarks import FINGERS, box_size
from oasis_warp.evaluation.metrics import match_colors
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import masked_psnr
from oasis_warp.reconstruction import Reconstruction, reconstruct
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import photo_named
from studies.painted_truth import Chart, KnownHand, paint_photo
from studies.tables import Column, Section, table

SHARE = 0.05
"""How far masks and landmarks are off, in shares of the longer side of the landmarks' box."""
WARM, COLD, GLOVE = (1.0, 0.62, 0.30), (0.45, 0.75, 1.0), (0.10, 0.42, 0.55)
"""Gains of coloured light, and the colour of a glove [sRGB]."""
TINY, BLUR_SHARE = 64, 0.015
"""Longer side of the box of a tiny hand [px]; standard deviation of a blur over that side."""
MOVED = 0.2
"""How far a fault moves landmarks, in shares of the box."""


class DamagedInput(NamedTuple):
    """What `reconstruct` is given."""

    photo: Photo
    keypoints: dict | None = None
    """Contents of a keypoints file."""

    def write_keypoints(self, folder: Path) -> Path | None:
        """Write the keypoints file, if there is one."""
        if self.keypoints is None:
            return None
        path = folder / "keypoints.json"
        path.write_text(json.dumps(self.keypoints))
        return path


Damage = Callable[[Photo, Reconstruction], DamagedInput]


def hand_size(made: Reconstruction) -> float:
    """Longer side of the landmarks' box [px]."""
    return float(box_size(made.fit.landmarks.xy.numpy()))


def _with(photo: Photo, pixels: np.ndarray) -> Photo:
    return photo._replace(rgb=torch.from_numpy(np.ascontiguousarray(pixels.clip(0, 255).round().astype(np.uint8))))


def _keypoints(made: Reconstruction, xy: torch.Tensor | None = None) -> dict:
    landmarks = made.fit.landmarks
    world = {} if landmarks.world is None else {"world": landmarks.world.tolist()}
    return {"side": landmarks.side, "xy": (landmarks.xy if xy is None else xy).tolist(), **world}


def wrong_mask(photo: Photo, made: Reconstruction, *, change: Callable[..., np.ndarray]) -> DamagedInput:
    """The cut-out is too small or too large: every part of the hand is `SHARE` of its size thinner or thicker."""
    radius = max(1, round(SHARE * hand_size(made) / 2))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return DamagedInput(photo._replace(alpha=torch.from_numpy(change(made.fit.mask.numpy(), disc))))


def landmarks_off(photo: Photo, made: Reconstruction) -> DamagedInput:
    """Every landmark lies `SHARE` of the hand's size beside its place, in a direction of its own."""
    angles = torch.rand(21, generator=torch.Generator().manual_seed(0)) * 2 * torch.pi
    shift = SHARE * hand_size(made) * torch.stack([angles.cos(), angles.sin()], 1)
    return DamagedInput(photo, _keypoints(made, made.fit.landmarks.xy + shift))


def half_out(photo: Photo, made: Reconstruction) -> DamagedInput:
    """The photo ends in the middle of the hand, across the fingers' side: the wrist's half stays."""
    xy = made.fit.landmarks.xy
    direction = xy[9] - xy[0]
    axis = int(direction.abs().argmax())
    middle = round(float((xy[:, axis].min() + xy[:, axis].max()) / 2))
    rest = slice(middle, photo.rgb.shape[1 - axis]) if direction[axis] < 0 else slice(0, middle)
    moved = xy - (torch.tensor([1.0, 0.0] if axis == 0 else [0.0, 1.0]) * rest.start)
    rgb = photo.rgb[:, rest] if axis == 0 else photo.rgb[rest]
    return DamagedInput(photo._replace(rgb=rgb.contiguous(), alpha=None, focal=None), _keypoints(made, moved))


def coloured_light(photo: Photo, made: Reconstruction, *, gains: tuple[float, float, float]) -> DamagedInput:
    """A strongly coloured lamp."""
    return DamagedInput(_with(photo, photo.rgb.numpy() * np.array(gains)))


def dark(photo: Photo, made: Reconstruction) -> DamagedInput:
    """A sixth of the light, and the noise that comes with it."""
    noise = np.random.default_rng(0).normal(0, 4, photo.rgb.shape)
    return DamagedInput(_with(photo, photo.rgb.numpy() / 6 + noise))


def blurred(photo: Photo, made: Reconstruction) -> DamagedInput:
    """Out of focus."""
    pixels = photo.rgb.numpy().astype(np.float32)
    return DamagedInput(_with(photo, cv2.GaussianBlur(pixels, (0, 0), BLUR_SHARE * hand_size(made))))


def tiny(photo: Photo, made: Reconstruction) -> DamagedInput:
    """The hand has `TINY` pixels."""
    scale = TINY / hand_size(made)
    small = cv2.resize(photo.rgb.numpy(), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return DamagedInput(_with(photo, small)._replace(alpha=None, focal=photo.focal and photo.focal * scale))


def glove(photo: Photo, made: Reconstruction) -> DamagedInput:
    """The hand wears a thin, plain glove; its landmarks are given, since the networks know skin only."""
    pixels, mask = photo.rgb.numpy().astype(np.float32), made.fit.mask.numpy()[..., None]
    brightness = pixels.mean(2, keepdims=True) / max(float((pixels * mask).sum() / (3 * mask.sum())), 1.0)
    gloved = _with(photo, pixels * (1 - mask) + mask * 255 * brightness * np.array(GLOVE))
    return DamagedInput(gloved, _keypoints(made))


def painted(photo: Photo, made: Reconstruction, *, drawing: str) -> DamagedInput:
    """The hand wears one of the drawings of `painted_truth`."""
    known = KnownHand(made.avatar.hand, made.fit.pose, made.fit.camera, made.avatar, photo, None)
    return DamagedInput(paint_photo(known, Chart(known, drawing))._replace(name=photo.name))


DAMAGES: dict[str, Damage] = {
    "mask eroded": partial(wrong_mask, change=cv2.erode),
    "mask dilated": partial(wrong_mask, change=cv2.dilate),
    "landmarks off": landmarks_off,
    "half out": half_out,
    "warm light": partial(coloured_light, gains=WARM),
    "cold light": partial(coloured_light, gains=COLD),
    "dark": dark,
    "blurred": blurred,
    "tiny": tiny,
    "nail polish": partial(painted, drawing="nail polish"),
    "tattoo": partial(painted, drawing="tattoo"),
    "glove": glove,
}


# ---- faults of the fit's input: each gives a photo and landmarks that the fit should doubt


class FaultyInput(NamedTuple):
    """What a fault is made of."""

    photo: Photo
    landmarks: Landmarks
    other: Landmarks
    """Landmarks of another photo."""
    mask: np.ndarray
    """The right mask of this one."""
    rng: np.random.Generator


Fault = Callable[[FaultyInput], tuple[Photo, Landmarks]]


def _wrong_side(given: FaultyInput) -> tuple[Photo, Landmarks]:
    return given.photo, given.landmarks._replace(side="left" if given.landmarks.side == "right" else "right")


def _swapped(given: FaultyInput) -> tuple[Photo, Landmarks]:
    order = list(range(21))
    order[5:9], order[17:21] = order[17:21], order[5:9]
    assert given.landmarks.world is not None
    xy, world = given.landmarks.xy[order], given.landmarks.world[order]
    return given.photo, given.landmarks._replace(xy=xy, world=world)


def _finger_moved(given: FaultyInput, *, world: bool, bent: bool = False) -> tuple[Photo, Landmarks]:
    landmarks, rng = given.landmarks, given.rng
    rows = list(FINGERS.values())[rng.integers(5)][int(bent) :]
    angle, xy = rng.uniform(0, 2 * np.pi), landmarks.xy.numpy().astype(float)
    assert landmarks.world is not None
    points, centred = landmarks.world.numpy().astype(float), xy - xy.mean(0)
    pixels_per_metre = np.sqrt((centred**2).sum() / ((points - points.mean(0))[:, :2] ** 2).sum())
    shift = MOVED * box_size(xy) * np.array([np.cos(angle), np.sin(angle)])
    share = np.linspace(1 / len(rows), 1, len(rows))[:, None] if bent else 1
    xy[rows] += share * shift
    points[rows, :2] += share * shift / pixels_per_metre * world
    moved = landmarks._replace(xy=torch.from_numpy(xy).float(), world=torch.from_numpy(points).float())
    return given.photo, moved


def _of_other_photo(given: FaultyInput) -> tuple[Photo, Landmarks]:
    return given.photo, given.landmarks._replace(xy=given.other.xy, world=given.other.world)


def _half_cutout(given: FaultyInput) -> tuple[Photo, Landmarks]:
    angle, middle = given.rng.uniform(0, 2 * np.pi), given.landmarks.xy.numpy().mean(0)
    y, x = np.mgrid[0 : given.mask.shape[0], 0 : given.mask.shape[1]] + 0.5
    rest = (x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle) > 0
    return given.photo._replace(alpha=torch.from_numpy(given.mask * rest).float()), given.landmarks


FAULTS: dict[str, Fault] = {
    "none": lambda given: (given.photo, given.landmarks),
    "wrong side": _wrong_side,
    "index and little finger swapped": _swapped,
    "a finger moved by 20 % of the hand, in the photo": partial(_finger_moved, world=False),
    "the same, in the photo and the world points": partial(_finger_moved, world=True),
    "a finger turned about its root, its tip by 20 %": partial(_finger_moved, world=True, bent=True),
    "landmarks of another photo": _of_other_photo,
    "half of the cut-out missing": _half_cutout,
}


VIEW_SIZE = 256
LARGEST = 0.05
"""Standard deviation beyond which a Gaussian has exploded [m]."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"photos"})
    photos: tuple[str, ...] = ("palm_open_left_02.png",)
    """Photos of the tests, files, or synthetic:K."""


def make(damaged: DamagedInput, config: ReconstructConfig, *, force: bool) -> Reconstruction:
    """Reconstruct a damaged photo."""
    with tempfile.TemporaryDirectory() as folder:
        keypoints = damaged.write_keypoints(Path(folder))
        return reconstruct(damaged.photo, replace(config, force=force), keypoints=keypoints)


def is_sane(gaussians: CanonicalGaussians) -> bool:
    """Whether every number is finite, every colour in [0, 1] and no Gaussian larger than `LARGEST`."""
    finite = all(bool(part.isfinite().all()) for part in gaussians if part is not None)
    colors = gaussians.colors
    return finite and bool(((colors >= 0) & (colors <= 1)).all()) and float(gaussians.scales.max()) < LARGEST


@torch.no_grad()
def likeness(avatar: Avatar, other: Avatar) -> float:
    """PSNR of two avatars' open hands, from the front and from behind, where both are, after one gain per channel [dB].

    An avatar takes the light of its photo, so a lamp of another colour is no damage in itself.
    """
    drawn = []
    for each in (avatar, other):
        pose = avatar.source_pose._replace(angles=named_pose(each.hand, "open"))
        vertices = each.mesh(pose).vertices
        cameras = (orbit_camera(vertices, azimuth, size=VIEW_SIZE) for azimuth in (0.0, math.pi))
        drawn.append([each.render(camera, pose, BLACK) for camera in cameras])
    images, others = (torch.cat([view.image for view in views]) for views in drawn)
    inside = torch.cat([(a.alpha > 0.99) & (b.alpha > 0.99) for a, b in zip(*drawn, strict=True)])
    return masked_psnr(match_colors(others, images, inside.float()), images, inside.float())


def measure_refusals(name: str, config: ReconstructConfig) -> list[Row]:
    """A row for the photo as it is and one for each damage."""
    photo = photo_named(name, device=config.device)
    base = reconstruct(photo, config)
    rows = [row_of(name, "none", base, base, "")]
    for title, damage in DAMAGES.items():
        damaged, refused = damage(photo, base), ""
        try:
            made = make(damaged, config, force=False)
        except InputError as error:
            refused = str(error)
            try:
                made = make(damaged, config, force=True)
            except InputError as final:
                rows.append({"photo": name, "damage": title, "refusal": f"even by force: {final}"})
                continue
        rows.append(row_of(name, title, made, base, refused))
    return rows


def row_of(name: str, damage: str, made: Reconstruction, base: Reconstruction, refused: str) -> Row:
    """What is measured of one avatar."""
    return {
        "photo": name, "damage": damage, "refusal": refused, "own_db": made.errors["input_psnr_inner_db"],
        "like_db": None if made is base else likeness(base.avatar, made.avatar),
        "mask_iou": made.errors["mask_iou"], "seen": made.errors["seen_percent"],
        "sane": is_sane(made.avatar.gaussians),
        "warnings": [warning for warning in made.warnings if damage == "none" or warning not in base.warnings],
    }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Damage every photo."""
    return measured("stress", {name: (name, options.config()) for name in options.photos}, measure_refusals, options)


def warnings_of(row: Row) -> str:
    """Refusal, warnings and whether the avatar is broken, in words."""
    refusal = [f"refused: {row['refusal'].split(': ', 1)[-1]}"] if row["refusal"] else []
    broken = [] if row.get("sane", True) else ["**not finite or exploded**"]
    return "; ".join([*refusal, *row.get("warnings", []), *broken])


COLUMNS = (
    Column("damage", "damage"), Column("own photo, dB", "own_db", ".1f"),
    Column("undamaged avatar, dB", "like_db", ".1f"), Column("overlap of fit and mask", "mask_iou", ".2f"),
    Column("seen, %", "seen", ".0f"), Column("warnings", warnings_of),
)  # fmt: skip
SECTIONS = (Section("detail.md", "stress", table(COLUMNS)),)
