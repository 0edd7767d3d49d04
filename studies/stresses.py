"""What can go wrong with a photo, and with what is found in it, done to a photo on purpose."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from painted_truth import Chart, Truth, paint_photo

from oasis_warp.core.types import Photo
from oasis_warp.reconstruction import Reconstruction

SHARE = 0.05
"""By which masks and landmarks are off, of the longer side of the landmarks' box."""
WARM, COLD, GLOVE = (1.0, 0.62, 0.30), (0.45, 0.75, 1.0), (0.10, 0.42, 0.55)
"""Gains of coloured light, and the colour of a glove [sRGB]."""
TINY, BLUR_SHARE = 64, 0.015
"""Longer side of the box of a tiny hand [px]; standard deviation of a blur over that side."""


class Stressed(NamedTuple):
    """A photo to reconstruct from."""

    photo: Photo
    keypoints: dict | None = None
    """To write as a keypoints file."""


Stress = Callable[[Photo, Reconstruction], Stressed]


def box(made: Reconstruction) -> float:
    """Longer side of the landmarks' box [px]."""
    xy = made.fit.landmarks.xy
    return float((xy.amax(0) - xy.amin(0)).max())


def _with(photo: Photo, pixels: np.ndarray) -> Photo:
    return photo._replace(rgb=torch.from_numpy(np.ascontiguousarray(pixels.clip(0, 255).round().astype(np.uint8))))


def _disc(made: Reconstruction) -> np.ndarray:
    radius = max(1, round(SHARE * box(made) / 2))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def mask_eroded(photo: Photo, made: Reconstruction) -> Stressed:
    """The cut-out is too small: every part of the hand is `SHARE` of its size thinner."""
    return Stressed(photo._replace(alpha=torch.from_numpy(cv2.erode(made.fit.mask.numpy(), _disc(made)))))


def mask_dilated(photo: Photo, made: Reconstruction) -> Stressed:
    """The cut-out is too large: every part of the hand is `SHARE` of its size thicker."""
    return Stressed(photo._replace(alpha=torch.from_numpy(cv2.dilate(made.fit.mask.numpy(), _disc(made)))))


def landmarks_off(photo: Photo, made: Reconstruction) -> Stressed:
    """Every landmark lies `SHARE` of the hand's size beside its place, in a direction of its own."""
    landmarks = made.fit.landmarks
    angles = torch.rand(21, generator=torch.Generator().manual_seed(0)) * 2 * torch.pi
    xy = landmarks.xy + SHARE * box(made) * torch.stack([angles.cos(), angles.sin()], 1)
    return Stressed(photo, {"side": landmarks.side, "xy": xy.tolist(), **_world(made)})


def half_out(photo: Photo, made: Reconstruction) -> Stressed:
    """The photo ends in the middle of the hand, across the fingers' side: the wrist's half stays."""
    xy = made.fit.landmarks.xy
    way = xy[9] - xy[0]
    axis = int(way.abs().argmax())
    middle = round(float((xy[:, axis].min() + xy[:, axis].max()) / 2))
    size = photo.rgb.shape[1 - axis]
    kept = slice(middle, size) if way[axis] < 0 else slice(0, middle)
    moved = xy - (torch.tensor([1.0, 0.0] if axis == 0 else [0.0, 1.0]) * kept.start)
    rgb = photo.rgb[:, kept] if axis == 0 else photo.rgb[kept]
    cut = photo._replace(rgb=rgb.contiguous(), alpha=None, focal=None)
    return Stressed(cut, {"side": made.fit.side, "xy": moved.tolist(), **_world(made)})


def _world(made: Reconstruction) -> dict[str, list]:
    world = made.fit.landmarks.world
    return {} if world is None else {"world": world.tolist()}


def _light(photo: Photo, gains: tuple[float, float, float]) -> Stressed:
    return Stressed(_with(photo, photo.rgb.numpy() * np.array(gains)))


def warm_light(photo: Photo, made: Reconstruction) -> Stressed:
    """A strongly orange lamp."""
    return _light(photo, WARM)


def cold_light(photo: Photo, made: Reconstruction) -> Stressed:
    """A strongly blue lamp."""
    return _light(photo, COLD)


def dark(photo: Photo, made: Reconstruction) -> Stressed:
    """A sixth of the light, and the noise that comes with it."""
    noise = np.random.default_rng(0).normal(0, 4, photo.rgb.shape)
    return Stressed(_with(photo, photo.rgb.numpy() / 6 + noise))


def blurred(photo: Photo, made: Reconstruction) -> Stressed:
    """Out of focus."""
    pixels = photo.rgb.numpy().astype(np.float32)
    return Stressed(_with(photo, cv2.GaussianBlur(pixels, (0, 0), BLUR_SHARE * box(made))))


def tiny(photo: Photo, made: Reconstruction) -> Stressed:
    """The hand has `TINY` pixels."""
    scale = TINY / box(made)
    small = cv2.resize(photo.rgb.numpy(), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Stressed(_with(photo, small)._replace(alpha=None, focal=photo.focal and photo.focal * scale))


def glove(photo: Photo, made: Reconstruction) -> Stressed:
    """The hand wears a thin, plain glove; where it is, is given: the networks know skin only."""
    pixels, mask = photo.rgb.numpy().astype(np.float32), made.fit.mask.numpy()[..., None]
    brightness = pixels.mean(2, keepdims=True) / max(float((pixels * mask).sum() / (3 * mask.sum())), 1.0)
    gloved = _with(photo, pixels * (1 - mask) + mask * 255 * brightness * np.array(GLOVE))
    return Stressed(gloved, {"side": made.fit.side, "xy": made.fit.landmarks.xy.tolist(), **_world(made)})


def _painted(photo: Photo, made: Reconstruction, kind: str) -> Stressed:
    truth = Truth(made.avatar.hand, made.fit.pose, made.fit.camera, made.avatar, photo, None)
    return Stressed(paint_photo(truth, Chart(truth, kind))._replace(name=photo.name))


def nail_polish(photo: Photo, made: Reconstruction) -> Stressed:
    """Red nails."""
    return _painted(photo, made, "nail polish")


def tattoo(photo: Photo, made: Reconstruction) -> Stressed:
    """A star of 30 mm."""
    return _painted(photo, made, "tattoo")


STRESSES: dict[str, Stress] = {
    stress.__name__.replace("_", " "): stress
    for stress in (
        mask_eroded, mask_dilated, landmarks_off, half_out, warm_light, cold_light, dark, blurred, tiny, nail_polish,
        tattoo, glove,
    )
}  # fmt: skip


def write_keypoints(stressed: Stressed, folder: Path) -> Path | None:
    """The keypoints file of a stressed photo, if it has one."""
    if stressed.keypoints is None:
        return None
    path = folder / "keypoints.json"
    path.write_text(json.dumps(stressed.keypoints))
    return path
