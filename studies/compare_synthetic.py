"""Hold synthetic hands beside real photos: what the estimator makes of both, and the colours of palms and backs.

    python studies/compare_synthetic.py tests/data/photos --count 64

Both kinds take the same way: find the hand, fit the model, read colours at the vertices that the camera sees. Medians
of CIELAB over palm and back of each photo; the table gives their mean and spread. Of synthetic pictures the truth is
known, too: the distance of the landmarks that were found to those of the fitted model's kind is not, since a network
puts them elsewhere than the model's joints, so it is compared with what real photos show of it: the fit's own error.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
import tyro

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.observation import observe
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_points, mirror_pose
from oasis_warp.core.types import Camera, HandCrop, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.picture import render_batch
from oasis_warp.synthetic.shots import PICTURES_EACH
from oasis_warp.synthetic.spectrum import linear_to_lab

SUFFIXES = (".jpg", ".png")
TRUSTED = 0.8
"""Confidence of a vertex's colour that counts."""
FEWEST = 150
"""Vertices of a region that must be seen well."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to compare."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Of real photos, searched with its subfolders."""
    count: int = 64
    """Synthetic pictures, each of another person."""
    seed: int = 0
    size: int = 384
    """Side of the synthetic pictures [px]."""


class Row(NamedTuple):
    """One photo."""

    found: bool
    side_right: bool | None
    """Whether the side is the true one, where it is known."""
    fitted: bool
    reprojection: float
    """[%]."""
    mask_iou: float
    true_iou: float
    """Of the found mask with the true one above the wrist's cut; nan where it is not known."""
    palm: np.ndarray
    """Median CIELAB, nan where too little is seen."""
    back: np.ndarray


NONE = np.full(3, np.nan)
MISSED = Row(False, None, False, np.nan, np.nan, np.nan, NONE, NONE)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB of sRGB."""
    return linear_to_lab(np.where(rgb < 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4))


def measure(estimator: HandEstimator, photo: Photo, side: str | None, mask: torch.Tensor | None) -> Row:
    """What the estimator makes of a photo."""
    hands = estimator.find(photo)
    if not hands:
        return MISSED
    landmarks = hands[0]
    right_side = None if side is None else landmarks.side == side
    try:
        fit = estimator.fit(photo, landmarks)
    except InputError:
        return MISSED._replace(found=True, side_right=right_side)
    hand = estimator.hand
    rest = rest_hand(hand, fit.shape)
    left = fit.side == "left"
    posed = skin(hand, rest, mirror_pose(fit.pose) if left else fit.pose)
    if left:
        posed = posed._replace(vertices=mirror_points(posed.vertices))
    rgb = photo.rgb.float() / 255
    shape = rgb.shape[:2]
    side_length = max(shape)
    square = torch.zeros(side_length, side_length, 3)
    square[: shape[0], : shape[1]] = rgb
    inside = torch.zeros(side_length, side_length)
    inside[: shape[0], : shape[1]] = fit.mask
    camera = Camera(fit.camera.viewmat, fit.camera.K, side_length, side_length)
    # The mirrored surface keeps its winding, so its normals point inwards; observe wants them outwards.
    faces_out = hand if not left else _turned(hand)
    seen = observe(faces_out, HandCrop(square, inside, torch.ones_like(inside), camera, rest, posed))
    regions = label_regions(hand)
    skin_only = (seen.confidence > TRUSTED) & (regions.nail < 0.2)

    def median(where: torch.Tensor) -> np.ndarray:
        return np.median(lab(seen.colors[where].double().numpy()), 0) if int(where.sum()) >= FEWEST else NONE

    iou = np.nan
    if mask is not None:
        a, b = fit.mask > 0.5, mask > 0.5
        iou = float((a & b).sum() / (a | b).sum())
    return Row(True, right_side, True, fit.reprojection, fit.mask_iou, iou,
               median(skin_only & (regions.palm > 0.85)), median(skin_only & (regions.palm < 0.15)))  # fmt: skip


def _turned(hand):
    from dataclasses import replace

    return replace(hand, faces=hand.faces.flip(1))


def report(name: str, rows: list[Row]) -> None:
    """One block of the table."""
    n = len(rows)
    fitted = [r for r in rows if r.fitted]
    print(f"{name}: {n} photos, found {sum(r.found for r in rows)}, fitted {len(fitted)}")
    sides = [r.side_right for r in rows if r.side_right is not None]
    if sides:
        print(f"  side right: {sum(sides)} of {len(sides)}")
    for label, values in (
        ("reprojection [%]", [r.reprojection for r in fitted]),
        ("mask IoU", [r.mask_iou for r in fitted]),
        ("IoU with the true mask", [r.true_iou for r in fitted]),
    ):
        values = np.array(values)
        if np.isfinite(values).any():
            print(f"  {label}: median {np.nanmedian(values):.3f}, worst tenth {np.nanpercentile(values, 90):.3f}, "
                  f"best tenth {np.nanpercentile(values, 10):.3f}")  # fmt: skip
    for label, colors in (("palm", [r.palm for r in rows]), ("back", [r.back for r in rows])):
        colors = np.array([c for c in colors if np.isfinite(c).all()])
        if len(colors):
            words = ", ".join(
                f"{axis} {m:.0f} +-{s:.0f}" for axis, m, s in zip("Lab", colors.mean(0), colors.std(0), strict=True)
            )
            print(f"  {label} ({len(colors)}): {words}")


def main(options: Options) -> None:
    """Measure and print."""
    estimator = HandEstimator(bundled_hand())
    real = []
    paths = sorted(p for p in options.folder.rglob("*") if p.suffix in SUFFIXES and "no_hand" not in p.name)
    for k, path in enumerate(paths):
        real.append(measure(estimator, read_photo(path), None, None))
        print(f"\rreal {k + 1} of {len(paths)}", end="", file=sys.stderr)
    synthetic = []
    for k in range(options.count):
        batch = render_batch(options.seed, [k * PICTURES_EACH], options.size)
        rgb = (batch.image[0] * 255).round().to(torch.uint8)
        photo = Photo(rgb, None, None, f"synthetic {k}", 1.0)
        synthetic.append(measure(estimator, photo, "left" if int(batch.left[0]) else "right", batch.mask[0]))
        print(f"\rsynthetic {k + 1} of {options.count}", end="", file=sys.stderr)
    print(file=sys.stderr)
    report("real", real)
    report("synthetic", synthetic)


if __name__ == "__main__":
    main(tyro.cli(Options))
