"""The .ply of 3D Gaussian splatting: what every viewer of splats reads (Kerbl et al. 2023)."""

from pathlib import Path

import numpy as np
import torch

from oasis_warp.data.output_files import write_file
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import posed_splats, y_down

LEAST_OPACITY = 1e-6
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
    opacities = splats.opacities.clamp(LEAST_OPACITY, 1 - LEAST_OPACITY).logit()
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
