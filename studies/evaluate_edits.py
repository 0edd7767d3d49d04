"""Measure `edit` on painted hands that are known exactly, and show it on real photos.

    python studies/evaluate_edits.py --out out/edits
    python studies/evaluate_edits.py --out out/edits --sheet docs/_static/edits.jpg
    python studies/evaluate_edits.py --out out/edits_png --png

Writes edits.csv, a row for every drawing and view, and edits.md, the table of docs/editing.md. Each drawing is painted
on the photo of an open palm or back that is drawn from a mesh with known skin, saved as a JPEG (or as it is, with
--png), and found again by its difference from the photo. With --sheet, the same drawings on real photos, too.
"""

import argparse
import csv
import math
import time
from pathlib import Path
from statistics import mean
from typing import Any

import cv2
import numpy as np
import torch
from painted_truth import (
    KINDS,
    Chart,
    Truth,
    draw_truth,
    edited_area,
    make_truth,
    other_views,
    paint_photo,
    photographed,
)

from oasis_warp.cli.summary import GROUND, Panel, make_sheet, panel_side
from oasis_warp.core.camera import crop_camera, orbit_camera
from oasis_warp.core.config import BLACK, ReconstructConfig
from oasis_warp.core.types import Camera, HandPose, Photo
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square
from oasis_warp.editing import edit
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.network.prior import choose_prior

AROUND = 0.002
"""What is edited with the paint: Gaussians are replaced a face beyond it [m]."""
JPEG_QUALITY = 92
SHOWN = (
    ("palm_open_left_02.png", "tattoo"), ("palm_open_left_02.png", "writing"), ("back_flat_right_04.jpg", "ring"),
    ("back_flat_right_04.jpg", "nail polish"),
)  # fmt: skip
"""Photos of tests/data/photos and what is painted on them for the sheet."""
SHOWN_POSES = (("open", 0.5), ("fist", 0.0), ("point", -0.3))
"""And how far the view is turned [rad]."""
SHEET_WIDTH, SHEET_QUALITY, FINER = 1280, 88, 3
COVERED = 0.99
"""Share of a pixel that is hand, from which it is judged: a fringe of background is no matter of the paint."""


def saved(photo: Photo, quality: int) -> Photo:
    """The photo after a JPEG encoder."""
    _, data = cv2.imencode(".jpg", photo.rgb.numpy()[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))
    pixels = cv2.cvtColor(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
    return photo._replace(rgb=torch.from_numpy(pixels), name="painted.jpg")


@torch.no_grad()
def judge(truth: Truth, chart: Chart, edited: Avatar, pose: HandPose, camera: Camera) -> dict[str, float]:
    """PSNR [dB] against the truth: in the paint, around it too, and elsewhere, before and after.

    The truth is lit alike from everywhere, so avatars are drawn in even light but for the photo's view.
    """
    true = draw_truth(truth, chart, pose, camera)
    avatars = [truth.avatar, edited]
    if camera is not truth.camera:
        avatars = [avatar.in_even_light() for avatar in avatars]
    before, after = (avatar.render(camera, pose, BLACK).image for avatar in avatars)
    whole = (true.alpha > COVERED).float()
    area = edited_area(truth, true.paint, camera, AROUND) * whole
    paint = (true.paint > 0).float() * whole
    row = {"pixels": float(paint.sum()), "area_pixels": float(area.sum())}
    for name, mask in (("paint", paint), ("area", area), ("elsewhere", whole * (1 - area))):
        row[f"{name}_before"] = masked_psnr(before, true.image, mask)
        row[f"{name}_after"] = masked_psnr(after, true.image, mask)
    return row


def measure(truth: Truth, kind: str, side: str, quality: int | None) -> list[dict[str, Any]]:
    """A row for the photo's view and each other view."""
    chart = Chart(truth, kind)
    painted = paint_photo(truth, chart)
    painted = painted if quality is None else saved(painted, quality)
    start = time.perf_counter()
    made = edit(truth.avatar, painted, photo=truth.photo)
    seconds = time.perf_counter() - start
    size = truth.camera.width
    views = {"photo": (truth.pose, truth.camera), **other_views(truth, size)}
    return [
        {"drawing": kind, "side": side, "view": name, **judge(truth, chart, made.avatar, pose, camera),
         "new_gaussians": made.measures["new_gaussians"], "painted_mm2": made.measures["painted_mm2"],
         "seconds": seconds} for name, (pose, camera) in views.items()
    ]  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """A line for each drawing: its own view, the others', and what changed elsewhere at most."""
    lines = [
        "| drawing | on the | skin, mm² | new Gaussians | photo's view, dB | other poses, all pixels | mean | worst "
        "| before | paint alone, mean | elsewhere, largest change, dB | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for key in dict.fromkeys((row["drawing"], row["side"]) for row in rows):
        mine = [row for row in rows if (row["drawing"], row["side"]) == key and row["pixels"] > 0]
        others = [row for row in mine if row["view"] != "photo"]
        change = max((row["elsewhere_after"] - row["elsewhere_before"] for row in mine), key=abs)
        own = mine[0]
        cells = [
            *key, f"{own['painted_mm2']:.0f}", f"{own['new_gaussians']:.0f}", f"{own['area_after']:.1f}",
            f"{pooled(others):.1f}", f"{mean(r['area_after'] for r in others):.1f}",
            f"{min(r['area_after'] for r in others):.1f}",
            f"{mean(r['area_before'] for r in others):.1f}", f"{mean(r['paint_after'] for r in others):.1f}",
            f"{change:+.3f}", f"{own['seconds']:.1f}",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def pooled(rows: list[dict[str, Any]]) -> float:
    """PSNR over the paint and around it in all views together [dB]."""
    squares = sum(row["area_pixels"] * 10 ** (-row["area_after"] / 10) for row in rows)
    return -10 * math.log10(squares / sum(row["area_pixels"] for row in rows))


def draw(avatar: Avatar, pose: HandPose, camera: Camera) -> np.ndarray:
    """A picture of the avatar, drawn `FINER` times as large and averaged, as bytes."""
    large = crop_camera(camera, 0.0, 0.0, float(camera.width), FINER * camera.width)
    with torch.no_grad():
        pixels = to_uint8(avatar.render(large, pose, GROUND).image).numpy()
    return cv2.resize(pixels, (camera.width, camera.width), interpolation=cv2.INTER_AREA)


def sheet(photos: Path, out: Path) -> None:
    """A row for each drawing of `SHOWN`: photo, painted photo, the avatar in the same view and in other poses."""
    side, truths, rows = panel_side(3 + len(SHOWN_POSES), SHEET_WIDTH), {}, []
    for name, kind in SHOWN:
        if name not in truths:
            truths[name] = photographed(photos / name)
        truth = truths[name]
        painted = saved(paint_photo(truth, Chart(truth, kind)), JPEG_QUALITY)
        made = edit(truth.avatar, painted, photo=truth.photo)
        source = made.avatar.source_camera
        camera = crop_camera(source, 0.0, 0.0, float(source.width), side)
        row = [
            Panel(to_uint8(resample_square(picture.rgb.float() / 255, *made.square[:3], side)).numpy(), words)
            for picture, words in ((truth.photo, "photo"), (painted, f"painted: {kind}"))
        ]
        row.append(Panel(draw(made.avatar, truth.pose, camera), "avatar"))
        for gesture, azimuth in SHOWN_POSES:
            pose = truth.pose._replace(angles=named_pose(truth.hand, gesture))
            around = orbit_camera(made.avatar.mesh(pose).vertices, azimuth, 0.0, side)
            row.append(Panel(draw(made.avatar, pose, around), gesture))
        rows.append(row)
    title = "Painted on a photo, worn by the avatar"
    pixels = make_sheet(title, "studies/evaluate_edits.py --sheet", rows, SHEET_WIDTH)
    cv2.imwrite(str(out), pixels[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, SHEET_QUALITY))


def main() -> None:
    """Read the command line and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for edits.csv, edits.md and pictures")
    parser.add_argument("--size", type=int, default=640, help="side of the photos [px]")
    parser.add_argument("--quality", type=int, default=JPEG_QUALITY, help="of the painted photo's JPEG")
    parser.add_argument("--png", action="store_true", help="paint on a photo that no JPEG encoder sees again")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--sheet", type=Path, help="picture of edits on real photos to write")
    parser.add_argument("--photos", type=Path, default=Path("tests/data/photos"), help="where those lie")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    hand, prior, rows = bundled_hand(), choose_prior(ReconstructConfig().prior), []
    for side in ("palm", "back"):
        truth = make_truth(hand, prior, back=side == "back", size=arguments.size)
        for kind in arguments.kinds:
            if kind == "nail polish" and side == "palm":  # the nails do not show
                continue
            rows += measure(truth, kind, side, None if arguments.png else arguments.quality)
            print(table(rows[-7:]).splitlines()[-1], flush=True)
    with (arguments.out / "edits.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (arguments.out / "edits.md").write_text(table(rows))
    if arguments.sheet:
        sheet(arguments.photos, arguments.sheet)


if __name__ == "__main__":
    main()
