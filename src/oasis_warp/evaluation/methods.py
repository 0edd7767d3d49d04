"""The ways to an avatar that are held against each other: a prior, and how far its guess is fitted to the photo."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch

from oasis_warp.adaptation.adapt import adapt, in_photo
from oasis_warp.adaptation.calibrate import calibrate
from oasis_warp.avatar.pose import in_even_light
from oasis_warp.avatar.prior import MeanPrior, Prior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.heads import ColorHeads
from oasis_warp.network.prior import NetworkPrior, guess_with_heads
from oasis_warp.network.weights_file import trained_state

RAW, CALIBRATED, EVEN, KEEP, ONE_SHOT = "raw", "calibrated", "even_one_shot", "keep_one_shot", "one_shot"
STAGES = (RAW, CALIBRATED, EVEN, KEEP, ONE_SHOT)
"""As the prior says, with its colours matched to the photo's as a whole, adapted to what is likelier skin than light,
adapted to all that the photo shows, its light on the skin, and the same with the light apart, as avatars ship."""


class Method(NamedTuple):
    """What is measured."""

    prior: str
    """"mean" or "learned", or whatever the caller calls his."""
    stage: str
    """One of `STAGES`."""


class Made(NamedTuple):
    """What a method makes of a photo."""

    gaussians: CanonicalGaussians
    """In even light, or in the light that they are drawn in anywhere."""
    light: HandLight | None = None
    """In which they look like the photo, where that is known apart."""

    def without_light(self) -> CanonicalGaussians:
        """As in even light."""
        return self.gaussians if self.light is None else in_even_light(self.gaussians, self.light)


METHODS = (
    Method("mean", CALIBRATED),
    Method("mean", ONE_SHOT),
    Method("learned", RAW),
    Method("learned", CALIBRATED),
    Method("learned", EVEN),
    Method("learned", KEEP),
    Method("learned", ONE_SHOT),
)
"""Of the tables: what needs no training, and each step beyond it."""
BASELINE = METHODS[0]


def label(method: Method) -> str:
    """What to call it."""
    return f"{method.prior} {method.stage.replace('_', '-')}"


def usual_priors(network: HandNetwork | None) -> dict[str, Prior]:
    """The priors of `METHODS`: the mean hand, and the learned one where there is a network."""
    priors: dict[str, Prior] = {"mean": MeanPrior(bundled_hand())}
    if network is not None:
        priors["learned"] = NetworkPrior(network)
    return priors


def prior_digest(prior: Prior) -> str | None:
    """SHA-256 of all that training has changed in a network's prior, names included; None for others."""
    if not isinstance(prior, NetworkPrior):
        return None
    digest = hashlib.sha256()
    for name, tensor in sorted(trained_state(prior.network).items()):
        digest.update(name.encode())
        digest.update(tensor.float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


@torch.no_grad()
def ask(prior: Prior, crop: HandCrop, config: AdaptConfig) -> tuple[CanonicalGaussians, ColorHeads | None]:
    """The guess of `prior`, and its heads where `config` wants to train them.

    Raises:
        InputError: it wants to, and the prior is no network.
    """
    return guess_with_heads(prior, crop) if config.texture == "lora" else (prior(crop), None)


def reconstructions(
    hand: HandModel,
    crop: HandCrop,
    priors: Mapping[str, Prior],
    wanted: Sequence[Method],
    config: AdaptConfig,
) -> Iterator[tuple[Method, Made]]:
    """What every method of `wanted` makes whose prior is there; each prior is asked once.

    Args:
        hand: On the CPU, as in `reconstruction.reconstruct`.
        crop: Of one photo.
        priors: By the names that methods have for them.
        wanted: What to make.
        config: Of the adaptation, whose light the stage decides on but for `ONE_SHOT`.

    Raises:
        InputError: LoRA was asked for, and a prior that is no network.
    """
    for name, prior in priors.items():
        stages = {method.stage for method in wanted if method.prior == name}
        if not stages:
            continue
        guess, heads = ask(prior, crop, config)
        if RAW in stages:
            yield Method(name, RAW), Made(guess)
        if CALIBRATED in stages:
            _, view, trusted = in_photo(hand, guess, crop)
            calibration = calibrate(view, guess.colors, crop.image, trusted, config)
            yield Method(name, CALIBRATED), Made(guess._replace(colors=calibration.apply(guess.colors)))
        for stage, settings in (
            (EVEN, replace(config, light="even")), (KEEP, replace(config, light="keep")), (ONE_SHOT, config)
        ):  # fmt: skip
            if stage in stages:
                adapted = adapt(hand, guess, crop, settings, heads=heads)
                yield Method(name, stage), Made(adapted.gaussians, adapted.light)
