"""How far results are from those of a reference."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor


def relative_error(got: Tensor, exact: Tensor, judged: Bool[Tensor, "..."] | None = None) -> float:
    """Norm of the difference over the norm of `exact`, of the elements that are `judged` (all when None).

    0 where both are 0; inf where only `exact` is.
    """
    got, exact = got.double(), exact.double()
    if judged is not None:
        got, exact = got[judged], exact[judged]
    difference, size = float((got - exact).norm()), float(exact.norm())
    return difference / size if size else (0.0 if difference == 0 else math.inf)


def largest_error(got: Tensor, exact: Tensor) -> float:
    """Largest difference of any element."""
    return float((got.double() - exact.double()).abs().max()) if exact.numel() else 0.0


def most_error(got: Tensor, exact: Tensor, share: float = 0.9999) -> float:
    """Largest error of that share of the pixels of images [C, H, W, D] that have the least."""
    errors = (got.double() - exact.double()).abs().amax(-1).flatten()
    return float(errors.kthvalue(max(1, int(share * len(errors)))).values)


def psnr(got: Tensor, exact: Tensor) -> float:
    """Peak signal-to-noise ratio of images in [0, 1] [dB]; inf for equal ones."""
    mean_square = float((got.double() - exact.double()).square().mean())
    return -10 * math.log10(mean_square) if mean_square else math.inf


def same_bits(ones: Sequence[Tensor], others: Sequence[Tensor]) -> bool:
    """Whether all tensors have the same shapes, types and bits; -0 and 0 differ."""

    def bits(t: Tensor) -> Tensor:
        return t.contiguous().view({1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}[t.element_size()])

    return len(ones) == len(others) and all(
        a.shape == b.shape and a.dtype == b.dtype and torch.equal(bits(a), bits(b))
        for a, b in zip(ones, others, strict=True)
    )
