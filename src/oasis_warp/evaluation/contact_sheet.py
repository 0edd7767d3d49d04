"""Contact sheets: photo and avatar in the photo's view, from eight sides and in eight poses, large enough to judge."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import contact_sheet, to_uint8, write_picture

COLUMNS = 6
"""Cells in a row of a sheet."""
GAP = 2
"""Between cells [px]."""
SMALL = 256
"""Side of a cell of the overview [px]."""
INK = (60, 60, 60)

Cell = tuple[Float[Tensor, "S S 3"], str]
"""A picture and a few words."""


def write_cells(path: Path, cells: Sequence[Cell], columns: int = COLUMNS) -> None:
    """Write labelled pictures of one size in rows of `columns`."""
    labelled = torch.stack([_label(image, words).float() / 255 for image, words in cells])
    write_picture(path, to_uint8(contact_sheet(labelled, columns, GAP)))


def write_overview(path: Path, sheets: Sequence[Path], shown: Sequence[int], columns: int = COLUMNS) -> None:
    """Write the cells numbered `shown` of each sheet, made smaller, as a row.

    Raises:
        InputError: a sheet cannot be read.
    """
    rows = []
    for sheet in sheets:
        pixels = read_photo(sheet).rgb.numpy()
        side = (pixels.shape[1] - (columns - 1) * GAP) // columns
        for k in shown:
            top, left = k // columns * (side + GAP), k % columns * (side + GAP)
            cell = pixels[top : top + side, left : left + side]
            rows.append(torch.from_numpy(cv2.resize(cell, (SMALL, SMALL), interpolation=cv2.INTER_AREA)))
    write_picture(path, to_uint8(contact_sheet(torch.stack(rows).float() / 255, len(shown), GAP)))


def _label(image: Tensor, words: str) -> UInt8[Tensor, "S S 3"]:
    pixels = np.ascontiguousarray(to_uint8(image).numpy())
    size = max(12, len(pixels) // 28)
    cv2.putText(pixels, words, (8, size + 6), INK, cv2.FontFace("sans"), size, 400)
    return torch.from_numpy(pixels)
