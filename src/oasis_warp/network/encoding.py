"""Sinusoidal encoding of coordinates (Mildenhall et al. 2020)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def encode(x: Float[Tensor, "*batch D"], frequencies: int) -> Float[Tensor, "*batch E"]:
    """Sines and cosines of 2^l pi x for l below `frequencies`; E = 2 D frequencies. Meant for x in [-1, 1]."""
    octaves = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = (x[..., None] * octaves).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
