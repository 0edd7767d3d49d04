"""Contact on CUDA: `contact.cu`, the rules of `contact`, by warps and by `LANES` lanes."""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 128
"""Threads of a block."""
WARPS = BLOCK // 32
LANES = 8
"""Threads that work on a vertex in `contacts` and `spread`, a power of two below 32: most have 16 to 24 neighbours."""


def _build(name: str, label: str) -> CudaNative:
    return cuda_native("skinning/contact.cu", name, BLOCK, label=label, constants={"LANES": LANES})


boxes = _build("boxes", "contact_boxes")
"""Kernel: `box_blocks` blocks with a warp for each part of each image, then one for every `BLOCK` vertices of all."""
meetings = _build("meetings", "contact_meetings")
"""Kernel: a warp for each part of each image."""
find = _build("find", "contact_find")
"""Kernel: a warp for each vertex of each image."""
contacts = _build("contacts", "contacts")
"""Kernel: `LANES` threads for each vertex of each image."""
spread = _build("spread", "contact_spread")
"""Kernel: `LANES` threads for each vertex of each image."""
closeness = _build("closeness", "contact_closeness")
"""Kernel: `LANES` threads for each vertex of each image."""
