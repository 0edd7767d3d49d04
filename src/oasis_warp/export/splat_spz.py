"""Small files of Gaussians: the .spz, versions 3 and 4, and the .splat.

.spz takes 20 bytes a Gaussian, packed (github.com/nianticlabs/spz); .splat takes 32, most important first
(github.com/antimatter15/splat).
"""

import gzip
import struct
from pathlib import Path

import numpy as np

from oasis_warp.data.output_files import write_file
from oasis_warp.data.splat_files import SH_C0, SPLAT_ROW, SPZ4_HEADER, SPZ_COLOR_SCALE, SPZ_MAGIC, zstandard
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import largest_component, morton_order, posed_splats, y_down

LEVEL = 19
"""Of zstd: the last that needs no more memory to read."""
FRACTION_BITS = 20
"""Of means: steps of 0.95 um and a reach of 8 m. The reference encoder's 12 are steps of 0.24 mm, as far apart as the
lines of skin."""
SCALE_STEPS, SCALE_ZERO = 16, -10
"""A byte holds SCALE_STEPS (log scale - SCALE_ZERO): steps of 6 %, from 45 um on."""
QUAT_STEPS = 511
"""Of the three smaller components, each of which has 9 bits and a sign."""


def write_spz(request: ExportRequest, path: Path) -> None:
    """Version 3: means in fixed point, quaternions as their three smaller components, all else as bytes; y up.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    count, streams = _streams(request)
    header = struct.pack("<IIIBBBB", SPZ_MAGIC, 3, count, 0, FRACTION_BITS, 0, 0)
    # No time, so that equal avatars are equal bytes.
    write_file(path, gzip.compress(header + b"".join(streams), 9, mtime=0))


def write_spz4(request: ExportRequest, path: Path) -> None:
    """Version 4: the same in a stream of zstd each, after a header of 32 bytes and the sizes of the streams.

    Raises:
        InputError: zstandard is missing, a value is not finite, or `path` cannot be written.
    """
    packer = zstandard(path).ZstdCompressor(level=LEVEL)
    count, streams = _streams(request)
    packed = [packer.compress(stream) for stream in streams]
    head = SPZ_MAGIC, 4, count, 0, FRACTION_BITS, 0, len(streams), SPZ4_HEADER
    sizes = [struct.pack("<QQ", len(small), len(stream)) for small, stream in zip(packed, streams, strict=True)]
    write_file(path, struct.pack("<IIIBBBBI", *head).ljust(SPZ4_HEADER, b"\0") + b"".join([*sizes, *packed]))


def _streams(request: ExportRequest) -> tuple[int, list[bytes]]:
    """Number of Gaussians; their means, opacities, colours, scales and quaternions."""
    means, quats, scales, opacities, colors = (part.double().numpy() for part in posed_splats(request))
    order = morton_order(means)
    fixed = np.round(means[order] * (1 << FRACTION_BITS)).astype("<i4")
    parts = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        to_bytes(255 * opacities[order]),
        to_bytes(255 * (SPZ_COLOR_SCALE * (colors[order] - 0.5) / SH_C0 + 0.5)),
        to_bytes(SCALE_STEPS * (np.log(scales[order]) - SCALE_ZERO)),
        pack_quats(quats[order]),
    )
    return len(means), [np.ascontiguousarray(part).tobytes() for part in parts]


def to_bytes(values: np.ndarray) -> np.ndarray:
    """The nearest bytes."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def pack_quats(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz, [N, 4], as 32 bits: the index of the largest of xyzw, then sign and size of the others."""
    largest, others = largest_component(quats[:, [1, 2, 3, 0]])
    packed = largest.astype(np.uint32)
    for column in others.T:
        size = np.round(np.abs(column) * np.sqrt(2) * QUAT_STEPS).astype(np.uint32)
        packed = packed << 10 | (column < 0).astype(np.uint32) << 9 | np.minimum(size, QUAT_STEPS)
    return packed.astype("<u4")


def write_splat(request: ExportRequest, path: Path) -> None:
    """Means and scales as float32, colours, opacities and quaternions wxyz as bytes; y down and z forward.

    Sorted by volume times opacity, so that a part of the file already looks right.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    means, quats, scales, opacities, colors = (part.numpy() for part in y_down(posed_splats(request)))
    order = np.argsort(-scales.prod(1) * opacities, kind="stable")
    rows = np.zeros(len(order), SPLAT_ROW)
    rows["mean"], rows["scales"] = means[order], scales[order]
    rows["rgba"] = to_bytes(255 * np.concatenate([colors, opacities[:, None]], 1)[order])
    rows["quat"] = to_bytes(128 + 128 * quats[order])
    write_file(path, rows.tobytes())
