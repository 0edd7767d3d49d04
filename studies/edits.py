"""How `edit` paints hands that are known exactly, in the photo's view and in others.

Fills docs/editing.md: "edits", with the painted photo saved as a JPEG, and "edits-png", as it is. `--sheet` draws
docs/_static/edits.jpg instead: the same drawings on real photos.
"""

import functools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import ClassVar, Literal

import cv2
import numpy as np
import torch

from oasis_warp.cli.summary import GROUND, Panel, make_sheet, panel_side
from oasis_warp.core.camera import crop_camera, orbit_camera
from oasis_warp.core.config import BLACK
from oasis_warp.core.types import Camera, HandPose, Photo
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square
from oasis_warp.editing import edit
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import PHOTOS, prior_named
from studies.painted_truth import (
    KINDS,
    Chart,
    KnownHand,
    draw_truth,
    edited_area,
    make_truth,
    other_views,
    paint_photo,
    photographed,
)
from studies.tables import Column, Section, groups, table, write_jpeg

AROUND = 0.002
"""What is edited with the paint: Gaussians are replaced a face beyond it [m]."""
JPEG_QUALITY = 92
SHOWN = (
    ("palm_open_left_02.png", "tattoo"), ("palm_open_left_02.png", "writing"), ("back_flat_right_04.jpg", "ring"),
    ("back_flat_right_04.jpg", "nail polish"),
)  # fmt: skip
"""Photos and what is painted on them for the sheet."""
SHOWN_POSES = (("open", 0.5), ("fist", 0.0), ("point", -0.3))
"""And the azimuth of the view [rad]."""
SHEET_WIDTH, FINER = 1280, 3
COVERED = 0.99
"""Share of a pixel that is hand, from which it is judged: the paint does not change a fringe of background."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"drawings", "encodings", "sheet"})
    drawings: tuple[str, ...] = KINDS
    encodings: tuple[Literal["jpeg", "png"], ...] = ("jpeg", "png")
    """How the painted photo is saved."""
    size: int = 640
    """Side of the photos [px]."""
    sheet: Path | None = None
    """JPEG to draw instead."""


def encoded(photo: Photo, quality: int = JPEG_QUALITY) -> Photo:
    """The photo after a JPEG encoder."""
    _, data = cv2.imencode(".jpg", photo.rgb.numpy()[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))
    pixels = cv2.cvtColor(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
    return photo._replace(rgb=torch.from_numpy(pixels), name="painted.jpg")


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


def measure(side: str, drawing: str, encoding: str, options: Options) -> Iterator[Row]:
    """A row for the photo's view and each other view."""
    known = known_hand(side, options.size, options.prior, options.steps)
    chart = Chart(known, drawing)
    painted = paint_photo(known, chart)
    start = time.perf_counter()
    made = edit(known.avatar, encoded(painted) if encoding == "jpeg" else painted, photo=known.photo)
    seconds = time.perf_counter() - start
    views = {"photo": (known.pose, known.camera), **other_views(known, known.camera.width)}
    for view, (pose, camera) in views.items():
        yield {
            "drawing": drawing, "side": side, "encoding": encoding, "view": view,
            **judge(known, chart, made.avatar, pose, camera), "new_gaussians": made.measures["new_gaussians"],
            "painted_mm2": made.measures["painted_mm2"], "seconds": seconds,
        }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure every drawing on either side, or draw the sheet."""
    if options.sheet is not None:
        draw_sheet(options.sheet)
        return []
    cases = {
        f"{drawing} on the {side}, {encoding}": (side, drawing, encoding, options)
        for side in ("palm", "back") for drawing in options.drawings for encoding in options.encodings
        if (drawing, side) != ("nail polish", "palm")  # where no nails show
    }  # fmt: skip
    return measured("edits", cases, measure, options)


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
SECTIONS = (
    Section("editing.md", "edits", table(COLUMNS, lambda rows: lines([r for r in rows if r["encoding"] == "jpeg"]))),
    Section("editing.md", "edits-png", table(COLUMNS, lambda rows: lines([r for r in rows if r["encoding"] == "png"]))),
)


def picture(avatar: Avatar, pose: HandPose, camera: Camera) -> np.ndarray:
    """A picture of the avatar, drawn `FINER` times as large and averaged, as bytes."""
    large = crop_camera(camera, 0.0, 0.0, float(camera.width), FINER * camera.width)
    with torch.no_grad():
        pixels = to_uint8(avatar.render(large, pose, GROUND).image).numpy()
    return cv2.resize(pixels, (camera.width, camera.width), interpolation=cv2.INTER_AREA)


def draw_sheet(path: Path) -> None:
    """A row for each drawing of `SHOWN`: photo, painted photo, the avatar in the same view and in other poses."""
    side, known, rows = panel_side(3 + len(SHOWN_POSES), SHEET_WIDTH), {}, []
    for name, drawing in SHOWN:
        if name not in known:
            known[name] = photographed(PHOTOS / name)
        hand = known[name]
        painted = encoded(paint_photo(hand, Chart(hand, drawing)))
        made = edit(hand.avatar, painted, photo=hand.photo)
        source = made.avatar.source_camera
        row = [
            Panel(to_uint8(resample_square(picture.rgb.float() / 255, *made.square[:3], side)).numpy(), words)
            for picture, words in ((hand.photo, "photo"), (painted, f"painted: {drawing}"))
        ]
        camera = crop_camera(source, 0.0, 0.0, float(source.width), side)
        row.append(Panel(picture(made.avatar, hand.pose, camera), "avatar"))
        for gesture, azimuth in SHOWN_POSES:
            pose = hand.pose._replace(angles=named_pose(hand.hand, gesture))
            around = orbit_camera(made.avatar.mesh(pose).vertices, azimuth, 0.0, side)
            row.append(Panel(picture(made.avatar, pose, around), gesture))
        rows.append(row)
    write_jpeg(path, make_sheet("Painted on a photo, worn by the avatar", "", rows, SHEET_WIDTH), 88)
