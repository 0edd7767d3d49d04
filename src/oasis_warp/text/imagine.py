"""Ask a generator for a picture of a hand until the estimator finds the hand in its pose."""

from pathlib import Path
from typing import NamedTuple

from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.text.conditioning import Conditioning
from oasis_warp.text.generators import Generator

MAX_OFF = 6.0
"""Largest mean distance of the landmarks found from those asked for [% of the longer side of their box]. Neighbouring
knuckles of an open hand are some 12 % apart: from half of that on, a finger may stand in its neighbour's place."""
SQUARE = 0.02
"""Share by which a picture's sides may differ."""


class Imagined(NamedTuple):
    """A picture that shows the hand that was asked for."""

    photo: Photo
    seed: int
    distance: float
    """Mean distance of its landmarks from those asked for [% of the longer side of their box]."""


def imagine(
    generator: Generator, estimator: HandEstimator, conditioning: Conditioning, folder: Path, prompt: str, *,
    seed: int = 0, tries: int = 4, progress: Progress = silent,
) -> Imagined:  # fmt: skip
    """The first picture with this hand in this pose, of the seeds `seed`, `seed` + 1, ...

    Args:
        generator: Of the pictures.
        estimator: Finds the hand in them.
        conditioning: What was asked for.
        folder: With the conditioning's files.
        prompt: The words.
        seed: Of the first picture.
        tries: Number of pictures to ask for.
        progress: Called for every picture.

    Raises:
        InputError: no picture shows that hand; the sentence says what each shows. Or the generator fails.
    """
    reasons = []
    for k in range(tries):
        progress("pictures", k, tries)
        photo = generator(folder, prompt, seed + k)
        found = _distance(estimator, conditioning, photo)
        if isinstance(found, float):
            progress("pictures", tries, tries)
            return Imagined(photo, seed + k, found)
        reasons.append(f"seed {seed + k}: {found}")
    raise InputError(
        f"no picture shows a {conditioning.side} hand in the pose asked for ({'; '.join(reasons)}); "
        "try other words or another --seed, or give the generator's depth more weight."
    )


def _distance(estimator: HandEstimator, conditioning: Conditioning, photo: Photo) -> float | str:
    """How far the landmarks are off [%], or in words why this is not the hand asked for."""
    height, width = photo.rgb.shape[:2]
    if abs(height - width) > SQUARE * width:
        return f"{width} x {height} pixels instead of a square"
    asked = conditioning.landmarks * (width / conditioning.camera.width)
    size = box_size(asked.numpy())
    hands = [hand for hand in estimator.find(photo) if hand.side == conditioning.side]
    if not hands:
        return f"no {conditioning.side} hand found"
    off = min(float((hand.xy - asked).norm(dim=-1).mean()) for hand in hands) / size * 100
    return off if off <= MAX_OFF else f"the landmarks are {off:.0f} % of the hand's size off"
