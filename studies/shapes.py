"""How well shapes of hands explain other photos of the same hand: of one photo, of other persons, of the model.

Each photo of tests/data/photos is fitted. Those of a hand with several photos are fitted again with shapes that are
kept as they are, so that pose and camera alone have to explain the photo. Fills docs/estimator.md (shapes).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from oasis_warp.core.types import HandFit
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import choose_hand
from oasis_warp.evaluation.real_hands import real_photos
from studies.harness import Row, StudyOptions, measured
from studies.inputs import PHOTOS, estimator
from studies.tables import Column, Section, complete, groups, mean, table

MODEL, ONE, OTHERS = "the model's mean", "of one other photo of the hand", "mean of other hands"


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    photos: Path = PHOTOS
    """Folder of photos; each of its subfolders shows one hand."""


def fit_photo(path: Path, shape: list[float] | None = None) -> HandFit:
    """The largest hand of a photo, perhaps with a known shape."""
    photo = read_photo(path)
    found = choose_hand(estimator().find(photo), "largest", photo.name)
    return estimator().fit(photo, found, shape=None if shape is None else torch.tensor(shape), force=True)


def measure_own(path: Path, hand: str) -> Row:
    """The shape that a photo says."""
    return {"hand": hand, "photo": path.name, "coefficients": fit_photo(path).shape.tolist()}


def measure_known(path: Path, shapes: dict[str, list[float]]) -> list[Row]:
    """How well a photo is explained with each of these shapes."""
    rows = []
    for name, shape in shapes.items():
        fit = fit_photo(path, shape)
        rows.append({"shape": name, "cost": fit.cost, "mask": fit.mask_iou, "landmarks": fit.reprojection})
    return rows


def known_shapes(own: list[Row]) -> dict[str, dict[str, list[float]]]:
    """Shapes to explain each photo with, by hand and photo, where a hand has several."""
    of_hands = {hand: rows for (hand,), rows in groups(own, "hand").items()}
    means = {hand: np.mean([row["coefficients"] for row in rows], 0) for hand, rows in of_hands.items()}
    found = {}
    for hand, rows in of_hands.items():
        others = np.mean([shape for other, shape in means.items() if other != hand], 0)
        for row, another in zip(rows, [*rows[1:], rows[0]], strict=True):
            shapes = {MODEL: (0 * others).tolist(), ONE: another["coefficients"], OTHERS: others.tolist()}
            if len(rows) > 1:
                found[f"{hand}/{row['photo']}"] = shapes
    return found


def run(options: Options) -> list[Row]:
    """Measure every photo."""
    hands = real_photos(options.photos)
    places = {f"{hand}/{path.name}": (path, hand) for path, hand in hands.items() if "no_hand" not in path.name}
    shapes = known_shapes(measured("shapes", places, measure_own, options))
    cases = {f"{case} with known shapes": (places[case][0], known) for case, known in shapes.items()}
    return measured("shapes", cases, measure_known, options)


def by_shape(rows: list[Row]) -> list[Row]:
    """Means over photos."""
    return [
        {"shape": name, **{key: mean(row[key] for row in own) for key in ("cost", "mask", "landmarks")}}
        for (name,), own in groups([row for row in complete(rows) if "shape" in row], "shape").items()
    ]


SECTIONS = (
    Section("estimator.md", "shapes", table(
        (
            Column("shape that is kept", "shape"), Column("cost of the fit", "cost", ".0f"),
            Column("mesh against mask, IoU", "mask", ".4f"), Column("landmarks, % of the box", "landmarks", ".2f"),
        ),
        by_shape,
    )),
)  # fmt: skip
