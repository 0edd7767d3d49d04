"""How `edit` paints hands that are known exactly, in the photo's view and in others.

Fills docs/editing.md (edits).
"""

import functools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import mean
from typing import ClassVar

import torch

from oasis_warp.core.config import BLACK
from oasis_warp.core.types import Camera, HandPose
from oasis_warp.editing import edit
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import masked_psnr
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import prior_named
from studies.painted_truth import (
    KINDS,
    Chart,
    KnownHand,
    draw_truth,
    edited_area,
    encoded,
    make_truth,
    other_views,
    paint_photo,
)
from studies.tables import Column, Section, groups, table

AROUND = 0.002
"""What is edited with the paint: Gaussians are replaced a face beyond it [m]."""
COVERED = 0.99
"""Share of a pixel that is hand, from which it is judged: the paint does not change a fringe of background."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"drawings"})
    drawings: tuple[str, ...] = KINDS
    size: int = 640
    """Side of the photos [px]."""


@torch.no_grad()
def judge(known: KnownHand, chart: Chart, edited: Avatar, pose: HandPose, camera: Camera) -> Row:
    """PSNR [dB] against the truth: in the paint, around it too, and elsewhere, before and after.

    The truth is lit alike from everywhere, so avatars are drawn in even light but for the photo's view.
    """
    true = draw_truth(known, chart, pose, camera)
    avatars = [known.avatar, edited]
    if camera is not known.camera:
        avatars = [avatar.in_even_light() for avatar in avatars]
    before, after = (avatar.render(camera, pose, BLACK).image for avatar in avatars)
    whole = (true.alpha > COVERED).float()
    area = edited_area(known, true.paint, camera, AROUND) * whole
    paint = (true.paint > 0).float() * whole
    row = {"pixels": float(paint.sum()), "area_pixels": float(area.sum())}
    for name, mask in (("paint", paint), ("area", area), ("elsewhere", whole * (1 - area))):
        row[f"{name}_before"] = masked_psnr(before, true.image, mask)
        row[f"{name}_after"] = masked_psnr(after, true.image, mask)
    return row


@functools.lru_cache(2)
def known_hand(side: str, size: int, prior: str, steps: int | None) -> KnownHand:
    """An open hand seen from one side, and its avatar."""
    return make_truth(bundled_hand(), prior_named(prior), back=side == "back", size=size, steps=steps)


def measure_edit(side: str, drawing: str, options: Options) -> Iterator[Row]:
    """A row for the photo's view and each other view."""
    known = known_hand(side, options.size, options.prior, options.steps)
    chart = Chart(known, drawing)
    painted = paint_photo(known, chart)
    start = time.perf_counter()
    made = edit(known.avatar, encoded(painted), photo=known.photo)
    seconds = time.perf_counter() - start
    views = {"photo": (known.pose, known.camera), **other_views(known, known.camera.width)}
    for view, (pose, camera) in views.items():
        yield {
            "drawing": drawing, "side": side, "view": view,
            **judge(known, chart, made.avatar, pose, camera), "new_gaussians": made.measures["new_gaussians"],
            "painted_mm2": made.measures["painted_mm2"], "seconds": seconds,
        }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure every drawing on either side."""
    cases = {
        f"{drawing} on the {side}": (side, drawing, options)
        for side in ("palm", "back") for drawing in options.drawings
        if (drawing, side) != ("nail polish", "palm")  # where no nails show
    }  # fmt: skip
    return measured("edits", cases, measure_edit, options)


def lines(rows: list[Row]) -> list[Row]:
    """A line for each drawing: its own view, the other views, and what changed elsewhere at most."""
    made = []
    for (drawing, side), views in groups([row for row in rows if row["pixels"] > 0], "drawing", "side").items():
        own, others = views[0], [row for row in views if row["view"] != "photo"]
        squares = sum(row["area_pixels"] * 10 ** (-row["area_after"] / 10) for row in others)
        made.append({
            **own, "drawing": drawing, "side": side,
            "pooled": -10 * math.log10(squares / sum(row["area_pixels"] for row in others)),
            "mean": mean(row["area_after"] for row in others), "worst": min(row["area_after"] for row in others),
            "before": mean(row["area_before"] for row in others), "paint": mean(row["paint_after"] for row in others),
            "change": max((row["elsewhere_after"] - row["elsewhere_before"] for row in views), key=abs),
        })  # fmt: skip
    return made


COLUMNS = (
    Column("drawing", "drawing"), Column("on the", "side"), Column("skin, mm²", "painted_mm2", ".0f"),
    Column("new Gaussians", "new_gaussians", ".0f"), Column("photo's view, dB", "area_after", ".1f"),
    Column("other poses, all pixels", "pooled", ".1f"), Column("mean", "mean", ".1f"), Column("worst", "worst", ".1f"),
    Column("before", "before", ".1f"), Column("paint alone, mean", "paint", ".1f"),
    Column("elsewhere, largest change, dB", "change", "+.3f"), Column("s", "seconds", ".1f"),
)  # fmt: skip
SECTIONS = (Section("editing.md", "edits", table(COLUMNS, lines)),)
