"""Projection in float32: `projection.cpp` on the CPU and `projection.cu` on CUDA. See `projection` for float64."""

from oasis_kernels import constants
from oasis_kernels.runtime.cuda_native import cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

CHUNK = 512
"""Gaussians of a task on the CPU, a multiple of 8; camera gradients are summed by chunks, so that threads do not change
them."""
STATE = 2 * PHASE_WORDS
"""Words of zeros that threads of `project_backward` share; `project` takes PHASE_WORDS."""
BLOCK = 64
"""Threads of a block on CUDA; few, so that the blocks of one hand fill a device evenly."""
CONSTANTS = {"CHUNK": CHUNK, "JACOBIAN_LIMIT": constants.JACOBIAN_LIMIT, "BOX_SLACK": constants.BOX_SLACK}


project = native("rasterize/projection.cpp", "project", label="project_vectors", constants=CONSTANTS)
"""CPU kernel: tasks are chunks."""
project_backward = native(
    "rasterize/projection_backward.cpp", "project_backward", label="project_vectors_backward", constants=CONSTANTS
)
"""CPU kernel: tasks are chunks, then cameras."""
cuda_project = cuda_native(
    "rasterize/projection.cu", "project", BLOCK, blocks_per_multiprocessor=8, label="project_gaussians",
    constants=CONSTANTS,
)  # fmt: skip
"""CUDA kernel: blocks of `BLOCK` (camera, Gaussian) pairs."""
cuda_project_backward = cuda_native(
    "rasterize/projection_backward.cu", "project_backward", BLOCK, blocks_per_multiprocessor=6,
    label="project_gaussians_backward", constants=CONSTANTS,
)  # fmt: skip
"""CUDA kernel: blocks of `BLOCK` Gaussians."""
