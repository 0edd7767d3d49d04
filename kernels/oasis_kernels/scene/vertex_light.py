"""Light of posed vertices, and what stays on them of a photo's shade: `vertex_light.cpp` and `vertex_light.cu`."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

STATE = 3 * PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
PARTS = 16
"""Blocks on CUDA that share a mean over the vertices of an image."""
PREPARE_BLOCK, BLOCK = 512, 128
"""Threads of a block."""

light_vertices = native("scene/vertex_light.cpp", "light_vertices")


def _on_cuda(name: str, block: int, label: str) -> CudaNative:
    return cuda_native("scene/vertex_light.cu", name, block, label=label, constants={"PARTS": PARTS})


prepare = _on_cuda("prepare", PREPARE_BLOCK, "vertex_light_prepare")
"""Kernel: `PARTS` blocks for each image, then a warp for each of its coarse vertices."""
light_vertices_cuda = _on_cuda("light_vertices", BLOCK, "light_vertices")
"""Kernel: a thread for each vertex of each image."""
