"""How well hands are fitted to photos and to synthetic pictures, and which faults of its input the fit notices.

Fills docs/estimator.md (fit, faults), docs/results.md (masks, against hand-drawn ones) and docs/synthetic.md (photos:
real ones beside synthetic pictures, both treated alike, with the colours of palm and back as the estimator sees them).
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.observation import observe
from oasis_warp.core.mirror import mirror_points, mirror_pose
from oasis_warp.core.types import Camera, HandCrop, HandFit, Photo, PosedHand
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.surface_offsets import outline_offsets
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map
from oasis_warp.synthetic.picture import render_batch
from oasis_warp.synthetic.shots import PICTURES_EACH
from studies.harness import Row, StudyOptions, measured
from studies.inputs import OUTLINES, PHOTOS, estimator, iou, mask_name, photos_below, read_masks, synthetic_photo
from studies.stress import FAULTS, FaultyInput
from studies.tables import Column, Section, complete, distribution, groups, mean, medians, percent, percentiles, table

MEASURES = (
    Column("reprojection, % of the box", "reprojection", ".2f"),
    Column("worst point, % of the box", "worst_point", ".1f"),
    Column("mesh against mask, IoU above the wrist", "mesh_mask", ".3f"),
    Column("the same after the outline offsets", "moved_mask", ".3f"),
    Column("mask against the hand-drawn ones", "mask_drawn", ".3f"),
)
TRUSTED, FEWEST = 0.8, 150
"""Confidence of a vertex's colour that counts, and vertices of a region that must be seen so well."""
POOR = "poor fit"
"""Begins warnings of a fit that is not forced."""
WARNINGS = {"any warning": "", "the fit's numbers": POOR, "second detection": "a second ", "side": "side doubtful"}
"""Columns of the table of faults, and the words by which their warnings are told."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"parts", "every", "count"})
    photos: Path = PHOTOS
    """Folder of photos; its subfolders are searched, too."""
    drawn: Path = OUTLINES
    """JSON file of hand-drawn outlines."""
    parts: tuple[Literal["fit", "faults", "synthetic"], ...] = ("fit", "faults", "synthetic")
    every: int = 4
    """Every so manieth photo gets faults."""
    count: int = 64
    """Synthetic pictures, each of another person."""
    seed: int = 0
    size: int = 384
    """Side of the synthetic pictures [px]."""


class Fitted(NamedTuple):
    """A fit and the surface that it puts under its photo."""

    fit: HandFit
    offsets: Tensor
    """Offsets of the vertices at rest, onto the outline [m]."""

    def surface(self, moved: bool) -> tuple[PosedHand, PosedHand]:
        """At rest, and in the photo; `moved` onto the outline, or as the model has it."""
        hand, left = bundled_hand(), self.fit.side == "left"
        rest = rest_hand(hand, self.fit.shape)
        rest = rest._replace(vertices=rest.vertices + self.offsets * float(moved))
        posed = skin(hand, rest, mirror_pose(self.fit.pose) if left else self.fit.pose)
        return rest, posed._replace(vertices=mirror_points(posed.vertices)) if left else posed

    def covered(self, moved: bool) -> Tensor:
        """Pixels [H, W] that the surface covers in the photo."""
        camera, vertices = self.fit.camera, self.surface(moved)[1].vertices
        seen = depth_map(vertices, bundled_hand().faces, camera.viewmat, camera.K, camera.width, camera.height)
        return seen.face_ids >= 0


def region_colors(photo: Photo, fitted: Fitted) -> Row:
    """Median CIELAB of palm and back; None where too little is seen."""
    hand, (rest, posed), fit = bundled_hand(), fitted.surface(False), fitted.fit
    height, width = photo.rgb.shape[:2]
    side = max(height, width)
    square, inside = torch.zeros(side, side, 3), torch.zeros(side, side)
    square[:height, :width], inside[:height, :width] = photo.rgb.float() / 255, fit.mask
    camera = Camera(fit.camera.viewmat, fit.camera.K, side, side)
    # The mirrored surface keeps its winding, so its normals point inwards; observe wants them outwards.
    outwards = replace(hand, faces=hand.faces.flip(1)) if fit.side == "left" else hand
    seen = observe(outwards, HandCrop(square, inside, torch.ones_like(inside), camera, rest, posed))
    regions = label_regions(hand)
    skin_only = (seen.confidence > TRUSTED) & (regions.nail < 0.2)
    found = {}
    for name, region in (("palm", regions.palm > 0.85), ("back", regions.palm < 0.15)):
        rgb = seen.colors[skin_only & region].numpy()
        lab = cv2.cvtColor(np.float32(rgb).reshape(-1, 1, 3), cv2.COLOR_RGB2Lab) if len(rgb) >= FEWEST else None
        found[name] = None if lab is None else np.median(lab[:, 0].astype(float), 0).tolist()
    return found


def measure_photo(photo: Photo, kind: str, true: Tensor | None = None, side: str | None = None) -> Iterator[Row]:
    """A row for each hand of a photo, one that says so where none is found; `true` is its mask, where known."""
    start = time.perf_counter()
    hands = estimator().find(photo)
    find_s = time.perf_counter() - start
    if not hands:
        yield {"kind": kind, "photo": photo.name, "found": False}
    for number, landmarks in enumerate(hands):
        start = time.perf_counter()
        fit = estimator().fit(photo, landmarks, force=True)
        fit_s, start = time.perf_counter() - start, time.perf_counter()
        fitted = Fitted(fit, outline_offsets(bundled_hand(), fit))
        offsets_s = time.perf_counter() - start
        xy = fit.landmarks.xy.numpy()
        where = torch.from_numpy(wrist_line(xy).above_mask((fit.camera.width, fit.camera.height)))
        masks = {"mask": fit.mask > 0.5, "mesh": fitted.covered(False), "moved": fitted.covered(True)}
        row = {
            "kind": kind, "photo": Path(photo.name).stem, "hand": number, "found": True, "side": fit.side,
            "side_right": None if side is None else landmarks.side == side, "px": round(box_size(xy)),
            "reprojection": fit.reprojection, "worst_point": fit.worst_point, "mesh_mask": fit.mask_iou,
            "moved_mask": iou(masks["moved"], masks["mask"], where), "cost": fit.cost, "find_s": find_s,
            "fit_s": fit_s, "offsets_s": offsets_s, "warnings": list(fit.warnings), **region_colors(photo, fitted),
        }  # fmt: skip
        if true is not None:
            row |= {f"{name}_drawn": iou(each, true, where) for name, each in masks.items()}
        yield row


def measure_real(path: Path, photos: Path, drawn: Path) -> list[Row]:
    """The hands of a real photo in the folder `photos` or below."""
    name = mask_name(path.relative_to(photos))
    mask = read_masks(drawn).get(name)
    true = None if mask is None else torch.from_numpy(mask) > 0.5
    return [{**row, "photo": name} for row in measure_photo(read_photo(path), "real", true)]


def measure_synthetic(number: int, seed: int, size: int) -> list[Row]:
    """The hand of a synthetic picture."""
    batch = render_batch(seed, [number * PICTURES_EACH], size)
    photo = synthetic_photo(batch.image[0], f"synthetic {number}")
    side = "left" if int(batch.left[0]) else "right"
    return list(measure_photo(photo, "synthetic", side=side))[:1]


def measure_faults(path: Path, other: Path, number: int) -> list[Row]:
    """A row for each fault of the first hand of a photo."""
    photo = read_photo(path)
    hands, others = estimator().find(photo), estimator().find(read_photo(other))
    if not hands or not others:
        return []
    right, rng = estimator().fit(photo, hands[0], force=True), np.random.default_rng(number)
    given = FaultyInput(photo._replace(alpha=None), hands[0], others[0], right.mask.numpy(), rng)
    rows = []
    for name, fault in FAULTS.items():
        fit = right if name == "none" else estimator().fit(*fault(given), force=True)
        rows.append({"fault": name, "warnings": list(fit.warnings)})
    return rows


def run(options: Options) -> list[Row]:
    """Measure every photo."""
    paths, rows = photos_below(options.photos), []
    if "fit" in options.parts:
        cases = {str(path.relative_to(options.photos)): (path, options.photos, options.drawn) for path in paths}
        rows += measured("fit", cases, measure_real, options)
    if "faults" in options.parts:
        some = paths[:: options.every]
        cases = {
            f"faults of {path.relative_to(options.photos)}": (path, some[(k + 1) % len(some)], k)
            for k, path in enumerate(some)
        }
        rows += measured("fit", cases, measure_faults, options)
    if "synthetic" in options.parts:
        cases = {f"synthetic {k}": (k, options.seed, options.size) for k in range(options.count)}
        rows += measured("fit", cases, measure_synthetic, options)
    return rows


def shares(rows: list[Row]) -> list[Row]:
    """Share of fits with a warning of each kind, for each fault."""
    found = []
    for (name,), own in groups([row for row in rows if "fault" in row], "fault").items():
        warned = {
            heading: mean(any(key in text for text in row["warnings"]) for row in own)
            for heading, key in WARNINGS.items()
        }
        found.append({"fault": name, **warned})
    return found


def drawn(rows: list[Row]) -> list[Row]:
    """The photos with hand-drawn masks."""
    return sorted((row for row in rows if "mask_drawn" in row), key=lambda row: row["photo"])


def hands(rows: list[Row], kind: str) -> list[Row]:
    """The rows of fitted hands, real or synthetic."""
    return [row for row in complete(rows) if row.get("kind") == kind and row["found"]]


def beside(rows: list[Row]) -> list[Row]:
    """Real photos beside synthetic ones, a line for each measure."""
    fitted = {kind: own for kind in ("real", "synthetic") if (own := hands(rows, kind))}

    def line(name: str, words: Callable[[list[Row]], str]) -> Row:
        return {"measure": name, **{kind: words(own) for kind, own in fitted.items()}}

    def spread(own: list[Row], key: str) -> str:
        return "{1:.3g} ({0:.3g} to {2:.3g})".format(*percentiles(row[key] for row in own))

    def colors(own: list[Row], region: str) -> str:
        values = np.array([row[region] for row in own if row[region]])
        each = zip("Lab", values.mean(0), values.std(0), strict=True) if len(values) else ()
        return ", ".join(f"{axis} {middle:.0f} +- {around:.0f}" for axis, middle, around in each)

    def plausible(own: list[Row]) -> int:
        return sum(not any(text.startswith(POOR) for text in row["warnings"]) for row in own)

    if len(fitted) < 2:
        return []
    missed = sum(row.get("kind") == "synthetic" and not row["found"] for row in complete(rows))
    return [
        line("hands found", lambda own: str(len(own)) + (f"; {missed} missed" if own is fitted["synthetic"] else "")),
        line("fitted without doubt", lambda own: str(plausible(own))),
        line("side right", lambda own: str(sum(map(bool, (row["side_right"] for row in own))) or "")),
        line("reprojection [%], median (10 to 90 %)", lambda own: spread(own, "reprojection")),
        line("mask IoU, median (10 to 90 %)", lambda own: spread(own, "mesh_mask")),
        *(line(f"{region}, CIELAB", lambda own, k=region: colors(own, k)) for region in ("palm", "back")),
    ]


SECTIONS = (
    Section("estimator.md", "fit", lambda rows: distribution(hands(rows, "real"), MEASURES)),
    Section("estimator.md", "faults", table(
        (Column("fault", "fault"), *(Column(heading, heading, percent) for heading in WARNINGS)), shares
    )),
    Section("results.md", "masks", table(
        (
            Column("photo", "photo"), Column("automatic mask", "mask_drawn", ".3f"),
            Column("fitted mesh", "mesh_drawn", ".3f"), Column("mesh on the outline", "moved_drawn", ".3f"),
            Column("mesh against automatic mask", "moved_mask", ".3f"),
        ),
        drawn, medians,
    )),
    Section("synthetic.md", "photos", table(
        (Column("", "measure"), Column("real", "real"), Column("synthetic (seed 0, 384 px)", "synthetic")), beside
    )),
)  # fmt: skip
