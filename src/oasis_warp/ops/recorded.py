"""The rasterizer for pictures of one size as two CUDA graphs, one forward and one back, under torch's autograd.

An eager call is Python and a dozen launches, which take the host far longer than the pictures take the device. Here a
call copies its arguments to where the graphs read them and replays.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_warp.ops._runtime.launch import current_stream, wait_for
from oasis_warp.ops._runtime.pair_counts import watch_overflow
from oasis_warp.ops.rasterization import rasterization

WARM_UPS = 2
"""Eager calls before a recording: they load kernels, and count the pairs that it takes memory for."""


class _Recording:
    """Both graphs for arguments like these."""

    def __init__(self, arguments: tuple[Tensor, ...], width: int, height: int, options: dict[str, Any]) -> None:
        device = arguments[0].device
        self.needs = [tensor.requires_grad for tensor in arguments]
        self.inputs = [tensor.detach().clone().requires_grad_(tensor.requires_grad) for tensor in arguments]
        self._leaves = [tensor for tensor in self.inputs if tensor.requires_grad]

        def draw() -> tuple[Tensor, Tensor]:
            *scene, backgrounds = self.inputs
            return rasterization(*scene, width, height, backgrounds=backgrounds, validate=False, **options)[:2]

        def back(outputs: tuple[Tensor, Tensor]) -> tuple[Tensor | None, ...]:
            return torch.autograd.grad(outputs, self._leaves, self.incoming, allow_unused=True)

        with torch.inference_mode(False), torch.enable_grad(), torch.cuda.device(device):
            aside = torch.cuda.Stream()
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                for _ in range(WARM_UPS):
                    outputs = draw()
                    self.incoming = [torch.zeros_like(output) for output in outputs]
                    self._zero = [True for _ in outputs]
                    if self._leaves:
                        back(outputs)
            torch.cuda.current_stream().wait_stream(aside)
            self._forward, self._backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
            with watch_overflow() as self.overflow:
                with torch.cuda.graph(self._forward, capture_error_mode="thread_local"):
                    outputs = draw()
            if self._leaves:
                with torch.cuda.graph(self._backward, self._forward.pool(), capture_error_mode="thread_local"):
                    self._gradients = back(outputs)
        self.outputs = [output.detach() for output in outputs]

    def fits(self, arguments: tuple[Tensor, ...]) -> bool:
        """Whether it was made for arguments of these shapes, types and needs."""
        return all(
            new.shape == kept.shape and new.dtype == kept.dtype and new.device == kept.device
            and new.requires_grad == needs
            for new, kept, needs in zip(arguments, self.inputs, self.needs, strict=True)
        )  # fmt: skip

    def draw(self, arguments: tuple[Tensor, ...]) -> bool:
        """Replay the forward graph; False where it had too little memory."""
        with torch.no_grad():
            torch._foreach_copy_(self.inputs, list(arguments))
            self._forward.replay()
        wait_for(current_stream(self.inputs[0].device))  # only then is it known whether the picture is whole
        return not self.overflow.happened()

    def back(self, incoming: tuple[Tensor | None, Tensor | None]) -> list[Tensor | None]:
        """Replay the backward graph: gradients by those of the arguments that need one."""
        for k, gradient in enumerate(incoming):
            if gradient is not None:
                self.incoming[k].copy_(gradient)
            elif not self._zero[k]:
                self.incoming[k].zero_()
            self._zero[k] = gradient is None
        self._backward.replay()
        gradients = iter(self._gradients)
        found = [next(gradients) if needs else None for needs in self.needs]
        return [None if g is None else g.detach() for g in found]


class _Replay(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, recording: _Recording, *_: Tensor) -> tuple[Tensor, ...]:
        ctx.recording = recording
        ctx.set_materialize_grads(False)
        return tuple(output.detach() for output in recording.outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[Any, ...]:
        return None, *ctx.recording.back(incoming)


class RecordedRasterization:
    """`rasterization` for pictures of one size on CUDA, recorded at the first call and replayed by the others.

    For training from Python, where an eager call waits for Python. Results are the bits of `rasterization`. They lie in
    memory of the recording, as do the gradients: the next call writes over both, so use or copy them before, and go
    back before you draw again. Other shapes, or other arguments that need a gradient, are recorded anew; so is what met
    more pairs of a Gaussian and a tile than the recording has memory for, after it was drawn without one.
    """

    def __init__(self, width: int, height: int, **options: Any) -> None:
        """Nothing is recorded yet.

        Args:
            width: Of the images [px].
            height: Of the images [px].
            options: Of `rasterization`, that are no tensors and not `validate`.
        """
        self._size = width, height
        self._options = options
        self._recording: _Recording | None = None

    def __call__(
        self,
        means: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
        scales: Float[Tensor, "N 3"],
        opacities: Float[Tensor, "N"],
        colors: Float[Tensor, "N D"] | Float[Tensor, "C N D"] | Float[Tensor, "N K 3"] | Float[Tensor, "C N K 3"],
        viewmats: Float[Tensor, "C 4 4"],
        Ks: Float[Tensor, "C 3 3"],
        backgrounds: Float[Tensor, "C D"],
    ) -> tuple[Float[Tensor, "C H W X"], Float[Tensor, "C H W 1"]]:
        """Images and alpha, as `rasterization` draws them with `validate=False`.

        Raises:
            ValueError: shapes, types or devices that do not belong together, or not float32 on CUDA.
        """
        arguments = means, quats, scales, opacities, colors, viewmats, Ks, backgrounds
        recording = self._recording
        if recording is None or not recording.fits(arguments):
            if not (means.is_cuda and means.dtype == torch.float32):
                raise ValueError(
                    f"means: expected float32 on a CUDA device, got {means.dtype} on {means.device}. "
                    "Elsewhere call rasterization, which has nothing to record."
                )
            recording = self._recording = _Recording(arguments, *self._size, self._options)
        if not recording.draw(arguments):
            self._recording = None
            *scene, behind = arguments
            return rasterization(*scene, *self._size, backgrounds=behind, validate=False, **self._options)[:2]
        image, alphas = _Replay.apply(recording, *arguments)
        return image, alphas
