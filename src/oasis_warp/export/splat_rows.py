"""The .splat of Gaussians: 32 bytes a Gaussian, most important first (github.com/antimatter15/splat)."""

from pathlib import Path

import numpy as np

from oasis_warp.data.output_files import write_file
from oasis_warp.data.splat_files import SPLAT_ROW
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splat_spz import to_bytes
from oasis_warp.export.splats import posed_splats, y_down


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
