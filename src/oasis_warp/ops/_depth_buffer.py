"""Fill a depth buffer, on the CPU by the vectorised kernels, elsewhere by the generic ones."""

import ctypes
import os
import threading
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from oasis_kernels import depth_buffer_vectors as vectors
from oasis_kernels.depth_buffer_vectors import Job
from oasis_warp.ops import _launch

C_TYPES = {torch.float32: "float", torch.float64: "double"}

_recorded = threading.local()


def _run_on_this_thread(stage: str, dtype: str, thread: int, address: int) -> None:
    launches = _recorded.__dict__.setdefault("launches", {})
    launch = launches.get((stage, dtype))
    if launch is None:
        kernel = vectors.kernels(dtype)[stage]
        launch = wp.launch(kernel, dim=1, inputs=[0, 0], device="cpu", record_cmd=True)
        launches[stage, dtype] = launch
    launch.set_param_at_index(0, thread)
    launch.set_param_at_index(1, address)
    launch.launch()


def run(stage, dtype, n_tasks, job):
    _launch.start()
    n = min(torch.get_num_threads(), n_tasks)
    address = ctypes.addressof(job)
    if n < 2:
        _run_on_this_thread(stage, dtype, 0, address)
        return
    with _launch._load_lock:
        vectors.kernels(dtype)[stage].module.load(wp.get_device("cpu"), 1)
    pool = _launch._pool(os.getpid(), n)
    list(pool.map(lambda t: _run_on_this_thread(stage, dtype, t, address), range(n)))
