"""A function of tensors as one CUDA graph: thousands of launches, which take Python far longer than the device."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from oasis_warp.ops._runtime.pair_counts import watch_overflow

Result = TypeVar("Result")


class Recording(Generic[Result]):
    """A function that was recorded once and is replayed for all inputs of the same shapes."""

    def __init__(self, function: Callable[[Any], Result], inputs: tuple[Tensor, ...], slack: float = 1.5):
        """Record `function`; its work is not done yet.

        Args:
            function: It has run before, which loads kernels, and waits for nothing. What it reads besides its inputs
                stays where it is.
            inputs: A NamedTuple on a CUDA device, to take the shapes from.
            slack: Memory for the Gaussians of a rasterization, over what the last one needed.
        """
        self._inputs = _tuple_like(inputs, [tensor.clone() for tensor in inputs])
        self._graph = torch.cuda.CUDAGraph()
        with watch_overflow(slack) as self._overflow:
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._result = function(self._inputs)

    def __call__(self, inputs: tuple[Tensor, ...]) -> Result:
        """What the function makes of `inputs`; the next call writes over the tensors of its result."""
        torch._foreach_copy_(list[Tensor](self._inputs), list[Tensor](inputs))
        self._graph.replay()
        return self._result

    def lacked_memory(self) -> bool:
        """Whether pictures of the last call lack Gaussians, because there were more than the recording has memory for.

        To be asked when the call is done on the device.
        """
        return self._overflow.happened()


def _tuple_like(inputs: tuple[Tensor, ...], tensors: list[Tensor]) -> Any:
    return type(inputs)(*tensors)  # a NamedTuple of the same kind
