"""Everything between a torch tensor and a Warp launch: start Warp, view tensors, device and stream, launch."""

import functools
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

_start_lock = threading.Lock()
_started = False

VEC2 = {torch.float32: wp.vec2f, torch.float64: wp.vec2d}
VEC3 = {torch.float32: wp.vec3f, torch.float64: wp.vec3d}
VEC4 = {torch.float32: wp.vec4f, torch.float64: wp.vec4d}
SCALAR = {torch.float32: wp.float32, torch.float64: wp.float64, torch.int32: wp.int32, torch.int64: wp.int64}


def kernel_cache() -> Path:
    """Folder that holds the compiled kernels: $OASIS_WARP_CACHE, else $XDG_CACHE_HOME/oasis_warp, else ~/.cache/..."""
    explicit = os.environ.get("OASIS_WARP_CACHE")
    if explicit:
        return Path(explicit)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "oasis_warp"


def start() -> None:
    """Initialise Warp once a process, quietly, with the kernel cache in our own folder."""
    global _started
    if _started:
        return
    with _start_lock:
        if _started:
            return
        wp.config.quiet = True
        wp.config.kernel_cache_dir = str(kernel_cache())
        wp.init()
        _started = True


@functools.cache
def _cuda_stream(device_index: int, cuda_stream: int) -> "wp.Stream":
    # Kept for the life of the process: making one costs 5 us, and torch's pool of streams is small.
    stream = torch.cuda.ExternalStream(cuda_stream, device=device_index)
    return wp.stream_from_torch(stream)


def device_and_stream(tensor: Tensor) -> tuple["wp.Device", "wp.Stream | None"]:
    """The Warp device of `tensor` and torch's current stream there; both are needed for graph capture."""
    start()
    if tensor.device.type == "cpu":
        return wp.get_device("cpu"), None
    current = torch.cuda.current_stream(tensor.device)
    return wp.device_from_torch(tensor.device), _cuda_stream(current.device_index, current.cuda_stream)


def view(tensor: Tensor, dtype: Any = None) -> Any:
    """`tensor` (contiguous) as a Warp array over the same memory; a vector `dtype` folds the last axis."""
    start()
    assert tensor.is_contiguous(), "operators make their tensors contiguous before the launch"
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=False)


def launch(kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], like: Tensor, block_dim: int = 256) -> None:
    """Launch `kernel` over `dim` threads on the device and current stream of `like`; an empty launch is skipped."""
    if 0 in ([dim] if isinstance(dim, int) else list(dim)):
        return
    device, stream = device_and_stream(like)
    wp.launch(kernel, dim=dim, inputs=list(inputs), device=device, stream=stream, block_dim=block_dim)
