"""From joint angles to the transforms of bones, and back: `kinematics.cu`, one source for the CPU and CUDA."""

import functools

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

BLOCK = 32
"""Threads of a pose on CUDA."""
LOCAL = 12
"""Numbers of a bone that are kept: L by rows, then J - L J."""
STATE = PHASE_WORDS
"""Words of zeros that threads of the CPU share."""
PATH = "skinning/kinematics.cu"


@functools.cache
def on_cpu(name: str, scalar: str) -> Native:
    """CPU kernel "bone_transforms" or "bone_transforms_backward" in "float" or "double"."""
    return native(PATH, name, label=f"{name}_{scalar}", constants={"SCALAR": scalar, "LOCAL": LOCAL}, scalar=scalar,
                  shared={"n_poses": "long long", "state": "long long*"})  # fmt: skip


@functools.cache
def on_cuda(name: str, scalar: str) -> CudaNative:
    """The same for CUDA: one block per pose."""
    constants = {"SCALAR": scalar, "LOCAL": LOCAL}
    return cuda_native(PATH, name, BLOCK, label=f"{name}_{scalar}", constants=constants, scalar=scalar)
