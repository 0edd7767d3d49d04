"""Draw what each prior makes of real photos, before and after adaptation: a row a photo.

    python studies/compare_priors.py docs/_static/priors.jpg tests/data/photos/*_*.*
    python studies/compare_priors.py out/own.jpg photo.jpg --prior none --prior learned --prior network.safetensors

Each row shows the photo's crop and then, for every prior, the hand that it guesses and the hand that adaptation makes
of that guess, each as the photo shows it, from the side and from behind.
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.network.prior import choose_prior
from oasis_warp.reconstruction import crop_hand, initial_offsets, make_avatar

UNSEEN = (90, 180)
"""Where the hand is looked at from, beside the photo's own view [degrees]."""
HEADING, GAP = 34, 6
"""Rows of pixels above the pictures; columns between what belongs to different priors."""
FONT, INK, PAPER = cv2.FONT_HERSHEY_SIMPLEX, (60, 60, 60), 245


def views(avatar: Avatar, side: int) -> torch.Tensor:
    """The photo's view and the unseen ones, side by side [side, 3 side, 3]."""
    vertices = avatar.mesh(avatar.source_pose).vertices
    cameras = [avatar.source_camera]
    cameras += [orbit_camera(vertices, math.radians(azimuth), size=256) for azimuth in UNSEEN]
    return torch.cat([shrink(avatar.render(camera, avatar.source_pose).image, side) for camera in cameras], dim=1)


def shrink(image: torch.Tensor, side: int) -> torch.Tensor:
    """`image` in `side` x `side` pixels, each the mean of those that it replaces."""
    return torch.from_numpy(cv2.resize(image.detach().numpy(), (side, side), interpolation=cv2.INTER_AREA))


def row(path: Path, priors: list[str], side: int) -> torch.Tensor:
    """The pictures of one photo.

    Raises:
        InputError: it shows no hand.
    """
    hand, photo = bundled_hand(), read_photo(path)
    estimator, config = HandEstimator(hand), ReconstructConfig()
    fit = estimator.fit(photo, choose_hand(estimator.find(photo), config.hand, photo.name), force=True)
    offsets = initial_offsets(hand, fit)
    crop = crop_hand(photo, fit, offsets, config)
    gap = torch.full((side, GAP, 3), PAPER / 255)
    parts = [shrink(crop.image.flip(1) if fit.side == "left" else crop.image, side)]
    for name in priors:
        guess = choose_prior(name if name in ("learned", "none") else Path(name))(crop)
        adapted = adapt(hand, guess, crop)
        for gaussians, light in ((guess, None), (adapted.gaussians, adapted.light)):
            parts += [gap, views(make_avatar(fit, offsets, crop, gaussians, light), side)]
    return torch.cat(parts, dim=1)


def heading(priors: list[str], width: int, side: int) -> torch.Tensor:
    """What the columns show."""
    paper = np.full((HEADING, width, 3), PAPER, np.uint8)
    places = {"photo": 4}
    for number, name in enumerate(priors):
        for half, words in enumerate(("its guess", "adapted")):
            places[f"prior {Path(name).stem}: {words}"] = side + GAP + (2 * number + half) * (3 * side + GAP)
    for text, left in places.items():
        cv2.putText(paper, text, (left, HEADING - 12), FONT, 0.5, INK, 1, cv2.LINE_AA)
    return torch.from_numpy(paper)


def main() -> None:
    """Draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sheet", type=Path, help="picture to write")
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--prior", action="append", help="none, learned or a weights file; none and learned by default")
    parser.add_argument("--side", type=int, default=120, help="of each picture [px]")
    options = parser.parse_args()
    priors = options.prior or ["none", "learned"]
    rows = []
    for path in options.photos:
        try:
            rows.append(to_uint8(row(path, priors, options.side)))
        except InputError as error:
            print(f"left out: {error}")
    if rows:
        write_picture(options.sheet, torch.cat([heading(priors, rows[0].shape[1], options.side), *rows]))


if __name__ == "__main__":
    main()
