"""A fixed piece of work to measure speed by: what a machine does in its time drifts, ratios to it hardly do."""

from collections.abc import Callable

import torch

MATRIX = 512
COPY_FLOATS = 2**20


def make_yardstick() -> Callable[[], None]:
    """Four products of 512 x 512 float32 matrices and four copies of 4 MiB, on one CPU thread.

    Always on the CPU, whatever is measured beside it.
    """
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(MATRIX, MATRIX, generator=generator) for _ in range(2))
    product = torch.empty_like(a)
    source, target = torch.randn(COPY_FLOATS, generator=generator), torch.empty(COPY_FLOATS)

    def work() -> None:
        for _ in range(4):
            torch.mm(a, b, out=product)
            target.copy_(source)

    return work
