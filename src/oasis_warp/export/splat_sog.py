"""The .sog of Gaussians, version 2: lossless pictures in a ZIP, a pixel a Gaussian (developer.playcanvas.com)."""

import io
import json
import math
import zipfile
from pathlib import Path

import cv2
import numpy as np

from oasis_warp import __version__
from oasis_warp.data.output_files import write_file
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splat_spz import to_bytes
from oasis_warp.export.splats import largest_component, morton_order, posed_splats, y_down

LEVELS = 256
"""Of scales and colours, evenly spaced: steps of 1 to 2 % of a scale, and finer than a byte of a colour."""
LARGEST = 252
"""Alpha of a quaternion whose largest component is the first of wxyz."""
LOSSLESS = (cv2.IMWRITE_WEBP_QUALITY, 101)
FIRST_DAY = (1980, 1, 1, 0, 0, 0)
"""Date of the files in the ZIP, so that equal avatars are equal bytes."""


def write_sog(request: ExportRequest, path: Path) -> None:
    """Means in 16 bits of their logarithm, all else in bytes; y down and z forward, as in .ply.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    means, quats, scales, opacities, colors = (part.double().numpy() for part in y_down(posed_splats(request)))
    order = morton_order(means)
    places = np.sign(means) * np.log1p(np.abs(means))
    least, most = places.min(0), places.max(0)
    fixed = np.round((places[order] - least) / np.maximum(most - least, 1e-12) * 65535).astype(np.uint16)
    largest, others = largest_component(quats[order])
    turns = to_bytes(255 * (others / math.sqrt(2) + 0.5))
    scale_levels, scale_bytes = _levels(np.log(scales[order]))
    color_levels, color_bytes = _levels((colors[order] - 0.5) / SH_C0)
    pictures = {
        "means_l.webp": (fixed & 255).astype(np.uint8),
        "means_u.webp": (fixed >> 8).astype(np.uint8),
        "scales.webp": scale_bytes,
        "quats.webp": np.concatenate([turns, (LARGEST + largest)[:, None].astype(np.uint8)], 1),
        "sh0.webp": np.concatenate([color_bytes, to_bytes(255 * opacities[order, None])], 1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": f"oasis_warp {__version__}"},
        "count": len(means),
        "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_levels, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_levels, "files": ["sh0.webp"]},
    }
    contents = {"meta.json": json.dumps(meta).encode(), **{name: _webp(rows) for name, rows in pictures.items()}}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in contents.items():
            archive.writestr(zipfile.ZipInfo(name, FIRST_DAY), data)
    write_file(path, stream.getvalue())


def _levels(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Evenly spaced levels between the least and the greatest value, and the nearest one of each value."""
    levels = np.linspace(values.min(), values.max(), LEVELS)
    step = max(levels[1] - levels[0], 1e-12)
    return levels.tolist(), to_bytes((values - levels[0]) / step)


def _webp(rows: np.ndarray) -> bytes:
    """A picture of about as many rows as columns, with these pixels, [N, 3 or 4], row by row."""
    width = math.ceil(math.sqrt(len(rows)))
    pixels = np.zeros((-(-len(rows) // width) * width, rows.shape[1]), np.uint8)
    pixels[: len(rows)] = rows
    pixels = pixels.reshape(-1, width, rows.shape[1])
    order = cv2.COLOR_RGBA2BGRA if rows.shape[1] == 4 else cv2.COLOR_RGB2BGR
    return cv2.imencode(".webp", cv2.cvtColor(pixels, order), LOSSLESS)[1].tobytes()
