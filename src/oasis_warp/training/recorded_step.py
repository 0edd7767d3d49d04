"""A step of training as one CUDA graph: thousands of launches, which take Python far longer than the device."""

from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

from oasis_warp.core.types import TrainingBatch
from oasis_warp.ops import watch_overflow

Result = TypeVar("Result")

SLACK = 3.0
"""Times the memory that the last picture needed for its Gaussians, as each hand and pose needs another."""


class RecordedStep(Generic[Result]):
    """A step that was recorded once and is replayed for every batch of the same shapes."""

    def __init__(self, step: Callable[[TrainingBatch], Result], batch: TrainingBatch):
        """Record `step`, which has run before and waits for nothing; nothing is done yet.

        Args:
            step: All of a step, update of the weights included; what it reads besides its batch stays where it is.
            batch: One to take the shapes from.
        """
        self._inputs = TrainingBatch(*(tensor.clone() for tensor in batch))
        self._graph = torch.cuda.CUDAGraph()
        with watch_overflow(SLACK) as self._overflow:
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._result = step(self._inputs)

    def __call__(self, batch: TrainingBatch) -> Result:
        """Do the step; the result's tensors are written over by the next one."""
        torch._foreach_copy_(list[Tensor](self._inputs), list[Tensor](batch))
        self._graph.replay()
        return self._result

    def lacked_memory(self) -> bool:
        """Whether pictures of the last step lack Gaussians, because it met more of them than the recording expects.

        To be asked when the step is done on the device.
        """
        return self._overflow.happened()
