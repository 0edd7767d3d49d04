"""The options of the pipeline as frozen dataclasses; the text under a field is its `--help`.

The command line imports this module, so that it must stay free of torch: `oasis --help` answers at once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

from oasis_warp.core.errors import InputError

CROP_SIDES, PAINT_SIDES = (64, 1024), (64, 4096)
"""Smallest and largest side of a photo's crop, and of a painted one's [px]: fewer show no fingers, more take long."""


@dataclass(frozen=True, kw_only=True)
class AdaptConfig:
    """How an avatar is fitted to one photo. Defaults are the paper's (appendix B) unless a field says otherwise."""

    calibration: Literal["on", "off"] = "on"
    """Match the prior's colours to the photo's as a whole first, or leave them as they are."""
    calibration_steps: int = 0
    """Steps of the paper's calibration after its closed form, which is better without them; the paper takes 100."""
    light: Literal["fit", "keep", "even"] = "fit"
    """Fit the photo's light, which stays where it is when the hand turns, and take over all that the photo shows beyond
    it; take over light and shadows as if they were skin; or only what is likelier skin than light."""
    texture: Literal["field", "lora", "full"] = "field"
    """What learns the photo's detail: a field over the surface, after the seen colours were carried over its rim; or,
    as in the paper, low-rank updates of the heads of a learned prior, from its calibrated guess on; or, as in its
    ablation, all weights of these heads."""
    lora_rank: int = 8
    """Rank of those updates."""
    texture_steps: int | None = None
    """Steps of texture learning, which "even" does without; None stops when the loss is flat, after 400 at most."""
    weight_rgb: float = 10.0
    """Weight of the mean absolute colour difference."""
    weight_ssim: float = 1.0
    """Weight of 1 - SSIM."""
    weight_perceptual: float = 5.0
    """Weight of LPIPS, where a network for it is given."""
    weight_mean: float = 20.0
    """Weight of the difference of the masked mean colours, in calibration."""
    weight_std: float = 1.0
    """Weight of the difference of the masked standard deviations, in calibration."""
    weight_reference: float = 0.25
    """Weight of the reference views, which hold the rest of the hand where the prior put it."""
    reference_views: int = 7
    """Views around the hand, 360 / (n + 1) degrees apart, the photo's own left out."""
    references: Literal["in_turn", "all"] = "in_turn"
    """One reference view a step, by its colour difference and for all of them; or all in every step, by the same
    loss as the photo, as in the paper."""
    seed: int = 0
    """Seed of the order of the reference views, and of LoRA's start."""


PAPER_ADAPTATION = AdaptConfig(
    texture="lora", light="keep", calibration_steps=100, texture_steps=400, references="all", reference_views=7
)
"""One-shot reconstruction as in the paper's appendix B.3; it names no number of reference views."""


@dataclass(frozen=True, kw_only=True)
class ReconstructConfig:
    """From a photo to an avatar."""

    hand: Literal["left", "right", "largest"] | int = "largest"
    """The hand of the photo to use: a side, the largest, or a number from 0 for the best found, 1 for the next."""
    prior: Literal["learned", "none"] | Path = "learned"
    """What to assume of the hand before the photo is fitted: what the bundled network sees in the photo, only mean
    colours in its skin tone, or what your own network sees: network.safetensors of `oasis pretrain`."""
    backbone_weights: Path | None = None
    """DINOv2's model.safetensors, for a network of your own in the paper's profile."""
    hand_model: Literal["bundled", "mano"] = "bundled"
    """The hand that comes with the package, or MANO from your own files."""
    mano_dir: Path | None = None
    """Folder with MANO_RIGHT.pkl, for --hand-model mano; the one that OASIS_MANO_DIR names when not given."""
    refine: Literal["on", "off"] = "off"
    """Move the fitted hand to where what the prior saw in the photo explains it better, and look again; or leave it."""
    light: Literal["fit", "keep", "even"] = "fit"
    """The photo's light: fit it, so that it stays where it is when the hand turns; keep it on the skin, shadows too; or
    leave it out wherever one can tell."""
    adapt: Literal["field", "lora"] = "field"
    """What learns one photo's detail: a field over the skin; or, as in the paper, low-rank updates of the learned prior
    in 100 steps of calibration and 400 of learning (the paper's own also has --light keep --unseen plain)."""
    unseen: Literal["painted", "plain"] = "painted"
    """Skin that no photo shows: paint folds, veins and nails of a plausible person in the tone of the hand, another for
    every seed; or leave the smooth colours of the prior."""
    steps: int | None = None
    """Steps of texture learning; stops by itself when not given."""
    seed: int = 0
    """The same seed gives the same avatar."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute."""
    size: int | Literal["auto"] = "auto"
    """Side of the square crop whose detail the avatar shows [px], 64 to 1024; by itself the photo's own, from 256 to
    1024."""
    force: bool = False
    """Go on with a fit that is too poor to be trusted."""


@dataclass(frozen=True, kw_only=True)
class EditConfig:
    """How a painted photo is brought into an avatar."""

    steps: int = 40
    """Steps of the colours' fit; each is worth many of a plain optimiser's."""
    size: int = 1024
    """Side of the square around the hand above which the painted picture is scaled down [px]."""


def check_config(config: AdaptConfig | ReconstructConfig | EditConfig, flag: str = "") -> None:
    """Check the options of a run before any work; `flag` stands before names in messages: "--" on the command line.

    Raises:
        InputError: a choice that there is not, a size out of range, or a negative number of steps or of the hand.
    """
    for name, hint in get_type_hints(type(config)).items():
        value = getattr(config, name)
        choices = [c for part in (hint, *get_args(hint)) if get_origin(part) is Literal for c in get_args(part)]
        if isinstance(value, str) and choices and Path not in get_args(hint) and value not in choices:
            listed = ", ".join(map(str, choices))
            raise InputError(f"{flag}{name} {value}: expected one of {listed}; choose one of them.")
    size: int | str = getattr(config, "size", "auto")
    low, high = PAINT_SIDES if isinstance(config, EditConfig) else CROP_SIDES
    if isinstance(size, int) and not low <= size <= high:
        raise InputError(f"{flag}size {size}: expected {low} to {high} pixels; choose another size.")
    for name, hint in (
        ("steps", "leave it out for the default"), ("texture_steps", "leave it out to stop by itself"),
        ("calibration_steps", "0 takes the closed form"), ("hand", "0 is the best hand found"),
    ):  # fmt: skip
        value = getattr(config, name, None)
        if isinstance(value, int) and value < 0:
            raise InputError(f"{flag}{name} {value}: expected 0 or more; {hint}.")


WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)
