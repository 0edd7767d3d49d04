"""How far real photos of one hand differ in the tone of one skin beside another: the floor of hidden skin's a*, b*.

`oasis evaluate --dataset same-hand` takes the mean a* and b* of skin that a photo hides, less those of skin that it
shows, and says how far an avatar's are off in another photo of the hand. Here a third photo takes the place of the
avatar. Fills docs/evaluation.md (real-tones).
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from oasis_warp.avatar.observation import observe
from oasis_warp.core.color import cielab
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import choose_hand
from oasis_warp.estimation.fit_problem import array
from oasis_warp.estimation.hand_crop import crop_hand, initial_offsets
from oasis_warp.evaluation.same_hand import MIN_SHARE, photos_of_hands
from oasis_warp.hand.template import bundled_hand
from studies.harness import Row, StudyOptions, measured
from studies.inputs import PHOTOS, estimator
from studies.tables import Column, Section, complete, groups, table

SEEN, HIDDEN = 0.5, 0.05
"""Confidence from which a photo shows a vertex well, and below which it hides it."""
FEWEST = 60
"""Fewest vertices whose mean is compared."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    photos: Path = PHOTOS / "same_hand"
    """Folder with a subfolder of photos for each hand."""


class Tones(NamedTuple):
    """What a photo shows at the vertices."""

    chroma: np.ndarray
    """a* and b*, [V, 2]."""
    confidence: np.ndarray
    """0 where the photo shows nothing, [V]."""


def read_tones(path: Path) -> Tones | None:
    """Colours of the largest hand of a photo at the vertices; None where nothing fits."""
    photo, hand = read_photo(path), bundled_hand()
    try:
        fit = estimator().fit(photo, choose_hand(estimator().find(photo), "largest", photo.name))
    except InputError:
        return None
    seen = observe(hand, crop_hand(photo, fit, initial_offsets(hand, fit), ReconstructConfig()))
    return Tones(array(cielab(seen.colors.clamp(0, 1)))[:, 1:], array(seen.confidence))


def gaps(tones: dict[str, Tones]) -> Iterator[Row]:
    """For a photo that says what is hidden, and two others: the distance of their hidden less seen a* and b*.

    Both means are over the same vertices, weighted by the lesser confidence of the two photos.
    """
    for source, own in tones.items():
        for target, other in itertools.combinations([name for name in tones if name != source], 2):
            weight = np.minimum(tones[target].confidence, tones[other].confidence)
            parts = weight * (own.confidence > SEEN), weight * (own.confidence < HIDDEN)
            if min(part.sum() for part in parts) < max(FEWEST, MIN_SHARE * weight.sum()):
                continue
            a, b = (
                np.subtract(*(np.average(tones[name].chroma, 0, part) for part in parts)) for name in (target, other)
            )
            yield {"source": source, "target": target, "other": other, "gap": float(np.linalg.norm(a - b))}


def measure_hand(paths: list[Path]) -> list[Row]:
    """Rows of all photos of one hand."""
    found = {path.name: read_tones(path) for path in paths}
    return [{"hand": paths[0].parent.name, **row} for row in gaps({k: v for k, v in found.items() if v is not None})]


def run(options: Options) -> list[Row]:
    """Measure every hand."""
    return measured(
        "real_tones", {hand: (paths,) for hand, paths in photos_of_hands(options.photos).items()}, measure_hand, options
    )


def by_hand(rows: list[Row]) -> list[Row]:
    """Quartiles and the worst of each hand and of all."""
    found = complete(rows)
    return [
        {"hand": hand, "triples": len(own), **dict(zip(("25 %", "median", "75 %", "worst"),
            np.percentile([row["gap"] for row in own], (25, 50, 75, 100)), strict=True))}
        for hand, own in [*((hand, own) for (hand,), own in groups(found, "hand").items()), ("all", found)]
    ]  # fmt: skip


SECTIONS = (
    Section("evaluation.md", "real-tones", table(
        (
            Column("hand", "hand"), Column("threes of photos", "triples", "d"),
            *(Column(name, name, ".1f") for name in ("25 %", "median", "75 %", "worst")),
        ),
        by_hand,
    )),
)  # fmt: skip
