"""Tabulate what `studies/measure_estimator_errors.py` left in a folder, and make the asset that training draws from.

    python studies/measure_estimator_errors.py out/estimates --count 224
    python studies/write_estimator_errors.py out/estimates --json out/estimator_errors.json

It writes assets/training/estimator_errors.safetensors, the tables between the markers of docs/estimator.md, and the
numbers as JSON. The second table holds found surfaces beside those that training sees: each measured hand once more,
with the error of another one (`pretraining.estimator_errors`), so that none is compared with itself; the third does
so for masks.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose
from oasis_warp.data.output_files import write_file
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.pretraining.estimator_errors import (
    ALIKE,
    MASK_NUMBERS,
    MeasuredErrors,
    cut_at_wrist,
    looks,
    perturb_outline,
    picture_frames,
    simulate_estimate,
    surface_fields,
)
from oasis_warp.pretraining.hand_batch import PosedHands, pose_hands
from oasis_warp.pretraining.training_batch import crop_to_mask, mirror_left_hands
from oasis_warp.synthetic.picture import render_batch
from oasis_warp.synthetic.shots import PICTURES_EACH

BEGIN, END = "<!-- errors -->", "<!-- end of errors -->"
ASSET = Path(__file__).parents[1] / "src" / "oasis_warp" / "assets" / "training" / "estimator_errors.safetensors"
CROP = 256
"""Pixel errors are given in a crop of this side."""
PERCENTILES = (10, 50, 90)
RENDERED = 320
"""Side of the pictures whose masks are made [px]: that of training."""
MARGIN = 0.0015
"""Of visibility, as the network sees it [m]."""
Row = dict[str, Any]
_PARTS = ("angles", "orientation", "translation", "shape", "K")


def read(folder: Path) -> list[Row]:
    """One dictionary a picture."""
    rows = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path, allow_pickle=False) as stored:
            rows.append({name: stored[name] for name in stored.files})
    return rows


class Hands:
    """Fitted pictures, true or found, as batches of right hands."""

    def __init__(self, hand: HandModel, rows: list[Row], which: str):
        parts = {name: torch.from_numpy(np.stack([row[f"{which}_{name}"] for row in rows])).float() for name in _PARTS}
        self.shape, self.angles, self.orientation = parts["shape"], parts["angles"], parts["orientation"]
        self.translation, self.K = parts["translation"], parts["K"]
        self.posed = pose_hands(hand, self.shape, self.angles, self.orientation, self.translation)
        self.focal = self.K[:, 0, 0]
        self.distance = self.posed.landmarks[..., 2].mean(1)


def project(points: Tensor, K: Tensor) -> Tensor:
    """Pixels, [N, P, 2]."""
    return (points @ K.transpose(1, 2))[..., :2] / points[..., 2:]


def turn_vectors(matrices: Tensor) -> Tensor:
    """Axes times angles of rotations."""
    return torch.from_numpy(np.stack([cv2.Rodrigues(m.double().numpy())[0][:, 0] for m in matrices])).float()


def measured_errors(hand: HandModel, true: Hands, found: Hands) -> MeasuredErrors:
    """What training draws from; see the fields of `MeasuredErrors`."""
    frames = picture_frames(true.posed.landmarks)
    metre = (true.distance / true.focal)[:, None, None]
    moved = (project(found.posed.landmarks, found.K) - project(true.posed.landmarks, true.K)) * metre
    turn = turn_vectors(found.orientation @ true.orientation.transpose(1, 2))
    kept = ((true.shape * found.shape).mean(0) / (true.shape**2).mean(0)).clamp(0, 1)
    return MeasuredErrors(
        looks=looks(true.posed.landmarks, frames),
        angles=found.angles - true.angles,
        turn=(frames.hand.transpose(1, 2) @ turn[..., None])[..., 0],
        shape=found.shape - kept * true.shape,
        lens=torch.stack([(found.focal / true.focal).log(), log_size(true, found)], 1),
        place=(frames.landmarks.transpose(2, 3) @ moved[..., None])[..., 0],
        kept=kept,
        **surface_fields(hand),
    )


def log_size(true: Hands, found: Hands) -> Tensor:
    """Logarithm of found over true metres in a pixel at the hand."""
    return ((found.distance / found.focal) / (true.distance / true.focal)).log()


def leave_one_out(hand: HandModel, true: Hands, measured: MeasuredErrors, seed: int) -> tuple[Tensor, Tensor]:
    """Surfaces and cameras of the measured hands, each with the error of another one."""
    choice = torch.randint(ALIKE, (len(true.shape),), generator=torch.Generator().manual_seed(seed))
    surfaces, cameras = [], []
    for k in range(len(choice)):
        others = torch.arange(len(choice)) != k
        rest = measured._replace(**{
            name: getattr(measured, name)[others] for name in ("looks", "angles", "turn", "shape", "lens", "place")
        })  # fmt: skip
        one = slice(k, k + 1)
        made = simulate_estimate(
            hand, PosedHands(*(part[one] for part in true.posed)), true.shape[one], true.angles[one],
            true.orientation[one], true.K[one], rest, choice[one],
        )  # fmt: skip
        surfaces.append(made.posed)
        cameras.append(made.K)
    return torch.cat(surfaces), torch.cat(cameras)


def with_offsets(hand: HandModel, rows: list[Row], found: Hands) -> Tensor:
    """Found surfaces with the outline offsets of `reconstruction.reconstruct`."""
    surfaces = []
    for k, row in enumerate(rows):
        rest = rest_hand(hand, found.shape[k])
        rest = rest._replace(vertices=rest.vertices + torch.from_numpy(row["offsets"]).float())
        pose = HandPose(found.angles[k], found.orientation[k], found.translation[k])
        surfaces.append(skin(hand, rest, pose).vertices)
    return torch.stack(surfaces)


class Surfaces:
    """Surfaces before their cameras, drawn in pictures of `size`."""

    def __init__(self, hand: HandModel, vertices: Tensor, K: Tensor, size: int):
        self.vertices, self.focal, self.pixels = vertices, K[:, 0, 0], project(vertices, K)
        still = torch.eye(4).expand(len(vertices), 4, 4)
        own = torch.arange(vertices.shape[1])
        self.visible = depth_visibility(
            vertices, vertices, hand.faces, K, still, size, size, margin=MARGIN, point_vertices=own, validate=False
        ).visibility > 0.5  # fmt: skip
        self.mask = depth_map(vertices, hand.faces, still, K, size, size, validate=False).face_ids >= 0
        a, b, c = (vertices[:, hand.faces[:, k]] for k in range(3))
        self.normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        depth = vertices[..., 2]
        self.distance = depth.mean(1)
        self.relief = depth - self.distance[:, None]


def iou(a: Tensor, b: Tensor) -> Tensor:
    """Of each pair of masks."""
    return (a & b).flatten(1).sum(1) / (a | b).flatten(1).sum(1)


def compare(true: Surfaces, seen: Surfaces, scale: Tensor) -> dict[str, Tensor]:
    """How far off surfaces are, a number a picture and row; `scale` leads to pixels of a crop."""
    error = (seen.pixels - true.pixels).norm(dim=-1) * scale[:, None]
    shown = error.where(true.visible, torch.nan)
    size = (seen.distance / seen.focal) / (true.distance / true.focal)
    depth = 1e3 * (seen.relief / size[:, None] - true.relief).abs()
    normals = torch.rad2deg(torch.acos((seen.normals * true.normals).sum(-1).clamp(-1, 1)))
    return {
        "vertices in the picture, median of a hand [px]": error.median(1).values,
        "the same, 90 % of a hand [px]": error.quantile(0.9, dim=1),
        "visible vertices, median [px]": shown.nanmedian(1).values,
        "visible vertices, 90 % [px]": shown.nanquantile(0.9, dim=1),
        "outline against the true one, IoU": iou(seen.mask, true.mask),
        "vertices seen or hidden wrongly [%]": 100 * (seen.visible != true.visible).float().mean(1),
        "seen ones that are hidden [%]": 100 * (seen.visible & ~true.visible).sum(1) / seen.visible.sum(1),
        "depth about the middle, median [mm]": depth.median(1).values,
        "depth about the middle, 90 % [mm]": depth.quantile(0.9, dim=1),
        "normals, median [deg]": normals.median(1).values,
    }


def errors_of_parts(true: Hands, found: Hands, scale: Tensor) -> dict[str, Tensor]:
    """Errors of what is estimated, of all pictures and joints."""
    free = found.angles.abs().amax(0) > 0
    angles = torch.rad2deg(found.angles - true.angles)
    turn = torch.rad2deg(turn_vectors(found.orientation @ true.orientation.transpose(1, 2)).norm(dim=1))
    moved = (project(found.posed.landmarks, found.K) - project(true.posed.landmarks, true.K)) * scale[:, None, None]
    middle = moved.mean(1)
    parts = {
        f"{name} of {which} [deg]": angles[:, rows, k][:, free[rows, k]].abs().flatten()
        for which, rows in (("fingers", slice(0, 12)), ("the thumb", slice(12, 15)))
        for k, name in enumerate(("flexion", "abduction", "twist"))
        if bool(free[rows, k].any())
    }
    return parts | {
        "turn of the hand [deg]": turn,
        "middle of the hand in the picture [px]": middle.norm(dim=1),
        "landmarks about it [px]": (moved - middle[:, None]).norm(dim=-1).flatten(),
        "focal length, found over true [%]": 100 * (found.focal / true.focal - 1),
        "metres in a pixel at the hand, found over true [%]": 100 * (log_size(true, found).exp() - 1),
        "shape coefficients": (found.shape - true.shape).abs().flatten(),
    }


class Masks(NamedTuple):
    """True masks and others, in the crops of the latter."""

    true: Tensor
    found: Tensor
    above: Tensor
    """The hand's side of the wrist line."""
    side: Tensor
    """Of the crop, over that of the true mask's."""


def found_masks(rows: list[Row]) -> Masks:
    """Those that the estimator cut."""
    true, found, above = (torch.from_numpy(np.stack([row[name] for row in rows])) > 127
                          for name in ("true_mask", "found_mask", "above"))  # fmt: skip
    return Masks(true, found, above, torch.tensor([float(row["square"][2] / row["true_square"][2]) for row in rows]))


def masks_in_training(hand: HandModel, seed: int, count: int) -> Masks:
    """Those of `training_batch`, of one picture of each person of a world."""
    random = torch.Generator().manual_seed(seed)
    parts = []
    for k in range(count):
        photo = render_batch(seed, [PICTURES_EACH * k], RENDERED)
        _, alpha, mask, orientation, translation, K = mirror_left_hands(photo)
        landmarks = pose_hands(hand, photo.shape, photo.angles, orientation, translation).landmarks
        numbers = torch.randn(1, 1 + MASK_NUMBERS, generator=random)
        made = cut_at_wrist(mask, alpha, landmarks, K, numbers[:, 0])
        crop = crop_to_mask(torch.stack([mask, made], -1), made, K, CROP)
        found = perturb_outline(crop.planes[..., 1], numbers[:, 1:])
        seen = project(landmarks, crop.K)[0].numpy()
        above = torch.from_numpy(wrist_line(seen).above_mask((CROP, CROP)))[None]
        side = crop_to_mask(mask[..., None], mask, K, CROP).K[:, 0, 0] / crop.K[:, 0, 0]
        parts.append(Masks(crop.planes[..., 0] > 0.5, found > 0.5, above, side))
    return Masks(*(torch.cat(part) for part in zip(*parts, strict=True)))


def errors_of_masks(masks: Masks) -> dict[str, Tensor]:
    """Of whole masks, of what is above the wrist line, and of the crops that come from them."""
    true, found, above, side = masks
    hand = (true & above).flatten(1).sum(1)
    return {
        "IoU with the true mask": iou(true, found),
        "the same above the wrist line": iou(true & above, found & above),
        "of the hand above it, left out [%]": 100 * (true & ~found & above).flatten(1).sum(1) / hand,
        "as much of what is not hand, taken in [%]": 100 * (found & ~true & above).flatten(1).sum(1) / hand,
        "side of the crop, over that of the true one [%]": 100 * (side - 1),
    }


def correlations(true: Hands, found: Hands) -> dict[str, float]:
    """Of errors that hang together."""
    angles = (found.angles - true.angles)[:, :12].unflatten(1, (4, 3))[..., 0]
    knuckle, middle, end = (angles[:, :, k].flatten() for k in range(3))
    turn = turn_vectors(found.orientation @ true.orientation.transpose(1, 2))
    bent = angles[:, :, 0].mean(1)
    across = torch.linalg.lstsq(turn, bent[:, None]).solution[:, 0]
    focal = (found.focal / true.focal).log()
    pairs = {
        "flexion of a finger's knuckle and middle joint": (knuckle, middle),
        "flexion of its middle and end joint": (middle, end),
        "flexion of knuckles and the hand's turn": (bent, turn @ across),
        "focal length and size": (focal, log_size(true, found)),
        "focal length and distance": (focal, (found.distance / true.distance).log()),
    }
    return {name: float(torch.corrcoef(torch.stack(pair))[0, 1]) for name, pair in pairs.items()}


def percentiles(values: dict[str, Tensor]) -> dict[str, list[float]]:
    """Of each row's numbers."""
    return {name: [float(x) for x in np.percentile(v.double().numpy(), PERCENTILES)] for name, v in values.items()}


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.3g}"


def table(columns: dict[str, dict[str, list[float]]]) -> str:
    """Rows of percentiles, three for each column."""
    heads = [f"{name} {q} %".strip() for name in columns for q in ("10", "50", "90")]
    lines = ["| | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for name in next(iter(columns.values())):
        cells = [number(value) for column in columns.values() for value in column[name]]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Read the folder, write asset, page and numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--page", type=Path, default=Path("docs/estimator.md"))
    parser.add_argument("--asset", type=Path, default=ASSET)
    parser.add_argument("--masks", type=int, default=64, help="masks of training to compare with")
    parser.add_argument("--seed", type=int, default=7001, help="of the world that they are of")
    options = parser.parse_args()
    torch.set_num_threads(1)
    every, hand = read(options.folder), bundled_hand()
    results = [str(row["result"]).split(":")[0] for row in every]
    rows = [row for row, result in zip(every, results, strict=True) if result == "fitted"]
    size = int(rows[0]["size"])
    true, found = Hands(hand, rows, "true"), Hands(hand, rows, "found")
    measured = measured_errors(hand, true, found)
    of_hand = surface_fields(hand)
    stored = {name: part.half().contiguous() for name, part in measured._asdict().items() if name not in of_hand}
    write_file(options.asset, save(stored))
    scale = CROP / torch.tensor([float(row["square"][2]) for row in rows])
    truth = Surfaces(hand, true.posed.posed, true.K, size)
    seen = {
        "found": Surfaces(hand, with_offsets(hand, rows, found), found.K, size),
        "in training": Surfaces(hand, *leave_one_out(hand, true, measured, 0), size),
    }
    masks = {"found": found_masks(rows), "in training": masks_in_training(hand, options.seed, options.masks)}
    numbers = {
        "pictures": len(every),
        "results": {name: results.count(name) for name in sorted(set(results))},
        "warned": sum(len(row["warnings"]) > 0 for row in rows),
        "parts": percentiles(errors_of_parts(true, found, scale)),
        "masks": {name: percentiles(errors_of_masks(those)) for name, those in masks.items()},
        "correlations": correlations(true, found),
        "surfaces": {name: percentiles(compare(truth, those, scale)) for name, those in seen.items()},
    }
    write_file(options.json, (json.dumps(numbers, indent=1) + "\n").encode())
    outcome = ", ".join(f"{count} {name}" for name, count in numbers["results"].items())
    hang = "; ".join(f"{name} {value:.2f}" for name, value in numbers["correlations"].items())
    text = "\n\n".join([
        f"{len(every)} pictures: {outcome}; {numbers['warned']} fits are warned about. Pixels are those of the "
        f"{CROP} px crop.",
        table({"": numbers["parts"]}),
        f"Correlations: {hang}.",
        "Surfaces, and those that training gives the network:",
        table(numbers["surfaces"]),
        f"Masks, and {options.masks} that training gives it:",
        table(numbers["masks"]),
    ])  # fmt: skip
    head, rest = options.page.read_text().split(BEGIN)
    options.page.write_text(f"{head}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}")
    print(text)


if __name__ == "__main__":
    main()
