"""How wrong the estimator is on synthetic hands, and the errors that training gives the network after it.

Synthetic pictures are estimated as `reconstruction.reconstruct` does, and what is true is kept beside what was found,
in OUT/estimator_errors/pictures; left hands are kept as the right ones that they are in the mirror. From these come
assets/training/estimator_errors.safetensors (with `--asset`), which training draws from, and docs/estimator.md
(errors): tables of the estimate's parts; of found surfaces beside those that training sees, where each measured hand
comes once more with the error of another one, so that none is compared with itself.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from safetensors.torch import save
from scipy.spatial.transform import Rotation
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose
from oasis_warp.data.output_files import write_file
from oasis_warp.estimation.estimator import choose_hand
from oasis_warp.estimation.hand_crop import crop_side
from oasis_warp.estimation.surface_offsets import outline_offsets
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.pretraining.estimator_errors import (
    ALIKE,
    MeasuredErrors,
    looks,
    picture_frames,
    simulate_estimate,
    surface_fields,
)
from oasis_warp.pretraining.hand_batch import PosedHands, pose_hands
from oasis_warp.synthetic.picture import SyntheticBatch, render_batch
from oasis_warp.synthetic.shots import EVERYBODY, PICTURES_EACH, cached_identity
from studies.harness import ROWS, Row, StudyOptions, measured, read_rows
from studies.inputs import estimator, synthetic_photo
from studies.tables import Section, markdown, percentiles

CROP = 256
"""Side of the crop whose pixels errors are given in [px]."""
MARGIN = 0.0015
"""Margin of visibility, as the network sees it [m]."""
PARTS = ("angles", "orientation", "translation", "shape", "K")
FILES = ("estimator_errors/tables.json",)
OUTCOMES = {
    "a hand found": ("fitted", "refused", "wrong side"),
    "of the right side": ("fitted", "refused"),
    "fitted": ("fitted",),
}
Arrays = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"count", "first", "asset"})
    count: int = 224
    first: int = 0
    """Number of the first picture; several runs may share the work."""
    each: int = 2
    """Pictures of each person."""
    seed: int = 7001
    """Seed of a world that training does not use."""
    size: int = 384
    """Side of the pictures [px]."""
    asset: Path | None = None
    """Where to write the asset that training draws from."""
    threads: int | None = 1


# ---- estimates


def mirrored(values: Arrays, width: int) -> Arrays:
    """Pose and camera of the mirrored picture."""
    mirror, K = np.array([-1.0, 1.0, 1.0]), values["K"].copy()
    K[0, 2] = width - K[0, 2]
    orientation = mirror[:, None] * values["orientation"] * mirror
    return values | {"orientation": orientation, "translation": mirror * values["translation"], "K": K}


def measure_estimate(number: int, options: Options) -> Row:
    """Estimate one picture; writes what is true and what was found."""
    index = PICTURES_EACH * (number // options.each) + number % options.each
    batch = render_batch(options.seed, [index], options.size)
    melanin = cached_identity(options.seed, int(batch.person[0]), EVERYBODY).melanin
    return {"melanin": melanin, **estimate_picture(batch, number, index, options)}


def estimate_picture(batch: SyntheticBatch, number: int, index: int, options: Options) -> Row:
    """`measure_estimate`, but for the person."""
    size = options.size
    side = "left" if int(batch.left[0]) else "right"
    photo = synthetic_photo(batch.image[0], f"picture {index}")
    hands = estimator().find(photo)
    if not hands:
        return {"result": "not found"}
    landmarks = choose_hand(hands, "largest", photo.name)
    if landmarks.side != side:
        return {"result": "wrong side"}
    try:
        fit = estimator().fit(photo, landmarks)
    except InputError:
        return {"result": "refused"}
    true = {name: getattr(batch, name)[0].double().numpy() for name in PARTS}
    estimate = {**fit.pose._asdict(), "shape": fit.shape, "K": fit.camera.K}
    found = {name: tensor.double().numpy() for name, tensor in estimate.items()}
    if side == "left":
        true, found = mirrored(true, size), mirrored(found, size)
    arrays: Arrays = {
        "size": size, "offsets": outline_offsets(bundled_hand(), fit).half().numpy(), "side": crop_side(fit),
        **{f"true_{name}": value for name, value in true.items()},
        **{f"found_{name}": value for name, value in found.items()},
    }  # fmt: skip
    folder = options.out / "estimator_errors" / "pictures"
    folder.mkdir(exist_ok=True)
    np.savez_compressed(folder / f"{number:05d}.npz", **arrays)
    return {"result": "fitted", "picture": f"{number:05d}.npz", "warned": len(fit.warnings) > 0}


# ---- what they say


class Hands:
    """Fitted pictures, true or found, as batches of right hands."""

    def __init__(self, hand: HandModel, rows: list[Arrays], which: str):
        parts = (torch.from_numpy(np.stack([row[f"{which}_{name}"] for row in rows])).float() for name in PARTS)
        self.angles, self.orientation, self.translation, self.shape, self.K = parts
        self.posed = pose_hands(hand, self.shape, self.angles, self.orientation, self.translation)
        self.focal = self.K[:, 0, 0]
        self.distance = self.posed.landmarks[..., 2].mean(1)


def project(points: Tensor, K: Tensor) -> Tensor:
    """Pixels, [N, P, 2]."""
    return (points @ K.transpose(1, 2))[..., :2] / points[..., 2:]


def turn_vectors(matrices: Tensor) -> Tensor:
    """Axes times angles of rotations."""
    return torch.from_numpy(Rotation.from_matrix(matrices.double().numpy()).as_rotvec()).float()


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


def with_offsets(hand: HandModel, rows: list[Arrays], found: Hands) -> Tensor:
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
    """Intersection over union of each pair of masks."""
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
        "landmarks after similarity alignment, mean of a hand [mm]": aligned_errors(true, found),
    }


def aligned_errors(true: Hands, found: Hands) -> Tensor:
    """PA-MPJPE: mean distance of the 21 landmarks after the best rotation, shift and scale [mm], a number a hand."""
    a, b = (hands.posed.landmarks - hands.posed.landmarks.mean(1, keepdim=True) for hands in (found, true))
    u, sizes, vt = torch.linalg.svd(b.transpose(1, 2) @ a)
    signs = torch.ones_like(sizes)
    signs[:, 2] = torch.linalg.det(u @ vt)
    rotation = (u * signs[:, None]) @ vt
    scale = (sizes * signs).sum(1) / a.square().sum((1, 2))
    return 1e3 * (scale[:, None, None] * a @ rotation.transpose(1, 2) - b).norm(dim=-1).mean(1)


def spread(columns: dict[str, dict[str, Tensor]]) -> str:
    """A table of percentiles of measures, three for each column."""
    headings = [f"{name} {share} %".strip() for name in columns for share in (10, 50, 90)]
    lines = [
        [measure, *(format(x, ".3f" if abs(x) < 1 else ".3g") for each in columns.values()
                    for x in percentiles(each[measure].double().tolist()))]
        for measure in next(iter(columns.values()))
    ]  # fmt: skip
    return markdown(["", *headings], lines)


def by_skin(every: list[Row]) -> str:
    """What became of the pictures of the lightest, middle and darkest third of people."""
    rows, thirds = sorted(every, key=lambda row: row["melanin"]), []
    for k, name in enumerate(("lightest third", "middle", "darkest third")):
        own = [row["result"] for row in rows[k * len(rows) // 3 : (k + 1) * len(rows) // 3]]
        shares = {label: sum(result in which for result in own) / len(own) for label, which in OUTCOMES.items()}
        thirds.append([name, str(len(own)), *(f"{100 * share:.1f} %" for share in shares.values())])
    return markdown(["skin", "pictures", *OUTCOMES], thirds)


def text(every: list[Row], rows: list[Arrays], options: Options) -> str:
    """The section; with `--asset` the asset is written, too."""
    hand, size = bundled_hand(), int(rows[0]["size"])
    true, found = Hands(hand, rows, "true"), Hands(hand, rows, "found")
    measured = measured_errors(hand, true, found)
    if options.asset is not None:
        fixed = surface_fields(hand)
        stored = {name: part.half().contiguous() for name, part in measured._asdict().items() if name not in fixed}
        write_file(options.asset, save(stored))
    scale = CROP / torch.tensor([float(row["side"]) for row in rows])
    truth = Surfaces(hand, true.posed.posed, true.K, size)
    surfaces = {
        "found": Surfaces(hand, with_offsets(hand, rows, found), found.K, size),
        "in training": Surfaces(hand, *leave_one_out(hand, true, measured, 0), size),
    }
    results = [row["result"] for row in every]
    outcome = ", ".join(f"{results.count(name)} {name}" for name in sorted(set(results)))
    return "\n\n".join([
        f"{len(every)} pictures: {outcome}; {sum(row.get('warned', False) for row in every)} fits are warned about. "
        f"Pixels are those of the {CROP} px crop.",
        by_skin(every),
        spread({"": errors_of_parts(true, found, scale)}),
        "Surfaces, and those that training gives the network:",
        spread({name: compare(truth, those, scale) for name, those in surfaces.items()}),
    ])  # fmt: skip


def run(options: Options) -> list[Row]:
    """Estimate what is missing, and write the text of the section."""
    numbers = range(options.first, options.first + options.count)
    measured("estimator_errors", {f"picture {k}": (k, options) for k in numbers}, measure_estimate, options)
    folder = options.out / "estimator_errors"
    every, rows = read_rows(folder / ROWS), []
    for row in every:
        if row["result"] == "fitted":
            with np.load(folder / "pictures" / row["picture"], allow_pickle=False) as stored:
                rows.append({name: stored[name] for name in stored.files})
    made = {"text": text(every, rows, options), "commit": every[-1]["commit"]}
    write_file(folder / "tables.json", json.dumps(made).encode())
    return load(options.out)


def load(out: Path) -> list[Row]:
    """The text that the last run has made."""
    path = out / "estimator_errors" / "tables.json"
    return [json.loads(path.read_text())] if path.is_file() else []


SECTIONS = (Section("estimator.md", "errors", lambda rows: rows[0]["text"]),)
