"""Sums by index that have the same bits on every run, on CUDA too."""

from jaxtyping import Float, Int
from torch import Tensor


def add_at(
    total: Float[Tensor, "N *D"], index: Int[Tensor, "M"], values: Float[Tensor, "M *D"]
) -> Float[Tensor, "N *D"]:
    """`total` with row k of `values` added to its row `index[k]`, for every k.

    `index_add` adds with atomics on CUDA, in any order; `index_put` sorts the rows first.
    """
    if total.is_cuda:
        return total.index_put((index.long(),), values, accumulate=True)
    return total.index_add(0, index, values)
