"""Float32 face and vertex rotations: `face_rotations.cpp` on the CPU and `face_rotations.cu` on CUDA."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

TRIANGLE = 12
"""Numbers of a face at rest in the table of `measure`."""
STATE = 4 * PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
BLOCK = 128
"""Threads of a block on CUDA."""
CONSTANTS = {"FLAT": "1e-6f", "DAMPING": "0.5e-6f", "FLAT_WORD": 3 * PHASE_WORDS, "TRIANGLE": TRIANGLE, "KEPT": 8}


def _on_cpu(name: str) -> Native:
    return native("posing/face_rotations.cpp", name, constants={k: v for k, v in CONSTANTS.items() if k != "KEPT"})


def _on_cuda(name: str) -> CudaNative:
    return cuda_native("posing/face_rotations.cu", name, BLOCK, constants=CONSTANTS)


measure, rotate, rotate_backward = (_on_cpu(name) for name in ("measure", "rotate", "rotate_backward"))
measure_triangles = _on_cuda("measure_triangles")
"""Kernel: one block for every `BLOCK` faces."""
rotate_faces = _on_cuda("rotate_faces")
"""Kernel: for each pose, one block for every `BLOCK` faces."""
rotate_vertices = _on_cuda("rotate_vertices")
"""Kernel: for each pose, one block for every `BLOCK` vertices."""
rotate_faces_backward = _on_cuda("rotate_faces_backward")
"""Kernel: for each pose, one block for every `BLOCK` faces."""
gather_edges = _on_cuda("gather_edges")
"""Kernel: for each pose, one block for every `BLOCK` vertices."""
