"""Adam for the few tensors that are fitted to a photo."""

from collections.abc import Sequence

import torch
from torch import Tensor

DECAYS = 0.9, 0.999
"""Decay rates of the means of gradients and of their squares, from Kingma and Ba (2015, section 2) as in torch."""
EPSILON = 1e-8


class Adam:
    """Adam (Kingma and Ba 2015, algorithm 1), with the bits of `torch.optim.Adam` on the CPU.

    The first optimiser of torch imports its compiler, 1.7 s of a run that never compiles anything.
    """

    def __init__(self, parameters: Sequence[Tensor], learning_rate: float) -> None:
        self.rate = learning_rate
        """Of the next step."""
        self._count = 0
        self._state = [(p, torch.zeros_like(p), torch.zeros_like(p)) for p in parameters]

    @torch.no_grad()
    def step(self, loss: Tensor) -> None:
        """One step down the gradient of `loss`, a number that depends on every parameter."""
        with torch.autograd.set_multithreading_enabled(False):  # on CUDA another thread takes longer than the kernels
            gradients = torch.autograd.grad(loss, [parameter for parameter, _, _ in self._state])
        self._count += 1
        corrections = [1 - decay**self._count for decay in DECAYS]
        for (parameter, mean, square), gradient in zip(self._state, gradients, strict=True):
            mean.lerp_(gradient, 1 - DECAYS[0])
            square.mul_(DECAYS[1]).addcmul_(gradient, gradient, value=1 - DECAYS[1])
            size = (square.sqrt() / corrections[1] ** 0.5).add_(EPSILON)
            parameter.addcdiv_(mean, size, value=-self.rate / corrections[0])
