"""The same bits every time, and for any number of threads."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from oasis_warp.certify.case import Case
from oasis_warp.certify.compare import Measurement
from oasis_warp.certify.families import Family

THREADS = (1, 2, 3)


@contextmanager
def threads(n: int) -> Iterator[None]:
    """Have torch, and so our CPU launches, use `n` threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def everything(family: Family, case: Case, device: torch.device, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Outputs and gradients of one call, as they come."""
    arguments = case.arguments(dtype, device)
    answer = family.call(arguments)
    outputs = [out for out in answer if isinstance(out, Tensor)]
    inputs = [arguments[name] for name in case.wanted]
    draw = torch.Generator().manual_seed(case.seed)
    losses = [
        (out * torch.randn(out.shape, generator=draw, dtype=torch.float64).to(out)).sum()
        for out in outputs
        if out.requires_grad
    ]
    gradients = torch.autograd.grad(torch.stack(losses).sum(), inputs, allow_unused=True) if losses else ()
    return [*(out.detach() for out in outputs), *(g for g in gradients if g is not None)]


def differing(
    family: Family, case: Case, device: torch.device, repeats: int, n_threads: Sequence[int] = THREADS
) -> list[Measurement]:
    """How many of `repeats` runs differ from the first in any bit, apart for one thread and for other numbers."""
    with threads(n_threads[0]):
        first = everything(family, case, device)
    found = []
    for n in n_threads:
        with threads(n):
            runs = (everything(family, case, device) for _ in range(repeats))
            wrong = sum(not all(map(same_bits, first, run)) for run in runs)
        check = "repeats with other bits" if n == n_threads[0] else "thread counts with other bits"
        found.append(Measurement(family.name, check, f"{case}: {repeats} runs on {n} threads", float(wrong), 0.0))
    return found


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Equal, NaN and infinities included."""
    return torch.equal(a, b) or (a.shape == b.shape and a.cpu().numpy().tobytes() == b.cpu().numpy().tobytes())
