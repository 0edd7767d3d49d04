"""The depth buffer on CUDA: `depth_buffer.cu` and `visibility.cu`.

`clear` -> `draw` -> `draw_large` -> `resolve`, four nodes of a graph; backwards `pull` twice and `settle`. Arrays are
float32, decisions are float64: the same expressions in the same order as in `depth_buffer`, without fused
multiply-adds, so that every pixel shows the same face as on the CPU.
"""

from oasis_kernels.runtime.cuda_native import CudaNative, cuda_native

BLOCK = 256
"""Threads of a block."""
FACES_PER_BLOCK = 64
LARGE = 256
"""Pixels of a box above which a face goes to the queue."""
SHARE = 512
"""Pixels of a box in the queue that are handed out at once."""
CULLED_SHARE = 8 * SHARE
"""Pixels of a box above which a share is looked at as a whole first: most may lie beside a long, thin triangle."""
QUEUE = 1 << 17
"""Faces that the queue holds at the most."""
START_BITS = 44
"""Bits of the queue's counter for the number of shares; the bits above count faces. A picture has fewer than 2^31
pixels, so that 2^17 faces fit; what other warps add while the queue fills up, eight faces each, fits as well."""
MAX_PIXELS = 4
"""Pixels of a thread of `resolve`."""
PEAKS = 1024
"""Blocks of `pull` at the most."""
CONSTANTS = {
    "FACES_PER_BLOCK": FACES_PER_BLOCK, "LARGE": LARGE, "SHARE": SHARE, "START_BITS": START_BITS,
    "CULLED_SHARE": CULLED_SHARE, "MAX_PIXELS": MAX_PIXELS,
}  # fmt: skip


def _build(file: str, name: str, label: str, blocks_per_multiprocessor: int = 1) -> CudaNative:
    return cuda_native(
        file, name, BLOCK, blocks_per_multiprocessor=blocks_per_multiprocessor, label=label, constants=CONSTANTS,
        fuse=False,
    )  # fmt: skip


clear = _build("depth/depth_buffer.cu", "clear", "clear_keys")
draw = _build("depth/depth_buffer.cu", "draw", "draw_faces", 3)
draw_large = _build("depth/depth_buffer.cu", "draw_large", "draw_large_faces", 3)
resolve = _build("depth/visibility.cu", "resolve", "resolve_keys", 3)
pull = _build("depth/visibility.cu", "pull", "pull_at_corners")
settle = _build("depth/visibility.cu", "settle", "settle_sums")
