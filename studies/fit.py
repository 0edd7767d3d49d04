"""How well hands are fitted to photos, against hand-drawn masks too, and which faults of its input the fit notices.

Fills docs/estimator.md (fit, faults) and docs/results.md (masks).
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.mirror import mirror_points, mirror_pose
from oasis_warp.core.types import HandFit
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.surface_offsets import outline_offsets
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map
from studies.damage import FAULTS, FaultyInput
from studies.harness import Row, StudyOptions, measured
from studies.inputs import OUTLINES, PHOTOS, estimator, iou, photos_below, read_masks
from studies.tables import Column, Section, complete, distribution, groups, mean, medians, percent, table

MEASURES = (
    Column("reprojection, % of the box", "reprojection", ".2f"),
    Column("worst point, % of the box", "worst_point", ".1f"),
    Column("mesh against mask, IoU above the wrist", "mesh_mask", ".3f"),
    Column("the same after the outline offsets", "moved_mask", ".3f"),
    Column("mask against ten hand-drawn ones", "mask_drawn", ".3f"),
)
WARNINGS = {"any warning": "", "the fit's numbers": "poor fit", "second look": "second look", "side": "side doubtful"}
"""Columns of the table of faults, and the words by which their warnings are told."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"parts", "every"})
    photos: Path = PHOTOS
    """Folder of photos; its subfolders are searched, too."""
    drawn: Path = OUTLINES
    """JSON file of hand-drawn outlines."""
    parts: tuple[Literal["fit", "faults"], ...] = ("fit", "faults")
    every: int = 4
    """Every so manieth photo gets faults."""


def surface_mask(fit: HandFit, offsets: Tensor) -> Tensor:
    """Pixels [H, W] that the fitted surface covers in the photo."""
    hand, left, camera = bundled_hand(), fit.side == "left", fit.camera
    rest = rest_hand(hand, fit.shape)
    rest = rest._replace(vertices=rest.vertices + offsets)
    vertices = skin(hand, rest, mirror_pose(fit.pose) if left else fit.pose).vertices
    vertices = mirror_points(vertices) if left else vertices
    return depth_map(vertices, hand.faces, camera.viewmat, camera.K, camera.width, camera.height).face_ids >= 0


def measure(path: Path, drawn: Path) -> Iterator[Row]:
    """A row for each hand of a photo."""
    photo, start = read_photo(path), time.perf_counter()
    found = estimator().find(photo)
    find_s = time.perf_counter() - start
    truth = read_masks(drawn).get(path.stem) if "same_hand" not in path.parts else None
    for number, landmarks in enumerate(found):
        start = time.perf_counter()
        fit = estimator().fit(photo, landmarks, force=True)
        fit_s, start = time.perf_counter() - start, time.perf_counter()
        offsets = outline_offsets(bundled_hand(), fit)
        offsets_s = time.perf_counter() - start
        xy = fit.landmarks.xy.numpy()
        where = torch.from_numpy(wrist_line(xy).above_mask((fit.camera.width, fit.camera.height)))
        mask, mesh, moved = fit.mask > 0.5, surface_mask(fit, torch.zeros_like(offsets)), surface_mask(fit, offsets)
        row = {
            "photo": path.stem, "hand": number, "side": fit.side, "px": round(box_size(xy)),
            "reprojection": fit.reprojection, "worst_point": fit.worst_point, "mesh_mask": fit.mask_iou,
            "moved_mask": iou(moved, mask, where), "cost": fit.cost, "find_s": find_s, "fit_s": fit_s,
            "offsets_s": offsets_s, "warnings": list(fit.warnings),
        }  # fmt: skip
        if truth is not None:
            true = torch.from_numpy(truth) > 0.5
            masks = {"mask": mask, "mesh": mesh, "moved": moved}
            row |= {f"{name}_drawn": iou(each, true, where) for name, each in masks.items()}
        yield row


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
        cases = {str(path.relative_to(options.photos)): (path, options.drawn) for path in paths}
        rows += measured("fit", cases, measure, options)
    if "faults" in options.parts:
        some = paths[:: options.every]
        cases = {
            f"faults of {path.relative_to(options.photos)}": (path, some[(k + 1) % len(some)], k)
            for k, path in enumerate(some)
        }
        rows += measured("fit", cases, measure_faults, options)
    return rows


def shares(rows: list[Row]) -> list[Row]:
    """Of each fault, the share of fits with a warning of each kind."""
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


SECTIONS = (
    Section("estimator.md", "fit", lambda rows: distribution(complete(rows), MEASURES)),
    Section("estimator.md", "faults", table(
        (Column("fault", "fault"), *(Column(heading, percent(heading)) for heading in WARNINGS)), shares
    )),
    Section("results.md", "masks", table(
        (
            Column("photo", "photo"), Column("automatic mask", "mask_drawn", ".3f"),
            Column("fitted mesh", "mesh_drawn", ".3f"), Column("mesh on the outline", "moved_drawn", ".3f"),
            Column("mesh against automatic mask", "moved_mask", ".3f"),
        ),
        drawn, medians,
    )),
)  # fmt: skip
