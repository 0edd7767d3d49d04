"""The .ply of 3D Gaussian splatting, what every viewer of splats reads (Kerbl et al. 2023), and .compressed.ply.

The latter takes 16 bytes a Gaussian and 72 for 256 of them (PlayCanvas, SuperSplat).
"""

from pathlib import Path

import numpy as np
import torch

from oasis_warp.data.output_files import write_file
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import largest_component, morton_order, posed_splats, y_down

MIN_OPACITY = 1e-6
"""Distance of opacities from 0 and 1, where their logits end."""
COLUMNS = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


def write_ply(request: ExportRequest, path: Path) -> None:
    """One float32 row a Gaussian: log scales, logit opacities, wxyz; y down and z forward, as trained scenes have it.

    Colours are the constant harmonic of sRGB; no others, as the avatar's colours do not depend on the view.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    splats = y_down(posed_splats(request))
    opacities = splats.opacities.clamp(MIN_OPACITY, 1 - MIN_OPACITY).logit()
    parts = (
        splats.means, torch.zeros_like(splats.means), (splats.colors - 0.5) / SH_C0, opacities[:, None],
        splats.scales.log(), splats.quats,
    )  # fmt: skip
    rows = torch.cat(parts, 1).numpy().astype("<f4")
    write_file(path, ply_header(("vertex", len(rows), "float", COLUMNS)) + np.ascontiguousarray(rows).tobytes())


def ply_header(*elements: tuple[str, int, str, tuple[str, ...]]) -> bytes:
    """Of a binary PLY, for elements of a name, a number of rows, a type and columns.

    Without comments: importers of some engines stumble over them.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, n_rows, kind, columns in elements:
        lines += [f"element {name} {n_rows}", *(f"property {kind} {column}" for column in columns)]
    return "\n".join([*lines, "end_header\n"]).encode()


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
