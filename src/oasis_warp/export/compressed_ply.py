"""The .compressed.ply of Gaussians: 16 bytes a Gaussian and 72 for 256 of them (PlayCanvas, SuperSplat)."""

from pathlib import Path

import numpy as np

from oasis_warp.data.output_files import write_file
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splat_ply import ply_header
from oasis_warp.export.splats import largest_component, morton_order, posed_splats, y_down

CHUNK = 256
"""Gaussians that share a box, neighbours in space."""
RANGES = tuple(
    f"{end}_{name}" for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max") for name in names
)  # fmt: skip
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def write_compressed_ply(request: ExportRequest, path: Path) -> None:
    """Means, log scales and colours within the range of their chunk, in 11, 10, 11 and 8 bits; y down and z forward.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    means, quats, scales, opacities, colors = (part.double().numpy() for part in y_down(posed_splats(request)))
    order = morton_order(means)
    chunk = np.arange(len(means)) // CHUNK
    starts = np.arange(0, len(means), CHUNK)
    ranges, shares = [], []
    for values in (means[order], np.log(scales[order]), colors[order]):
        # Rounded first, because readers place values between the float32 ends.
        least, most = (f.reduceat(values, starts).astype("<f4") for f in (np.minimum, np.maximum))
        ranges += [least, most]
        width = np.maximum(most.astype(float) - least, np.finfo(np.float32).tiny)
        shares.append(np.clip((values - least[chunk]) / width[chunk], 0, 1))
    rgba = np.concatenate([shares[2], opacities[order, None]], 1)
    columns = (pack(shares[0], 11, 10, 11), pack_quats(quats[order]), pack(shares[1], 11, 10, 11), pack(rgba, *[8] * 4))
    header = ply_header(("chunk", len(starts), "float", RANGES), ("vertex", len(means), "uint", PACKED))
    write_file(path, header + np.concatenate(ranges, 1).tobytes() + np.stack(columns, 1).astype("<u4").tobytes())


def pack(shares: np.ndarray, *bits: int) -> np.ndarray:
    """Columns in [0, 1] as numbers of so many bits each, the first in the highest."""
    packed = np.zeros(len(shares), np.uint32)
    for column, n in zip(shares.T, bits, strict=True):
        packed = packed << n | np.round(column * ((1 << n) - 1)).astype(np.uint32)
    return packed


def pack_quats(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz, [N, 4], as 32 bits: the index of the largest component, then the others."""
    largest, others = largest_component(quats)
    return pack(np.concatenate([largest[:, None] / 3, np.clip(others / np.sqrt(2) + 0.5, 0, 1)], 1), 2, 10, 10, 10)
