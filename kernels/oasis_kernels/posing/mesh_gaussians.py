"""Float32 posing of Gaussians on a mesh: `mesh_gaussians.cpp` on the CPU and `mesh_gaussians.cu` on CUDA."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

STATE = 4 * PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
BLOCK = 128
"""Threads of a block on CUDA."""
CONSTANTS = {"LIMIT": "1e4f"}
"""Area ratios act on scales within this and its inverse."""


def _on_cuda(name: str) -> CudaNative:
    return cuda_native("posing/mesh_gaussians.cu", name, BLOCK, constants=CONSTANTS)


pose = native("posing/mesh_gaussians.cpp", "pose", constants=CONSTANTS)
pose_backward = native("posing/mesh_gaussians.cpp", "pose_backward", constants=CONSTANTS)
pose_mesh_gaussians = _on_cuda("pose_mesh_gaussians")
"""Kernel: for each pose, one block for every `BLOCK` Gaussians on vertices, then one for every `BLOCK` on faces."""
pose_mesh_gaussians_backward = _on_cuda("pose_mesh_gaussians_backward")
"""Kernel: blocks as for `pose_mesh_gaussians`."""
gather_mesh_gaussians = _on_cuda("gather_mesh_gaussians")
"""Kernel: for each pose, one block for every `BLOCK` vertices if there are rows, then one for every `BLOCK` faces if
area ratios are wanted."""
