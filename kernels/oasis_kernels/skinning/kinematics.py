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


def _on_cpu(name: str, scalar: str) -> Native:
    return native(PATH, name, label=f"{name}_{scalar}", constants={"SCALAR": scalar, "LOCAL": LOCAL}, scalar=scalar,
                  shared={"n_poses": "long long", "state": "long long*"})  # fmt: skip


def _on_cuda(name: str, scalar: str) -> CudaNative:
    constants = {"SCALAR": scalar, "LOCAL": LOCAL}
    return cuda_native(PATH, name, BLOCK, label=f"{name}_{scalar}", constants=constants, scalar=scalar)


@functools.cache
def transforms(scalar: str) -> Native:
    """CPU kernel in "float" or "double"."""
    return _on_cpu("bone_transforms", scalar)


@functools.cache
def transforms_backward(scalar: str) -> Native:
    """CPU kernel in "float" or "double"."""
    return _on_cpu("bone_transforms_backward", scalar)


@functools.cache
def cuda_transforms(scalar: str) -> CudaNative:
    """CUDA kernel in "float" or "double": one block per pose."""
    return _on_cuda("bone_transforms", scalar)


@functools.cache
def cuda_transforms_backward(scalar: str) -> CudaNative:
    """CUDA kernel in "float" or "double": one block per pose."""
    return _on_cuda("bone_transforms_backward", scalar)
