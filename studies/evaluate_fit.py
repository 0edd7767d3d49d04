"""Fit every hand of a folder of photos and tabulate how well; or damage the input and count what is noticed.

    python studies/evaluate_fit.py tests/data/photos --out out/fit
    python studies/evaluate_fit.py tests/data/photos --damage --every 3 --out out/fit

The first writes fit.csv and fit.md (the table of docs/estimator.md) and, with --overlays, a picture a hand; where
--drawn names a file of hand-drawn outlines, the mask is compared with them. The second seeds faults into the landmarks
or the cut-out, fits, and writes damage.md: the share of each fault that the fit warns about or refuses.
"""

import argparse
import csv
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from oasis_warp.core.types import HandFit, Landmarks, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.fit_quality import overlap
from oasis_warp.estimation.landmarks import FINGERS, box_size
from oasis_warp.estimation.mirrored_input import array, mirrored_fit, real
from oasis_warp.estimation.silhouette import facing, silhouette, vertex_normals
from oasis_warp.estimation.surface_offsets import outline_offsets
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand

SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
NUMBERS = ("reprojection %", "worst point %", "mask IoU", "IoU with offsets", "IoU of drawn and cut", "cost",
           "find s", "fit s", "offsets s")  # fmt: skip


def photos_below(folder: Path) -> list[Path]:
    """Every photo in `folder` and its subfolders."""
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)


def drawn_masks(path: Path | None) -> dict[str, np.ndarray]:
    """Hand-drawn masks by file name: outer polygons filled, holes cleared."""
    masks = {}
    for entry in json.loads(path.read_text()) if path else []:
        width, height = entry["size"]
        fine = np.zeros((height * 4, width * 4), np.uint8)
        for polygon in entry["polygons"]:
            ((kind, points),) = polygon.items()
            corners = np.round((np.array(points) * 4 - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(fine, [corners], 255 if kind == "outer" else 0, cv2.LINE_8, 4)
        masks[entry["file"]] = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA) > 127
    return masks


def measure(estimator: HandEstimator, path: Path, root: Path, drawn: dict[str, np.ndarray], overlays: Path | None):
    """One row of numbers for each hand of a photo."""
    photo, start = read_photo(path), time.perf_counter()
    found = estimator.find(photo)
    find_time = time.perf_counter() - start
    name = str(path.relative_to(root))
    for k, landmarks in enumerate(found):
        start = time.perf_counter()
        fit = estimator.fit(photo, landmarks, force=True)
        fit_time, start = time.perf_counter() - start, time.perf_counter()
        offsets = outline_offsets(estimator.hand, fit)
        offset_time = time.perf_counter() - start
        covered = covered_with(estimator.rig, fit, array(offsets))
        mask, xy = fit.mask.numpy() > 0.5, array(landmarks.xy)
        truth = drawn.get(name)
        same = math.nan if truth is None else overlap(truth, mask, xy)
        numbers = (fit.reprojection, fit.worst_point, fit.mask_iou, overlap(covered, mask, xy), same, fit.cost,
                   find_time, fit_time, offset_time)  # fmt: skip
        yield {"photo": name, "hand": k, "side": fit.side, "px": round(box_size(xy)),
               **dict(zip(NUMBERS, numbers, strict=True)), "warnings": "; ".join(fit.warnings)}  # fmt: skip
        if overlays:
            picture = overlay(estimator.rig, photo, fit, array(offsets))
            cv2.imwrite(str(overlays / f"{name.replace('/', '_')}_{k}.png"), picture[..., ::-1])


def covered_with(rig: HandKinematics, fit: HandFit, offsets: np.ndarray) -> np.ndarray:
    """Pixels of the photo that the posed hand covers, its rest surface displaced by `offsets`."""
    view = mirrored_fit(rig, fit)
    image = view.state.project(posed(rig, fit, offsets))
    mask = silhouette(image, rig.faces, (fit.camera.width, fit.camera.height)) > 0
    return mask[:, ::-1] if fit.side == "left" else mask


def posed(rig: HandKinematics, fit: HandFit, offsets: np.ndarray) -> np.ndarray:
    """The surface in the (right) hand's frame."""
    view = mirrored_fit(rig, fit)
    rest = rig.rest_surface(view.state.shape) + rig.correctives(view.angles) + offsets
    return rig.pose_surface(rig.chain_of(view.angles, view.state.shape), rest)


def overlay(rig: HandKinematics, photo: Photo, fit: HandFit, offsets: np.ndarray) -> np.ndarray:
    """Photo with the outlines of mask (red) and mesh (blue), and the shaded mesh before and after the offsets, RGB."""
    view, mirrored = mirrored_fit(rig, fit), fit.side == "left"
    rgb = photo.rgb.numpy()[:, ::-1] if mirrored else photo.rgb.numpy()
    low = np.maximum(view.xy.min(0) - 0.15 * box_size(view.xy), 0)
    high = np.minimum(view.xy.max(0) + 0.15 * box_size(view.xy), rgb.shape[1::-1])
    scale = 600 / (high - low)[1]
    affine = np.array([[scale, 0, -low[0] * scale], [0, scale, -low[1] * scale]])
    size = (int((high - low)[0] * scale), 600)
    tiles = [cv2.warpAffine(np.ascontiguousarray(rgb), affine, size, flags=cv2.INTER_CUBIC)]
    edges = [(cv2.warpAffine(view.mask, affine, size) > 0.5, (255, 0, 0))]
    for shift in (np.zeros(3), offsets):
        seen = view.state.in_camera(posed(rig, fit, np.broadcast_to(shift, rig.template.shape)))
        image = (view.state.focal * seen[:, :2] / seen[:, 2:] + view.state.centre - low) * scale
        light = 60 + 190 * np.clip(-vertex_normals(seen, rig.faces) @ np.array([0.3, 0.5, 0.8]), 0, 1)
        tile = np.zeros((*size[::-1], 3), np.uint8)
        faces = facing(image, rig.faces)
        for face in faces[np.argsort(-seen[faces, 2].mean(1))]:
            corners = np.round((image[face] - 0.5) * 16).astype(np.int32)
            cv2.fillConvexPoly(tile, corners, (float(light[face].mean()),) * 3, cv2.LINE_8, 4)
        tiles.append(tile)
        edges.append((silhouette(image, rig.faces, size) > 0, (0, 160, 255)))
    for mask, colour in (edges[0], edges[2]):
        lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(tiles[0], lines, -1, colour, 1)
    return np.hstack(tiles)


# ---- seeded faults: each gives a photo and landmarks that the fit should doubt


def _wrong_side(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator):
    return photo, hand._replace(side="left" if hand.side == "right" else "right")


def _swapped(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator):
    order = list(range(21))
    order[5:9], order[17:21] = order[17:21], order[5:9]
    assert hand.world is not None
    return photo, hand._replace(xy=hand.xy[order], world=hand.world[order])


def _moved(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator, *, world: bool = False,
           first: int = 0):  # fmt: skip
    rows = list(FINGERS.values())[rng.integers(5)][first:]
    angle, xy = rng.uniform(0, 2 * np.pi), array(hand.xy)
    assert hand.world is not None
    points, seen = array(hand.world), xy - xy.mean(0)
    metre = np.sqrt((seen**2).sum() / ((points - points.mean(0))[:, :2] ** 2).sum())
    shift = 0.2 * box_size(xy) * np.array([np.cos(angle), np.sin(angle)])
    share = np.linspace(1 / len(rows), 1, len(rows))[:, None] if first else 1
    xy[rows] += share * shift
    points[rows, :2] += share * shift / metre * world
    return photo, hand._replace(xy=real(xy), world=real(points))


def _moved_with_world(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator):
    return _moved(photo, hand, other, rng, world=True)


def _turned(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator):
    return _moved(photo, hand, other, rng, world=True, first=1)


def _of_other_photo(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator):
    return photo, hand._replace(xy=other.xy, world=other.world)


def _half_cutout(photo: Photo, hand: Landmarks, other: Landmarks, rng: np.random.Generator, mask: np.ndarray):
    angle, xy = rng.uniform(0, 2 * np.pi), array(hand.xy)
    y, x = np.mgrid[0 : mask.shape[0], 0 : mask.shape[1]] + 0.5
    kept = (x - xy[:, 0].mean()) * np.cos(angle) + (y - xy[:, 1].mean()) * np.sin(angle) > 0
    return photo._replace(alpha=real(mask * kept)), hand


FAULTS: dict[str, Callable] = {
    "none": lambda photo, hand, other, rng: (photo, hand),
    "wrong side": _wrong_side,
    "index and little finger swapped": _swapped,
    "a finger moved by 20 % of the hand, 2D": _moved,
    "a finger moved by 20 %, 2D and world": _moved_with_world,
    "a finger turned about its root, its tip by 20 %": _turned,
    "landmarks of another photo": _of_other_photo,
    "half of the cut-out missing": _half_cutout,
}


def noticed(estimator: HandEstimator, paths: list[Path]) -> dict[str, list[tuple[str, ...]]]:
    """For each fault and each hand, the warnings of its fit."""
    rng = np.random.default_rng(0)
    hands = [(photo, hand) for photo in map(read_photo, paths) for hand in estimator.find(photo)[:1]]
    said: dict[str, list[tuple[str, ...]]] = {name: [] for name in FAULTS}
    for k, (photo, hand) in enumerate(hands):
        other = hands[(k + 1) % len(hands)][1]
        right = estimator.fit(photo, hand, force=True)
        said["none"].append(right.warnings)
        for name, fault in FAULTS.items():
            if name != "none":
                mask = {"mask": right.mask.numpy()} if fault is _half_cutout else {}
                given = fault(photo._replace(alpha=None), hand, other, rng, **mask)
                said[name].append(estimator.fit(*given, force=True).warnings)
    return said


def _damage_table(said: dict[str, list[tuple[str, ...]]]) -> str:
    kinds = {"any": "", "fit's numbers": "poor fit", "second look": "second look", "side": "side doubtful"}
    lines = ["| fault | hands | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 2) + "|"]
    for name, rows in said.items():
        shares = (np.mean([any(key in text for text in row) for row in rows]) for key in kinds.values())
        lines.append(f"| {name} | {len(rows)} | " + " | ".join(f"{100 * share:.0f} %" for share in shares) + " |")
    return "\n".join(lines) + "\n"


def _fit_table(rows: list[dict]) -> str:
    lines = ["| | " + " | ".join(NUMBERS) + " |", "|---" * (len(NUMBERS) + 1) + "|"]
    values = np.array([[row[key] for key in NUMBERS] for row in rows], float)
    for name, q in (("10 %", 10), ("median", 50), ("90 %", 90)):
        known = [column[np.isfinite(column)] for column in values.T]
        cells = (f"{np.percentile(column, q):.3g}" if len(column) else "" for column in known)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Read the command line and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder for the tables")
    parser.add_argument("--every", type=int, default=1, help="take every n-th photo")
    parser.add_argument("--overlays", action="store_true", help="write a picture for each hand")
    parser.add_argument("--drawn", type=Path, help="JSON of hand-drawn outlines")
    parser.add_argument("--damage", action="store_true", help="seed faults and count what is noticed")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    estimator, paths = HandEstimator(bundled_hand()), photos_below(args.folder)[:: args.every]
    if args.damage:
        table = _damage_table(noticed(estimator, paths))
        (args.out / "damage.md").write_text(table)
    else:
        overlays = args.out if args.overlays else None
        drawn = drawn_masks(args.drawn)
        rows = [row for path in paths for row in measure(estimator, path, args.folder, drawn, overlays)]
        table = _fit_table(rows)
        (args.out / "fit.md").write_text(table)
        with (args.out / "fit.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    print(table, end="")


if __name__ == "__main__":
    main()
