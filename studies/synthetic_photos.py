"""How like real photos synthetic hands are: what the estimator makes of both, and the colours of palms and backs.

Fills docs/synthetic.md (photos). Both kinds are treated alike: find the hand, fit the model, read colours at the
vertices that the camera sees. Colours are medians of CIELAB over palm and back of each photo; the table gives their
mean and spread. Of synthetic pictures the true mask and side are known, too.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.observation import observe
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_points, mirror_pose
from oasis_warp.core.types import Camera, HandCrop, HandFit, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.picture import render_batch
from oasis_warp.synthetic.shots import PICTURES_EACH
from studies.harness import Row, StudyOptions, measured
from studies.inputs import PHOTOS, estimator, iou, photos_below, synthetic_photo
from studies.tables import Column, Section, percentiles, table

TRUSTED = 0.8
"""Confidence of a vertex's colour that counts."""
FEWEST = 150
"""Vertices of a region that must be seen well."""
MEASURES = {"reprojection": "reprojection [%]", "mask_iou": "mask IoU", "true_iou": "IoU with the true mask"}


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"count", "photos"})
    photos: Path = PHOTOS
    """Real ones, searched with its subfolders."""
    count: int = 64
    """Synthetic pictures, each of another person."""
    seed: int = 0
    size: int = 384
    """Side of the synthetic pictures [px]."""


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB of sRGB."""
    return cv2.cvtColor(np.float32(rgb).reshape(-1, 1, 3), cv2.COLOR_RGB2Lab).reshape(rgb.shape)


def measure_photo(photo: Photo, side: str | None = None, mask: Tensor | None = None) -> Row:
    """What the estimator makes of a photo, whose true side and mask may be known."""
    row: Row = {"kind": "real" if side is None else "synthetic", "found": False, "fitted": False}
    hands = estimator().find(photo)
    if not hands:
        return row
    row |= {"found": True, "side_right": None if side is None else hands[0].side == side}
    try:
        fit = estimator().fit(photo, hands[0])
    except InputError:
        return row
    row |= {"fitted": True, "reprojection": fit.reprojection, "mask_iou": fit.mask_iou, **region_colors(photo, fit)}
    return row if mask is None else row | {"true_iou": iou(fit.mask > 0.5, mask > 0.5)}


def region_colors(photo: Photo, fit: HandFit) -> Row:
    """Median CIELAB of palm and back, None where too little is seen."""
    hand, left = bundled_hand(), fit.side == "left"
    rest = rest_hand(hand, fit.shape)
    posed = skin(hand, rest, mirror_pose(fit.pose) if left else fit.pose)
    if left:
        posed = posed._replace(vertices=mirror_points(posed.vertices))
    height, width = photo.rgb.shape[:2]
    side = max(height, width)
    square, inside = torch.zeros(side, side, 3), torch.zeros(side, side)
    square[:height, :width], inside[:height, :width] = photo.rgb.float() / 255, fit.mask
    camera = Camera(fit.camera.viewmat, fit.camera.K, side, side)
    # The mirrored surface keeps its winding, so its normals point inwards; observe wants them outwards.
    outwards = replace(hand, faces=hand.faces.flip(1)) if left else hand
    seen = observe(outwards, HandCrop(square, inside, torch.ones_like(inside), camera, rest, posed))
    regions = label_regions(hand)
    skin_only = (seen.confidence > TRUSTED) & (regions.nail < 0.2)
    found = {}
    for name, region in (("palm", regions.palm > 0.85), ("back", regions.palm < 0.15)):
        where = skin_only & region
        enough = int(where.sum()) >= FEWEST
        found[name] = np.median(lab(seen.colors[where].double().numpy()), 0).tolist() if enough else None
    return found


def measure_real(path: Path) -> Row:
    """A real photo."""
    return measure_photo(read_photo(path))


def measure_synthetic(number: int, seed: int, size: int) -> Row:
    """A synthetic picture."""
    batch = render_batch(seed, [number * PICTURES_EACH], size)
    photo = synthetic_photo(batch.image[0], f"synthetic {number}")
    return measure_photo(photo, "left" if int(batch.left[0]) else "right", batch.mask[0])


def run(options: Options) -> list[Row]:
    """Measure both kinds."""
    paths = [path for path in photos_below(options.photos) if "no_hand" not in path.name]
    real = measured("synthetic_photos", {str(path): (path,) for path in paths}, measure_real, options)
    synthetic = {f"synthetic {k}": (k, options.seed, options.size) for k in range(options.count)}
    return real + measured("synthetic_photos", synthetic, measure_synthetic, options)


def lines(rows: list[Row]) -> list[Row]:
    """A line for each measure, a column for each kind."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in ("real", "synthetic")}

    def line(name: str, words) -> Row:
        return {"measure": name, **{kind: words(own) for kind, own in kinds.items() if own}}

    def colors(own: list[Row], region: str) -> str:
        values = np.array([row[region] for row in own if row.get(region)])
        if not len(values):
            return ""
        each = zip("Lab", values.mean(0), values.std(0), strict=True)
        return ", ".join(f"{axis} {middle:.0f} +- {spread:.0f}" for axis, middle, spread in each)

    def share(own: list[Row]) -> str:
        sides = [row["side_right"] for row in own if row.get("side_right") is not None]
        return f"{sum(sides)} of {len(sides)}" if sides else ""

    def spread(own: list[Row], key: str) -> str:
        values = [row[key] for row in own if row.get(key) is not None]
        return "{1:.3g} ({0:.3g} to {2:.3g})".format(*percentiles(values)) if values else ""

    return [
        line("photos", lambda own: str(len(own))),
        line("found", lambda own: str(sum(row["found"] for row in own))),
        line("fitted", lambda own: str(sum(row["fitted"] for row in own))),
        line("side right", share),
        *(line(f"{words}, median (10 to 90 %)", lambda own, k=key: spread(own, k)) for key, words in MEASURES.items()),
        *(line(f"{region}, CIELAB", lambda own, k=region: colors(own, k)) for region in ("palm", "back")),
    ]


COLUMNS = (Column("", "measure"), Column("real", "real"), Column("synthetic (seed 0, 384 px)", "synthetic"))
SECTIONS = (Section("synthetic.md", "photos", table(COLUMNS, lines)),)
