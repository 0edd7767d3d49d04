"""The ways to an avatar that are held against each other."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import torch

from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, Evidence
from oasis_warp.training.adapt import adapt

Method = Literal["mean_calibrated", "mean_one_shot", "learned_raw", "learned_calibrated", "learned_one_shot"]
METHODS: dict[Method, str] = {
    "mean_calibrated": "mean texture, colour-matched to the photo",
    "mean_one_shot": "one-shot without a learned prior",
    "learned_raw": "learned prior without adaptation",
    "learned_calibrated": "learned prior, colour-matched to the photo",
    "learned_one_shot": "one-shot with the learned prior",
}
"""And what they are. The first part of a name is the prior's."""
BASELINE: Method = "mean_calibrated"


def reconstructions(
    hand: HandModel,
    evidence: Evidence,
    priors: Mapping[str, Prior],
    wanted: Sequence[Method],
    config: AdaptConfig,
) -> Iterator[tuple[Method, CanonicalGaussians]]:
    """The Gaussians of every method of `wanted` whose prior is there, each prior asked and fitted once.

    Args:
        hand: On the CPU, as in `pipeline.reconstruct`.
        evidence: Of one photo.
        priors: "mean", "learned" or both.
        wanted: What to make.
        config: Of the adaptation.
    """
    for name, prior in priors.items():
        mine = {method.removeprefix(f"{name}_"): method for method in wanted if method.startswith(f"{name}_")}
        if not mine:
            continue
        with torch.no_grad():
            guess = prior(evidence)
        if "raw" in mine:
            yield mine["raw"], guess
        if not {"calibrated", "one_shot"} & mine.keys():
            continue
        if "one_shot" not in mine:
            config = replace(config, texture_steps=0, reference_views=0)
        adapted = adapt(hand, guess, evidence, config)
        if "calibrated" in mine:
            yield mine["calibrated"], guess._replace(colors=adapted.calibration.apply(guess.colors))
        if "one_shot" in mine:
            yield mine["one_shot"], adapted.gaussians
