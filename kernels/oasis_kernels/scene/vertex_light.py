"""Light of posed vertices, and what stays on them of a photo's shade: `vertex_light.cpp` and `vertex_light.cu`."""

from oasis_kernels.runtime.cuda_native import cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

STATE = 3 * PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
PREPARE_BLOCK, BLOCK = 1024, 128
"""Threads of a block."""

light_vertices = native("scene/vertex_light.cpp", "light_vertices")
prepare = cuda_native("scene/vertex_light.cu", "prepare", PREPARE_BLOCK, label="vertex_light_prepare")
"""Kernel: a block for each image, then threads for coarse vertices."""
light_vertices_cuda = cuda_native("scene/vertex_light.cu", "light_vertices", BLOCK)
"""Kernel: a thread for each vertex of each image."""
