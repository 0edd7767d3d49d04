"""Hand-drawn outlines of hands in photos, filled to masks: `masks = read_masks("tests/data/masks/outlines.json")`.

Coordinates: x to the right, y down, in pixels of the photo; pixel (row i, column j) covers [j, j + 1) x [i, i + 1).
"""

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt

SUPERSAMPLING = 4  # samples a pixel along each axis: coverage in steps of 1/16, finer than an edge drawn by hand

Coverage = npt.NDArray[np.float32]


def read_masks(path: str | Path, *, cut_at_wrist: bool = False) -> dict[str, Coverage]:
    """Masks by photo name (file name without extension): float32 (H, W), the covered share of each pixel in [0, 1].

    `cut_at_wrist` drops what lies on the arm's side of the wrist line; otherwise the mask goes down the forearm as
    far as it was drawn. Raises ValueError where a polygon is neither "outer" nor "hole".
    """
    entries = json.loads(Path(path).read_text(encoding="utf-8"))
    return {Path(entry["file"]).stem: _coverage(entry, cut_at_wrist) for entry in entries}


def _coverage(entry: dict, cut_at_wrist: bool) -> Coverage:
    width, height = entry["size"]
    inside = np.zeros((height * SUPERSAMPLING, width * SUPERSAMPLING), bool)
    for polygon in entry["polygons"]:
        ((kind, points),) = polygon.items()
        if kind not in ("outer", "hole"):
            raise ValueError(f'{entry["file"]}: expected a polygon "outer" or "hole", got "{kind}".')
        filled = _fill(np.asarray(points, float) * SUPERSAMPLING, inside.shape)
        inside = inside | filled if kind == "outer" else inside & ~filled
    if cut_at_wrist:
        inside &= _hand_side(np.asarray(entry["wrist"], float) * SUPERSAMPLING, inside.shape)
    blocks = inside.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _fill(points: npt.NDArray[np.float64], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Samples inside a closed polygon (even-odd rule), tested at the sample centres.

    Not cv2.fillPoly: that one also paints the samples its outline touches, which widens a mask by an eighth of a pixel.
    """
    height, width = shape
    crossings = np.zeros((height, width + 1), np.int32)
    for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
        first, last = np.ceil(np.sort([y0, y1]) - 0.5).astype(int)  # the rows whose centre line the edge crosses
        rows = np.arange(max(first, 0), min(last, height))
        x = x0 + (rows + 0.5 - y0) * (x1 - x0) / ((y1 - y0) or 1.0)  # a level edge crosses no row
        crossings[rows, np.clip(np.ceil(x - 0.5), 0, width).astype(int)] += 1
    return np.cumsum(crossings, axis=1)[:, :width] % 2 == 1


def _hand_side(wrist: npt.NDArray[np.float64], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Samples to the left of one who walks from the wrist's first end to its second (with y down: fingers up, then)."""
    (x0, y0), (x1, y1) = wrist
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return (x1 - x0) * (rows + 0.5 - y0) - (y1 - y0) * (columns + 0.5 - x0) <= 0
