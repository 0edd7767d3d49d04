"""Share of the light from all around that reaches a surface past itself: `sky_exposure.cpp` and `sky_exposure.cu`."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

SIZE = 64
"""Side of the depth buffers [px]: 3 mm of a hand's 20 cm."""
MARGIN = 1.03
"""Radius that a buffer shows, in radii of the surface."""
LIFT = 0.002
"""Distance off the surface from which points look, and length of the ramp from seen to hidden [m]."""
STEEPEST = 3.0
"""Tangent of the angle between a direction and a point's normal up to which depth may differ by a texel's slope."""
LEAST = 1e-6
"""Light below which nothing arrives, hidden or not."""
PAIRS = 16
"""Pairs of opposite directions."""
SLACK = 1e-4
"""Share of a face by which a pixel may lie outside: rounding must open no seam between two faces."""
SLICES, LANES = 4, 8
"""On CUDA: blocks that share the faces of a pair of directions, threads that share the faces around a vertex."""
STATE = 4 * PHASE_WORDS
"""Words of zeros that threads on the CPU share."""
CONSTANTS = {
    "SIZE": SIZE, "MARGIN": f"{MARGIN}f", "LIFT": f"{LIFT}f", "STEEPEST": f"{STEEPEST}f", "LEAST": f"{LEAST}f",
    "PAIRS": PAIRS, "SLACK": f"{SLACK}f", "SLICES": SLICES, "LANES": LANES,
}  # fmt: skip
DRAW_BLOCK, VERTEX_BLOCK = 1024, 128
"""Threads of a block."""

expose = native("scene/sky_exposure.cpp", "expose", label="sky_exposure", constants=CONSTANTS)


def _on_cuda(name: str, block: int) -> CudaNative:
    return cuda_native("scene/sky_exposure.cu", name, block, label=f"sky_{name}", constants=CONSTANTS)


draw = _on_cuda("draw", DRAW_BLOCK)
"""Kernel: `SLICES` blocks for each pair of directions of each image."""
gather = _on_cuda("gather", VERTEX_BLOCK)
"""Kernel: `PAIRS` threads for each vertex of each image."""
smooth = _on_cuda("smooth", VERTEX_BLOCK)
"""Kernel: `LANES` threads for each vertex of each image."""
