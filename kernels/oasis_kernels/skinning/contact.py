"""Contact of a posed surface with itself: `contact.cpp` on the CPU, `contact.cu` on CUDA."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native
from oasis_kernels.runtime.native import PHASE_WORDS, native

ROUNDS = 6
"""Rounds of contact resolution; later ones make up for what the mean took from the first."""
_PHASES = 8 + 2 * ROUNDS
FLAGS = _PHASES * PHASE_WORDS
"""Words of zeros that threads on the CPU share; two more tell what was found."""
BLOCK = 128
"""Threads of a block on CUDA."""
WARPS = BLOCK // 32
LANES = 8
"""Threads that work on a vertex in `contacts` and `spread`, a power of two below 32: most have 16 to 24 neighbours."""

resolve = native(
    "skinning/contact.cpp", "resolve_contact", constants={"ROUNDS": ROUNDS, "PHASES": _PHASES}
)


def _on_cuda(name: str, label: str) -> CudaNative:
    return cuda_native("skinning/contact.cu", name, BLOCK, label=label, constants={"LANES": LANES})


boxes = _on_cuda("boxes", "contact_boxes")
"""Kernel: `box_blocks` blocks with a warp for each part of each image, then one for every `BLOCK` vertices of all."""
meetings = _on_cuda("meetings", "contact_meetings")
"""Kernel: a warp for each part of each image."""
find = _on_cuda("find", "contact_find")
"""Kernel: a warp for each vertex of each image."""
contacts = _on_cuda("contacts", "contacts")
"""Kernel: `LANES` threads for each vertex of each image."""
spread = _on_cuda("spread", "contact_spread")
"""Kernel: `LANES` threads for each vertex of each image."""
closeness = _on_cuda("closeness", "contact_closeness")
"""Kernel: `LANES` threads for each vertex of each image."""
