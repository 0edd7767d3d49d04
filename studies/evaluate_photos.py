"""Reconstruct every photo of a folder and tabulate what was measured.

    python studies/evaluate_photos.py tests/data/photos --out out/photos/learned
    python studies/evaluate_photos.py tests/data/photos/same_hand --prior none --pairs --out out/same_hand/none

Writes photos.csv, photos.md (the table of docs/results.md) and a sheet of renders; with --pairs also pairs.csv and
pairs.md, where the folder's subfolders are photos of one hand each: every avatar is drawn as every other photo of
its hand shows it.
"""

import argparse
import csv
import functools
import math
import os
import resource
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation.coverage import coverage
from oasis_warp.evaluation.photo_pairs import compare_pairs
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.reconstruction import crop_hand, reconstruct

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
TILE = 192
LEFT_OUT = (
    "result", "worst_point_percent", "coverage_mean", "warnings", "n_gaussians", "kernels_s", "crop_s"
)  # fmt: skip
"""Columns of the CSV that the short table does not show."""


def photos_below(folder: Path) -> list[Path]:
    """The photos in `folder`, or, when it has none itself, in its subfolders."""
    direct = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    return direct or sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES)


def tiles(avatar: Avatar, photo_crop: torch.Tensor) -> np.ndarray:
    """Photo, render, four sides and two other poses in a row, RGB."""
    pictures = [photo_crop, avatar.render(avatar.source_camera, avatar.source_pose).image]
    vertices = avatar.mesh(avatar.source_pose).vertices
    for k in range(1, 5):
        camera = orbit_camera(vertices, 2 * math.pi * k / 5, size=TILE)
        pictures.append(avatar.render(camera, avatar.source_pose).image)
    for name in ("open", "fist"):
        pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, name))
        pictures.append(avatar.render(orbit_camera(avatar.mesh(pose).vertices, 0.0, size=TILE), pose).image)
    small = [cv2.resize(p.numpy(), (TILE, TILE), interpolation=cv2.INTER_AREA) for p in pictures]
    return (np.hstack(small).clip(0, 1) * 255).astype(np.uint8)


def measure(path: Path, root: Path, out: Path, prior: str, seed: int, size: int | None) -> dict[str, object]:
    """One photo's row; writes its avatar and its strip of pictures."""
    name = path.relative_to(root).with_suffix("").as_posix()
    start = time.perf_counter()
    asked = prior if prior in ("learned", "none") else Path(prior)
    config = ReconstructConfig(prior=asked, seed=seed, size=size or "auto")
    try:
        photo = read_photo(path)
        made = reconstruct(photo, config)
    except InputError as error:
        return {"photo": name, "result": str(error)}
    seconds = time.perf_counter() - start
    shares = coverage(made.avatar)
    crop = crop_hand(photo, made.fit, made.avatar.surface_offsets, config)
    image = crop.image.flip(1) if made.avatar.side == "left" else crop.image
    stem = out / name
    stem.parent.mkdir(parents=True, exist_ok=True)
    made.avatar.save(stem.with_suffix(".safetensors"))
    cv2.imwrite(str(stem.with_suffix(".png")), tiles(made.avatar, image)[..., ::-1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "photo": name,
        "result": "ok",
        "side": made.fit.side,
        **{key: round(value, 3) for key, value in made.errors.items()},
        "coverage_worst": round(float(shares.min()), 4),
        "coverage_mean": round(float(shares.mean()), 4),
        **{f"{stage}_s": round(value, 2) for stage, value in made.stages.items()},
        "total_s": round(seconds, 2),
        "peak_gib": round(peak, 2),
        "warnings": "; ".join(made.warnings),
    }


def measure_pairs(folder: Path, out: Path) -> list[dict[str, object]]:
    """Rows of every ordered pair of photos in `folder`; avatars must lie in `out` already."""
    estimator, photos, avatars = HandEstimator(bundled_hand()), {}, {}
    for path in photos_below(folder):
        photo = read_photo(path)
        photos[path.stem] = photo, choose_hand(estimator.find(photo), "largest", photo.name)
        if (file := (out / folder.name / path.stem).with_suffix(".safetensors")).exists():
            avatars[path.stem] = {"avatar": Avatar.load(file)}
    rows = []
    for pair in compare_pairs(estimator, photos, avatars, ReconstructConfig()):
        score = pair.scores["avatar"]
        rows.append(
            {
                "source": f"{folder.name}/{pair.source}",
                "target": f"{folder.name}/{pair.target}",
                "psnr_db": round(score.psnr, 2),
                "psnr_plain_db": round(score.psnr_plain, 2),
                "overlap": round(score.overlap, 3),
                **{f"error_{name}": round(value, 4) for name, value in score.region_errors.items()},
            }
        )
    return rows


def write_table(rows: list[dict[str, object]], stem: Path, leave_out: Iterable[str] = ()) -> None:
    """`stem`.csv with every column and `stem`.md with medians at the foot."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with stem.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    shown = [column for column in columns if column not in leave_out]
    lines = ["| " + " | ".join(shown) + " |", "|" + "---|" * len(shown)]
    lines += ["| " + " | ".join(str(row.get(column, "")) for column in shown) + " |" for row in rows]
    foot: dict[str, dict[str, str]] = {"median": {}, "10 %": {}, "90 %": {}}
    for column in shown:
        values = [float(row[column]) for row in rows if isinstance(row.get(column), int | float)]
        if values:
            for label, share in (("median", 50), ("10 %", 10), ("90 %", 90)):
                foot[label][column] = f"{np.percentile(values, share):.4g}"
    for label, row in foot.items():
        lines.append("| " + " | ".join([f"**{label}**", *(row.get(column, "") for column in shown[1:])]) + " |")
    stem.with_suffix(".md").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Run the evaluation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pairs", action="store_true", help="compare photos of one hand with each other")
    parser.add_argument("--prior", default="learned", help="learned, none or a weights file")
    parser.add_argument("--jobs", type=int, default=1, help="photos at a time; timings hold for 1 only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, help="side of the crop that is shown [px]; the photo's own if not given")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // options.jobs)
    with ProcessPoolExecutor(options.jobs, initializer=torch.set_num_threads, initargs=(threads,)) as pool:
        paths = photos_below(options.folder)
        row_of = functools.partial(
            measure, root=options.folder, out=options.out, prior=options.prior, seed=options.seed, size=options.size
        )
        rows = list(pool.map(row_of, paths))
        write_table(rows, options.out / "photos", leave_out=LEFT_OUT)
        strips = [cv2.imread(str((options.out / str(row["photo"])).with_suffix(".png"))) for row in rows
                  if row["result"] == "ok"]  # fmt: skip
        if strips:
            cv2.imwrite(str(options.out / "sheet.png"), np.vstack(strips))
        if options.pairs:
            folders = sorted({path.parent for path in paths})
            pairs = [row for part in pool.map(measure_pairs, folders, [options.out] * len(folders)) for row in part]
            write_table(pairs, options.out / "pairs")


if __name__ == "__main__":
    main()
