"""Kernel distance between sets of drawn and of real hands (Binkowski et al. 2018, "KID").

The features are those of the dense network that ships, at four resolutions: the mean of each channel over the pixels of
the hand. Pictures of one hand are alike, so pairs of one group (a person, a photo) are left out of all means, and the
standard error is that of the groups.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp.estimation.pixel_reading import bundled_dense_network
from oasis_warp.network.dense_network import DenseNetwork

LAYERS = ("half", "quarter", "eighth", "sixteenth")
"""The encoder of the dense network at these shares of the picture's side; the last after its self-attention."""
DEGREE = 3
"""Degree of the kernel (x . y / d + 1)^3."""
SUBSETS = 100
"""Halves of the groups that the standard error is taken from."""
MIN_GROUPS = 4
"""Fewest groups on either side of a distance."""
SPREAD_FLOOR = 1e-3
"""Least standard deviation of a channel, over the largest, that it is divided by."""
MAX_SPREADS = 3.0
"""Standard deviations to which channels are clipped: cubed, one odd picture would outweigh all others."""

Features = dict[str, list[float]]
"""Features of one picture, by `LAYERS`."""


class Sample(NamedTuple):
    """Features of one picture and what it is a picture of."""

    group: str
    mostly: Literal["palm", "back"]
    """The side of the hand that it mostly shows."""
    features: Features


class KernelDistance(NamedTuple):
    """A squared maximum mean discrepancy."""

    value: float
    """Unbiased: around 0, and below as often as above, where both crowds are the same."""
    error: float
    """Its standard error."""


@torch.inference_mode()
def hand_features(
    image: Float[Tensor, "S S 3"], mask: Float[Tensor, "S S"], network: DenseNetwork | None = None
) -> Features:
    """What the network makes of a right hand (or of a mirrored left one), averaged over `mask` at each resolution.

    Args:
        image: sRGB; what is not hand has one colour in all pictures that are compared.
        mask: Share of each pixel that is hand.
        network: Another network than the bundled one.
    """
    network = network or bundled_dense_network("cpu")
    # The full size has little more than colours.
    _, *planes = network.encode(image.permute(2, 0, 1)[None].cpu(), torch.full((1, 21, 2), torch.nan))
    found: Features = {}
    for name, plane in zip(LAYERS, planes, strict=True):
        side = len(mask) // plane.shape[-1]
        weight = avg_pool2d(mask.cpu()[None, None], side)
        mean = (plane * weight).sum((0, 2, 3)) / weight.sum().clamp_min(1e-6)
        found[name] = [round(value, 5) for value in mean.tolist()]
    return found


def kernel_distances(
    drawn: Sequence[Sample], real: Sequence[Sample], scale: Sequence[Sample], seed: int = 0, *, subsets: int = SUBSETS
) -> dict[str, KernelDistance]:
    """The distance of two sets in each of `LAYERS`, and in "all": the concatenated features of all layers.

    Args:
        drawn: One crowd.
        real: The other.
        scale: Features that centre and scale the channels by mean and standard deviation: all real hands, so that
            distances can be compared.
        seed: Seed of the subsets.
        subsets: Subsets of `kernel_distance`.

    Raises:
        ValueError: a crowd has fewer than `MIN_GROUPS` groups.
    """
    for name, crowd in (("drawn", drawn), ("real", real)):
        n_groups = len({sample.group for sample in crowd})
        if n_groups < MIN_GROUPS:
            raise ValueError(f"{name}: expected pictures of {MIN_GROUPS} hands or more, got {n_groups}.")
    groups = [[sample.group for sample in crowd] for crowd in (drawn, real)]
    layers = {layer: [_matrix(crowd, layer) for crowd in (drawn, real, scale)] for layer in LAYERS}
    scaled = {layer: _standardised(*three) for layer, three in layers.items()}
    scaled["all"] = tuple(np.concatenate([pair[k] for pair in scaled.values()], 1) for k in range(2))
    return {layer: kernel_distance(x, y, *groups, seed=seed, subsets=subsets) for layer, (x, y) in scaled.items()}


def kernel_distance(
    x: np.ndarray, y: np.ndarray, x_groups: Sequence[str], y_groups: Sequence[str], seed: int = 0, *,
    subsets: int = SUBSETS,
) -> KernelDistance:  # fmt: skip
    """The distance of two sets, [N, D] and [M, D], and its standard error.

    The error is the standard deviation over halves of the groups, drawn without replacement: of halves it is that of
    the whole (the delete-d jackknife of Shao and Wu 1989 with d = n / 2). With no subsets it is NaN.
    """
    names = sorted({*x_groups, *y_groups})
    xs, ys = (np.array([names.index(name) for name in groups]) for groups in (x_groups, y_groups))
    sums = [_sums(_kernel(a, b), i, j, len(names)) for a, b, i, j in ((x, x, xs, xs), (y, y, ys, ys), (x, y, xs, ys))]
    random, found = np.random.default_rng(seed), []
    for _ in range(subsets):
        found.append(_discrepancy(sums, _half(xs, len(names), random), _half(ys, len(names), random)))
    whole = [np.isin(np.arange(len(names)), groups) for groups in (xs, ys)]
    return KernelDistance(_discrepancy(sums, *whole), float(np.std(found)) if found else math.nan)


def _half(groups: np.ndarray, n_groups: int, random: np.random.Generator) -> np.ndarray:
    """Whether each group is in a random half of the groups of a crowd, bool [G]."""
    own = np.unique(groups)
    return np.isin(np.arange(n_groups), random.permutation(own)[: max(2, len(own) // 2)])


def _kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x @ y.T / x.shape[1] + 1) ** DEGREE


def _sums(kernel: np.ndarray, rows: np.ndarray, columns: np.ndarray, n_groups: int) -> np.ndarray:
    """Sums of a kernel over pairs of groups, and numbers of pairs, [2, G, G]; none of a group with itself."""
    a, b = (np.eye(n_groups)[groups] for groups in (rows, columns))
    sums = np.stack([a.T @ kernel @ b, np.outer(a.sum(0), b.sum(0))])
    return sums * (1 - np.eye(n_groups))


def _discrepancy(sums: Sequence[np.ndarray], xs: np.ndarray, ys: np.ndarray) -> float:
    """Mean of the kernel in one crowd and in the other less twice that between them, of the groups that take part."""
    means = []
    for (total, count), a, b in zip(sums, (xs, ys, xs), (xs, ys, ys), strict=True):
        means.append(float(a @ total @ b) / max(float(a @ count @ b), 1.0))
    return means[0] + means[1] - 2 * means[2]


def _matrix(crowd: Sequence[Sample], layer: str) -> np.ndarray:
    return np.array([sample.features[layer] for sample in crowd], np.float64)


def _standardised(x: np.ndarray, y: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    center, spread = scale.mean(0), scale.std(0)
    spread = np.maximum(spread, SPREAD_FLOOR * spread.max())
    first, second = (np.clip((values - center) / spread, -MAX_SPREADS, MAX_SPREADS) for values in (x, y))
    return first, second
