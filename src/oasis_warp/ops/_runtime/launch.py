"""From torch tensors to Warp launches: start Warp, view tensors, find device and stream, launch."""

import ctypes
import functools
import itertools
import os
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from oasis_kernels.runtime.cuda_native import CudaNative
from oasis_kernels.runtime.native import TASK, Native
from oasis_warp.core.processes import kernel_threads
from oasis_warp.ops._runtime.kernel_cache import load_module, writable_cache
from oasis_warp.ops._runtime.plans import CudaLaunch

_start_lock = threading.Lock()
_load_lock = threading.Lock()
_started = False

VECTORS = {
    torch.float32: {2: wp.vec2f, 3: wp.vec3f, 4: wp.vec4f},
    torch.float64: {2: wp.vec2d, 3: wp.vec3d, 4: wp.vec4d},
    torch.int32: {2: wp.vec2i, 4: wp.vec4i},
}
MIN_TASKS = 2048
"""Least tasks of a generic kernel for which another thread pays."""
SCALAR_NAMES = {torch.float32: "float", torch.float64: "double"}
SCALAR = {torch.float32: wp.float32, torch.float64: wp.float64, torch.int32: wp.int32, torch.int64: wp.int64}


@contextmanager
def _native_stderr_closed() -> Iterator[None]:
    """Discard what native code prints: without a GPU, Warp warns of the missing driver."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def start() -> None:
    """Initialise Warp once a process, quietly, with the kernel cache in our own folder."""
    global _started
    if _started:
        return
    with _start_lock:
        if _started:
            return
        wp.config.log_level = wp.LOG_WARNING
        wp.config.kernel_cache_dir = cache = str(writable_cache())
        with nullcontext() if torch.cuda.is_available() else _native_stderr_closed():
            wp.init()
        if wp.config.kernel_cache_dir == cache:  # the program had initialised Warp, which then adds no version to it
            wp.config.kernel_cache_dir = str(Path(cache) / wp.config.version)
        _started = True


_warp_streams: dict[tuple[int, int], "wp.Stream"] = {}  # by device and handle


def current_stream(device: torch.device) -> "wp.Stream":
    """Torch's current stream on a CUDA device, for a launch that a graph may be capturing."""
    index = torch.cuda.current_device() if device.index is None else device.index
    # What torch.cuda.current_stream does, in a tenth of its time.
    key = index, torch._C._cuda_getCurrentRawStream(index)
    stream = _warp_streams.get(key)
    if stream is None:
        start()
        # Cached for the life of the process: making one costs 5 us, and torch's pool of streams is small. It is made
        # from the object: rebuilt from its handle, the default stream (handle 0) would become another one.
        stream = _warp_streams[key] = wp.stream_from_torch(torch.cuda.current_stream(index))
    return stream


def wait_for(stream: "wp.Stream") -> None:
    """Wait until the device has done what is on a CUDA stream."""
    wp.synchronize_stream(stream)


def device_and_stream(tensor: Tensor) -> tuple["wp.Device", "wp.Stream | None"]:
    """The Warp device of `tensor` and torch's current stream there; both are needed for graph capture."""
    start()
    if tensor.device.type == "cpu":
        return wp.get_device("cpu"), None
    stream = current_stream(tensor.device)
    return stream.device, stream


def view(tensor: Tensor, dtype: Any = None) -> Any:
    """`tensor` (contiguous) as a Warp array over the same memory; a vector `dtype` folds the last axis."""
    start()
    assert tensor.is_contiguous(), "operators make their tensors contiguous before the launch"
    if not tensor.numel():  # of any strides for torch
        tensor = torch.empty_like(tensor, memory_format=torch.contiguous_format)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=False)


def vectors(tensor: Tensor, axes: int = 1) -> Any:
    """`tensor` [..., 2 to 4] as a Warp array of vectors along its last axis, the others folded into so many `axes`."""
    return view(tensor.view(-1, *tensor.shape[-axes:]), VECTORS[tensor.dtype][tensor.shape[-1]])


def has_vectors(tensor: Tensor) -> bool:
    """Whether vectorised CPU kernels take tensors like this one: float32 on the CPU."""
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32


def has_cuda_kernels(tensor: Tensor) -> bool:
    """Whether native CUDA kernels take tensors like this one: float32 on CUDA."""
    return tensor.is_cuda and tensor.dtype == torch.float32


_loaded: set[tuple[Any, str]] = set()  # modules and devices


def _load(kernel: Any, device: "wp.Device", block_dim: int = 256) -> None:
    """Load the module of a kernel before its first launch: threads that meet at an unbuilt one would each build it."""
    if (kernel.module, device.alias) not in _loaded:
        with _load_lock:
            load_module(kernel.module, device, 1 if device.is_cpu else block_dim)
            _loaded.add((kernel.module, device.alias))


def _with_views(inputs: Sequence[Any]) -> list[Any]:
    """`inputs` of a kernel, with views of tensors."""
    return [view(value) if isinstance(value, Tensor) else value for value in inputs]


def launch(kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], like: Tensor) -> None:
    """Launch `kernel` over `dim` threads on the device and current stream of `like`; an empty launch is skipped.

    Tensors among the inputs are contiguous; those that stand for vectors come as `vectors`.
    """
    if 0 in ([dim] if isinstance(dim, int) else list(dim)):
        return
    device, stream = device_and_stream(like)
    _load(kernel, device)
    wp.launch(kernel, dim=dim, inputs=_with_views(inputs), device=device, stream=stream, block_dim=256)


@functools.cache
def _pool(process: int, n_threads: int) -> ThreadPoolExecutor:
    # Keyed by the process: threads do not survive a fork, and a pool without its threads would wait for ever.
    return ThreadPoolExecutor(n_threads, thread_name_prefix="oasis_warp")


def even_cuts(n: int, least: int = MIN_TASKS) -> list[int]:
    """Bounds 0 .. n of ranges for `launch_ranges`: one for each thread, none with fewer than `least` tasks."""
    parts = max(1, min(kernel_threads(), n // least))
    return [n * k // parts for k in range(parts + 1)]


def _launch_range(
    kernel: Any, inputs: Sequence[Any], device: Any, stream: Any, lanes: int | None, bounds: tuple[int, int]
) -> None:
    first, end = bounds
    dim = end - first if lanes is None else (end - first, lanes)
    wp.launch(kernel, dim=dim, inputs=[first, *inputs], device=device, stream=stream, block_dim=256)


def launch_ranges(
    kernel: Any, cuts: int | Sequence[int], inputs: Sequence[Any], like: Tensor, lanes: int | None = None
) -> None:
    """Launch `kernel(first, *inputs)` over the tasks 0 .. cuts[-1]; thread t does task first + t.

    On the CPU, where a launch is one loop on the calling thread with the GIL released, the ranges between `cuts` are
    shared out over `kernel_threads()` threads; those of so many tasks are `even_cuts`. A task must write only
    what is its own; then results do not depend on the cuts. On CUDA it is one launch. With `lanes` the launch has a
    second axis of that size. Inputs are as in `launch`.
    """
    device, stream = device_and_stream(like)
    cuts, inputs = even_cuts(cuts) if isinstance(cuts, int) else cuts, _with_views(inputs)
    if device.is_cuda:
        cuts = [0, cuts[-1]]
    ranges = [(a, b) for a, b in itertools.pairwise(cuts) if b > a]

    _load(kernel, device)

    run = functools.partial(_launch_range, kernel, inputs, device, stream, lanes)
    n_threads = min(kernel_threads(), len(ranges))
    if device.is_cuda or n_threads < 2:
        for bounds in ranges:
            run(bounds)
        return
    list(_pool(os.getpid(), n_threads).map(run, ranges))


class _Recorded(threading.local):
    """Launches of native kernels, recorded once per thread: replaying one costs a fifth of `wp.launch`."""

    def __init__(self) -> None:
        self.launches: dict[Any, Any] = {}  # by kernel


_recorded = _Recorded()


def _replay(kernel: Any, block: int) -> None:
    launch: Any = _recorded.launches.get(kernel)
    if launch is None:
        _load(kernel, wp.get_device("cpu"))
        with _load_lock:
            launch = wp.launch(kernel, dim=1, inputs=[block], device="cpu", record_cmd=True)
        _recorded.launches[kernel] = launch
    launch.set_param_at_index_from_ctype(0, block)
    launch.launch()


def run_shared(kernel: Any, block: int, n_tasks: int) -> None:
    """Run a CPU kernel of one argument, the address of a parameter block, and return when it is done.

    Up to `n_tasks` of our threads run it together, including this one. The kernel deals out its tasks, so a thread
    that comes late, or never, costs only time.
    """
    start()
    helpers = min(kernel_threads(), n_tasks) - 1
    if helpers < 1:
        _replay(kernel, block)
        return
    pool = _pool(os.getpid(), helpers)
    futures = [pool.submit(_replay, kernel, block) for _ in range(helpers)]
    try:
        _replay(kernel, block)
    finally:  # they point into the block
        for future in futures:
            if not future.cancel():
                future.result()


@functools.cache
def _sched_yield() -> int:
    """Address of the C library's sched_yield, 0 where there is none."""
    if os.name != "posix":
        return 0
    return ctypes.cast(ctypes.CDLL(None).sched_yield, ctypes.c_void_p).value or 0


Parameters = Mapping[str, Any]
"""Numbers and tensors by parameter of a kernel. A tensor stands for its address; None or an empty tensor for null."""


def run_native(native: Native, params: Parameters, n_tasks: int) -> None:
    """Run a native kernel on the CPU: see `run_shared`.

    Args:
        native: The kernel.
        params: A number or contiguous tensor for each of its parameters; others are ignored.
        n_tasks: The largest number of tasks in one of its phases.
    """
    values = []
    for name in native.parameters:
        value = _sched_yield() if name == "yield_thread" else params[name]
        if isinstance(value, Tensor):
            assert value.is_contiguous() and value.is_cpu, name
            value = value.data_ptr()
        values.append(value or 0)
    block = (ctypes.c_longlong * len(values))(*values)
    run_shared(native.kernel, ctypes.addressof(block), n_tasks)


def phase_state(size: int) -> Tensor:
    """The words of zeros with which the threads of a native kernel share out its phases."""
    return torch.zeros(size, dtype=torch.int64)


def task_count(*items: int) -> int:
    """Number of tasks of a native kernel of posing with phases over so many items."""
    return -(-max(items) // TASK)


def block_count(n: int, block: int) -> int:
    """Number of blocks for `n` threads."""
    return -(-n // block)


def contiguous(*tensors: Tensor | None) -> list[Any]:
    """The tensors in contiguous memory; None stays None."""
    return [None if tensor is None else tensor.contiguous() for tensor in tensors]


def aligned(*tensors: Tensor | None) -> list[Any]:
    """`contiguous`, at multiples of 16 bytes: CUDA kernels read rows of four numbers as one."""
    found = contiguous(*tensors)
    return [t.clone() if t is not None and t.data_ptr() % 16 else t for t in found]


class _CudaLaunches(threading.local):
    """Launches of CUDA kernels: one for each thread, as it owns the memory of its parameters."""

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, int], CudaLaunch] = {}  # by kernel and device


_cuda_launches = _CudaLaunches()


def cuda_launch(native: CudaNative, device: "wp.Device") -> CudaLaunch:
    """This thread's launch of a kernel on a device; loads the kernel at the first call."""
    key = native.kernel, device.ordinal
    launch = _cuda_launches.launches.get(key)
    if launch is None:
        _load(native.kernel, device, native.block)
        with _load_lock:
            recorded = wp.launch(
                native.kernel, dim=native.block, inputs=[native.kernel.adj.args[0].type()], device=device,
                block_dim=native.block, record_cmd=True,
            )  # fmt: skip
        launch = _cuda_launches.launches[key] = CudaLaunch(recorded, native)
    return launch


def run_cuda(native: CudaNative, params: Parameters, n_blocks: int, stream: "wp.Stream") -> None:
    """Launch a CUDA kernel of `n_blocks` blocks on `stream`, which a graph may be capturing; none for no blocks.

    Args:
        native: The kernel.
        params: A number or contiguous tensor for each of its parameters, none of which is an array; others are
            ignored.
        n_blocks: Number of blocks of `native.block` threads.
        stream: A `current_stream`.
    """
    if not n_blocks:
        return
    values = []
    for name in native.parameters:
        value = params[name]
        values.append(value.data_ptr() if isinstance(value, Tensor) else value or 0)
    cuda_launch(native, stream.device)(n_blocks, stream.cuda_stream, *values)
