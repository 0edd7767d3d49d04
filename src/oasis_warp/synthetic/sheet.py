"""A contact sheet: many small pictures on one."""

import torch
from jaxtyping import Float
from torch import Tensor


def contact_sheet(images: Float[Tensor, "N H W 3"], columns: int, gap: int = 2) -> Float[Tensor, "R C 3"]:
    """Pictures side by side in rows of `columns`, white between them."""
    n, height, width = images.shape[:3]
    rows = -(-n // columns)
    sheet = torch.ones(rows * (height + gap) - gap, columns * (width + gap) - gap, 3)
    for k, image in enumerate(images.cpu()):
        y, x = k // columns * (height + gap), k % columns * (width + gap)
        sheet[y : y + height, x : x + width] = image
    return sheet
