"""The options of the pipeline as frozen dataclasses; the text under a field is its `--help`.

The command line imports this module, so that it must stay free of torch: `oasis --help` answers at once.
"""

from dataclasses import dataclass, replace
from numbers import Integral
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
    texture_steps: int = 56
    """Steps of texture learning, which "even" does without."""
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
    """Hand of the photo to use: its side, the largest, or its rank among the detections (0 is the best)."""
    prior: Literal["learned", "none"] | Path = "learned"
    """Prior used before the fit: the bundled network, mean colours in the photo's skin tone, or your own network.
    Your own network is the network.safetensors of `oasis pretrain`."""
    backbone_weights: Path | None = None
    """DINOv2's model.safetensors, for your own network with the paper's profile."""
    hand_model: Literal["bundled", "mano"] = "bundled"
    """Hand model: the bundled one, or MANO from your own files."""
    mano_dir: Path | None = None
    """Folder with MANO_RIGHT.pkl, for --hand-model mano. Default: the folder in OASIS_MANO_DIR."""
    refine: Literal["on", "off"] = "off"
    """Refine the pose by matching the prior's rendering to the photo."""
    light: Literal["fit", "keep", "even"] = "fit"
    """The photo's light: fit it, so that it stays in place when the hand turns; keep it as part of the skin, with its
    shadows; or remove it as far as possible."""
    adapt: Literal["field", "lora"] = "field"
    """How detail of the photo is learned: a field over the skin, or the paper's LoRA (100 + 400 steps).
    The paper's full method is --adapt lora --light keep --unseen plain."""
    unseen: Literal["painted", "plain"] = "painted"
    """Unseen skin: paint plausible folds, veins and nails (varied by --seed), or keep the prior's smooth colours."""
    steps: int | None = None
    """Steps of texture learning. Default: 56, or 400 for LoRA."""
    seed: int = 0
    """Random seed. The same seed gives the same avatar."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device that computes."""
    size: int | Literal["auto"] = "auto"
    """Side of the crop that the avatar learns from [px], 64 to 1024. auto: the photo's own, within 256 to 1024."""
    force: bool = False
    """Use a fit even if it is too poor."""


@dataclass(frozen=True, kw_only=True)
class EditConfig:
    """How paint on a photo is transferred to an avatar."""

    steps: int = 40
    """Steps of the colour fit. One step does the work of many steps of a plain optimizer."""
    size: int = 1024
    """Largest side of the square around the hand [px]; a larger painted picture is scaled down."""


def adapt_config(config: ReconstructConfig) -> AdaptConfig:
    """How a reconstruction with these options is fitted to its photos."""
    usual = AdaptConfig() if config.adapt == "field" else PAPER_ADAPTATION
    steps = usual.texture_steps if config.steps is None else config.steps
    return replace(usual, light=config.light, texture_steps=steps, seed=config.seed)


def check_config(config: AdaptConfig | ReconstructConfig | EditConfig, flag: str = "") -> None:
    """Check the options of a run before any work; `flag` stands before names in messages: "--" on the command line.

    Raises:
        InputError: a choice that there is not, no integer where one is expected, a size out of range, or a negative
            number of steps or of the hand.
    """
    for name, hint in get_type_hints(type(config)).items():
        value, kinds = getattr(config, name), (hint, *get_args(hint))
        choices = [c for kind in kinds if get_origin(kind) is Literal for c in get_args(kind)]
        wanted = ["an integer"] * (int in kinds) + [repr(choice) for choice in choices]
        integer = int in kinds and isinstance(value, Integral)
        known = integer or value in choices or (value is None and type(None) in kinds)
        if wanted and not known and Path not in kinds:
            raise InputError(f"{flag}{name} {value!r}: expected {' or '.join(wanted)}; choose another value.")
    size = getattr(config, "size", "auto")
    low, high = PAINT_SIDES if isinstance(config, EditConfig) else CROP_SIDES
    if isinstance(size, Integral) and not low <= int(size) <= high:
        raise InputError(f"{flag}size {size}: expected {low} to {high} pixels; choose another size.")
    for name, hint in (
        ("steps", "leave it out for the default"), ("texture_steps", "leave it out for the default"),
        ("calibration_steps", "0 uses the closed form"), ("hand", "0 is the best detection"),
    ):  # fmt: skip
        value = getattr(config, name, None)
        if isinstance(value, Integral) and value < 0:
            raise InputError(f"{flag}{name} {value}: expected 0 or more; {hint}.")


WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)
