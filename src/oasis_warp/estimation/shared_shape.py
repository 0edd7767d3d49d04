"""One shape for several photos of a hand."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def shared_shape(shapes: Sequence[Float[Tensor, "S"]]) -> Float[Tensor, "S"]:
    """The mean of the shapes that photos of one hand were fitted with, drawn to the mean hand as far as they disagree.

    One photo leaves much of a shape open, and what it leaves open is settled by its landmarks' errors. How large those
    are shows in how far the shapes s_k lie apart: with W the sum of their sample variances the mean m becomes

        m max(0, 1 - W / (K |m|^2)),

    the positive-part shrinkage of James and Stein (1961) with the variance estimated. It leaves photos that agree as
    they are. On synthetic hands and on photos of real ones that were held out, less is left to explain than with any
    photo's own shape, with their mean, or with the information of the fits added up, whose errors are not independent.

    Args:
        shapes: Coefficients [standard deviations], of one photo or more.
    """
    table = torch.stack(list(shapes))
    mean = table.mean(0)
    if len(table) == 1:
        return mean
    noise = table.var(0).sum() / len(table)
    return mean * (1 - noise / mean.square().sum().clamp_min(1e-12)).clamp_min(0)
