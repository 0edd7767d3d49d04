"""What studies measure with: photos by name, folders of photos, synthetic people and hand-drawn masks."""

import functools
import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oasis_warp.avatar.prior import Prior
from oasis_warp.core.types import HandFit, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation.held_out import FIRST_PERSON, CaptureConfig, capture_person
from oasis_warp.evaluation.same_hand import photos_in
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import choose_prior
from studies.harness import prior_choice

PHOTOS = Path("tests/data/photos")
SAME_HAND = PHOTOS / "same_hand"
OUTLINES = Path("tests/data/masks/outlines.json")
SYNTHETIC = "synthetic:"
SUPERSAMPLING = 4
"""Samples per pixel along each axis of a hand-drawn mask: finer than an edge that is drawn by hand."""

Coverage = npt.NDArray[np.float32]


def photos_below(folder: Path) -> list[Path]:
    """Every photo in `folder` and its subfolders."""
    return sorted(photo for inner in [folder, *folder.rglob("*")] if inner.is_dir() for photo in photos_in(inner))


def photo_named(name: str, folder: Path = PHOTOS, size: int = 512, device: str = "cpu") -> Photo:
    """The photo of a file in `folder`, or any other file; "synthetic:K" is one of held-out synthetic person K.

    That one is taken in even light before a plain wall, and has `size` pixels at least.
    """
    if not name.startswith(SYNTHETIC):
        return read_photo(folder / name if (folder / name).is_file() else Path(name))
    number = FIRST_PERSON + int(name.removeprefix(SYNTHETIC))
    person = capture_person(CaptureConfig(size=size, targets=1), "ordinary", number, torch.device(device))
    return synthetic_photo(person.photos["studio"].image[0].cpu(), name)


def synthetic_photo(image: Tensor, name: str) -> Photo:
    """A rendered picture, [H, W, 3] in [0, 1], as a photo."""
    return Photo((image * 255).round().to(torch.uint8), None, None, name, 1.0)


@functools.cache
def estimator() -> HandEstimator:
    """The estimator of the bundled hand, made once per process."""
    return HandEstimator(bundled_hand())


@functools.cache
def prior_named(name: str) -> Prior:
    """A prior by "learned", "none" or the path of its weights, loaded once per process."""
    return choose_prior(prior_choice(name))


def fit_largest(photo: Photo, *, force: bool = True) -> HandFit:
    """Fit the largest hand of a photo.

    Raises:
        InputError: it shows none, or, unless `force`, the fit is poor.
    """
    return estimator().fit(photo, choose_hand(estimator().find(photo), "largest", photo.name), force=force)


def people(count: int, first: int = 0) -> range:
    """Numbers of held-out synthetic people."""
    return range(FIRST_PERSON + first, FIRST_PERSON + first + count)


def read_masks(path: str | Path, *, cut_at_wrist: bool = False) -> dict[str, Coverage]:
    """Hand-drawn masks: the covered share of each pixel, float32 (H, W), by the photo's name as `mask_name` makes it.

    Coordinates of the outlines: x to the right, y down, in pixels of the photo; pixel (row i, column j) covers
    [j, j + 1) x [i, i + 1).

    Args:
        path: A JSON file such as tests/data/masks/outlines.json.
        cut_at_wrist: Drops what lies on the arm's side of the wrist line; otherwise a mask goes down the forearm as far
            as it was drawn.

    Raises:
        ValueError: a polygon is neither "outer" nor "hole".
    """
    entries = json.loads(Path(path).read_text(encoding="utf-8"))
    return {mask_name(entry["file"]): _coverage(entry, cut_at_wrist) for entry in entries}


def mask_name(file: str | Path) -> str:
    """The name of a photo's mask: its path below the folder of photos, without extension."""
    return Path(file).with_suffix("").as_posix()


def _coverage(entry: dict, cut_at_wrist: bool) -> Coverage:
    width, height = entry["size"]
    inside = np.zeros((height * SUPERSAMPLING, width * SUPERSAMPLING), bool)
    for polygon in entry["polygons"]:
        ((kind, points),) = polygon.items()
        if kind not in ("outer", "hole"):
            raise ValueError(f'{entry["file"]}: expected a polygon "outer" or "hole", got "{kind}".')
        filled = _filled(np.asarray(points, float) * SUPERSAMPLING, inside.shape)
        inside = inside | filled if kind == "outer" else inside & ~filled
    if cut_at_wrist:
        inside &= _hand_side(np.asarray(entry["wrist"], float) * SUPERSAMPLING, inside.shape)
    blocks = inside.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _filled(points: npt.NDArray[np.float64], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Samples inside a closed polygon (even-odd rule), tested at the sample centres.

    cv2.fillPoly also paints the samples that its outline touches, which widens a mask by an eighth of a pixel.
    """
    height, width = shape
    crossings = np.zeros((height, width + 1), np.int32)
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
        first, last = np.ceil(np.sort([y0, y1]) - 0.5).astype(int)  # the rows whose centre line the edge crosses
        rows = np.arange(max(first, 0), min(last, height))
        x = x0 + (rows + 0.5 - y0) * (x1 - x0) / ((y1 - y0) or 1.0)  # a level edge crosses no row
        crossings[rows, np.clip(np.ceil(x - 0.5), 0, width).astype(int)] += 1
    return np.cumsum(crossings, axis=1)[:, :width] % 2 == 1


def _hand_side(wrist: npt.NDArray[np.float64], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Samples to the left of a walk from the wrist's first end to its second (with y down: towards the fingers)."""
    (x0, y0), (x1, y1) = wrist
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return (x1 - x0) * (rows + 0.5 - y0) - (y1 - y0) * (columns + 0.5 - x0) <= 0


def iou(a: Tensor, b: Tensor, where: Tensor | None = None) -> float:
    """Intersection over union of two masks, inside `where`."""
    if where is not None:
        a, b = a & where, b & where
    return float((a & b).sum() / (a | b).sum())


