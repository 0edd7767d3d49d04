"""The methods that evaluations compare: a prior, and how far its guess is fitted to the photo."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.adaptation.fine_skin import cut_skin
from oasis_warp.adaptation.prior_guess import calibrate
from oasis_warp.adaptation.unlit import view_in_photo
from oasis_warp.adaptation.unseen_skin import paint_unseen
from oasis_warp.avatar.pose import in_even_light
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandLight
from oasis_warp.network.heads import ColorHeads
from oasis_warp.network.prior import NetworkPrior, guess_with_heads
from oasis_warp.network.weights_file import trained_state

RAW, CALIBRATED, EVEN, KEEP, ONE_SHOT = "raw", "calibrated", "even_one_shot", "keep_one_shot", "one_shot"
PAINTED = "painted"
STAGES = (RAW, CALIBRATED, EVEN, KEEP, ONE_SHOT, PAINTED)
"""The prior's guess; its colours matched to the photo's as a whole; adapted to what is likelier albedo than shading;
adapted to all that the photo shows, with its light baked in; the same with the light apart; and with painted unseen
skin. `reconstruct` goes on from there: see `reconstruction._finish`."""


class Method(NamedTuple):
    """A prior and a stage."""

    prior: str
    """"mean", "learned", or another name of the caller's."""
    stage: str
    """One of `STAGES`."""


class LitGaussians(NamedTuple):
    """Gaussians that a method makes of a photo, and their light."""

    gaussians: CanonicalGaussians
    """In even light, or with their light baked in."""
    light: HandLight | None = None
    """The photo's light, where it is known apart."""

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
"""Methods of the tables."""
BASELINE = METHODS[0]


def method_name(method: Method) -> str:
    """The method's name in tables."""
    return f"{method.prior} {method.stage.replace('_', '-')}"


def prior_digest(prior: Prior) -> str | None:
    """SHA-256 of the trained parameters and their names in a network's prior; None for other priors."""
    if not isinstance(prior, NetworkPrior):
        return None
    digest = hashlib.sha256()
    for name, tensor in sorted(trained_state(prior.network).items()):
        digest.update(name.encode())
        digest.update(tensor.float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


@torch.no_grad()
def prior_guess(prior: Prior, crop: HandCrop, config: AdaptConfig) -> tuple[CanonicalGaussians, ColorHeads | None]:
    """The guess of `prior`, and its heads where `config` trains them.

    Raises:
        InputError: the heads are to be trained, and the prior is no network.
    """
    return guess_with_heads(prior, crop) if config.texture != "field" else (prior(crop), None)


def reconstructions(
    hand: HandModel,
    crop: HandCrop,
    priors: Mapping[str, Prior],
    methods: Sequence[Method],
    config: AdaptConfig,
    perceptual: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor] | None = None,
) -> Iterator[tuple[Method, LitGaussians]]:
    """The result of each of `methods` whose prior is given; each prior guesses once.

    Args:
        hand: On the CPU, as in `reconstruction.reconstruct`.
        crop: Crop of one photo.
        priors: By the names that methods have for them.
        methods: Methods to run.
        config: Options of the adaptation; stages other than `ONE_SHOT` replace its light.
        perceptual: LPIPS, where the paper's way of adaptation is asked for.

    Raises:
        InputError: the texture is LoRA, and a prior is no network.
    """
    for name, prior in priors.items():
        stages = {method.stage for method in methods if method.prior == name}
        if not stages:
            continue
        guess, heads = prior_guess(prior, crop, config)
        if RAW in stages:
            yield Method(name, RAW), LitGaussians(guess)
        if CALIBRATED in stages:
            _, view, trusted = view_in_photo(hand, guess, crop)
            calibration = calibrate(view, guess.colors, crop.image, trusted, config)
            yield Method(name, CALIBRATED), LitGaussians(guess._replace(colors=calibration.apply(guess.colors)))
        for stage, settings in ((EVEN, replace(config, light="even")), (KEEP, replace(config, light="keep"))):
            if stage in stages:
                adapted = adapt(hand, [guess], [crop], settings, heads=heads, perceptual=perceptual)
                yield Method(name, stage), LitGaussians(adapted.gaussians, adapted.light)
        if stages & {ONE_SHOT, PAINTED}:
            adapted = adapt(hand, [guess], [crop], config, heads=heads, perceptual=perceptual)
            if ONE_SHOT in stages:
                yield Method(name, ONE_SHOT), LitGaussians(adapted.gaussians, adapted.light)
            if PAINTED in stages:
                fine = cut_skin(hand, adapted.gaussians, [crop], adapted.trusted.confidence.amax(0))
                painted = paint_unseen(hand, fine, adapted.guess, crop, adapted.trusted, seed=config.seed)
                yield Method(name, PAINTED), LitGaussians(painted.gaussians, adapted.light)
