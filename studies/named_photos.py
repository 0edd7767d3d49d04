"""Photos by name: files, and synthetic hands that no training has met, which can be of any size."""

from pathlib import Path

import torch

from oasis_warp.core.types import Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation.held_out import FIRST_PERSON, Shoot, photograph

SYNTHETIC = "synthetic:"


def photo_of(name: str, size: int, device: str) -> Photo:
    """The photo of a file; or, for "synthetic:K", of person K in even light before a plain wall, `size` px at least."""
    if not name.startswith(SYNTHETIC):
        return read_photo(Path(name))
    number = FIRST_PERSON + int(name.removeprefix(SYNTHETIC))
    session = photograph(Shoot(size=size, targets=1), "ordinary", number, torch.device(device))
    return Photo((session.photos["studio"].image[0] * 255).round().to(torch.uint8).cpu(), None, None, name, 1.0)
