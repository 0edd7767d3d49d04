"""Sizes and switches of the network. A profile is a set of sizes; an ablation is one switch away from it."""

from dataclasses import dataclass, fields
from typing import Literal, get_args, get_origin

from oasis_warp.core.errors import shortened
from oasis_warp.ops.checks import check_choice

MOST = {
    "image_size": 1024, "width": 2048, "heads": 64, "n_tokens": 4096, "n_coarse": 16384, "refine_layers": 32,
    "head_width": 4096, "frequencies": 32, "neighborhood": 15,
}  # fmt: skip
"""Largest sizes, a few times the paper's: a weights file is untrusted, and its sizes determine the memory."""
MAX_LETTERS = 80
"""Most letters of a profile's name."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """What the network is made of. The switches are the rows of the paper's ablation tables."""

    profile: str
    """Name of the set of sizes this came from."""
    backbone: Literal["convolutional", "dinov2-small", "dinov2-base", "dinov2-large"]
    """Image encoder: our own, trained with the rest, or a frozen DINOv2 whose weights lie in a file of their own."""
    image_size: int
    """Side to which the photo's crop is resampled for the encoder [px]."""
    width: int
    """Channels of every token."""
    heads: int
    """Heads of every attention; divides `width`."""
    n_tokens: int
    """Visual evidence tokens."""
    n_coarse: int | None
    """Points that attend to each other in the refinement, spread over the surface; all of them when None."""
    refine_layers: int
    """Blocks of the refinement."""
    head_width: int
    """Hidden channels of the Gaussian heads."""
    frequencies: int = 10
    """Octaves of the sinusoidal encoding of template points (L)."""
    neighborhood: int = 5
    """Samples a side round each projection (K), one cell of the feature map apart; odd."""
    vet: Literal["on", "no_aggr", "mlp", "off"] = "on"
    """Visual evidence tokens; one sample a point instead of K x K; an MLP instead of the tokenizer; features as they
    lie in the image."""
    tokenizer: Literal["learned", "literal"] = "learned"
    """Cross-attention with learned projections and several heads, or equation 3 as printed."""
    vpia: Literal["on", "no_bias", "off"] = "on"
    """Visibility-conditioned attention; the same without its bias; joint attention of points and tokens."""
    visibility: Literal["margin", "literal"] = "margin"
    """Equation 4 with a margin, which lets visible points score 1, or as printed."""
    refine: Literal["on", "off"] = "on"
    """Self-attention among the points."""
    fom: Literal["on", "off"] = "on"
    """Gaussians on faces, with features of their own, besides those on vertices."""
    point_evidence: Literal["on", "off"] = "off"
    """Ours, not the paper's: tell each point what the photo shows where it projects, as far as it is visible there."""

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if get_origin(field.type) is Literal:
                check_choice(field.name, value, get_args(field.type))
            elif field.name != "profile" and not (value is None and field.name == "n_coarse"):
                if type(value) is not int or not 1 <= value <= MOST[field.name]:
                    got = shortened(repr(value))
                    raise ValueError(f"{field.name}: expected a whole number from 1 to {MOST[field.name]}, got {got}.")
        if not isinstance(self.profile, str) or len(self.profile) > MAX_LETTERS:
            raise ValueError(f"profile: expected a name, got {shortened(repr(self.profile))}.")
        if self.width % self.heads or self.width // self.heads % 8:
            raise ValueError(
                f"heads: expected a number that splits width {self.width} into multiples of 8, got {self.heads}."
            )
        if self.neighborhood % 2 == 0:
            raise ValueError(f"neighborhood: expected an odd number, got {self.neighborhood}. It has a middle.")


COMPACT = NetworkConfig(
    profile="compact", backbone="convolutional", image_size=256, width=192, heads=4, n_tokens=256, n_coarse=1024,
    refine_layers=2, head_width=128, point_evidence="on",
)  # fmt: skip
"""Ours: small enough to ship and to run on two cores."""
PAPER = NetworkConfig(
    profile="paper", backbone="dinov2-large", image_size=448, width=1024, heads=16, n_tokens=1024, n_coarse=None,
    refine_layers=1, head_width=256,
)  # fmt: skip
"""The paper's sizes, for a GPU: the refinement is quadratic in the number of points."""
PROFILES = {"compact": COMPACT, "paper": PAPER}
