"""Real hands as the yardstick of looks: contrasts of the skin of palm and back, and features of each photo."""

import hashlib
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.avatar.quality import SEEN
from oasis_warp.core.bands import split_bands
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import HandCrop, Photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.estimation.hand_crop import crop_hand, crop_side, initial_offsets
from oasis_warp.evaluation.band_energy import SIZE, contrasts, darkest_over_median, log_brightness
from oasis_warp.evaluation.kernel_distance import hand_features
from oasis_warp.evaluation.same_hand import photos_in
from oasis_warp.evaluation.summary import Record
from oasis_warp.evaluation.views import GROUND, Surface, read_crop
from oasis_warp.hand.template import bundled_hand

PALM, BACK = 0.7, 0.3
"""Share of the palm from which, and up to which, a pixel counts as palm or back."""
SIDES = ("palm", "back")
MIN_SIDE = 0.75 * SIZE
"""Least side of the square around a hand in its photo [px]: of smaller hands the finest band is empty."""
DIGITS = 3
QUARTILES = 4


def real_photos(folder: Path) -> dict[Path, str]:
    """The photos in `folder` and its subfolders, and the hand that each one shows.

    Photos of one subfolder show one hand; every other shows its own. Of equal files, that of a subfolder is kept.
    """
    found: dict[str, tuple[Path, str]] = {}
    inner = sorted(path for path in folder.rglob("*") if path.is_dir())
    for where in (*inner, folder):
        for path in photos_in(where):
            name = path.stem if where == folder else where.name
            found.setdefault(hashlib.sha256(path.read_bytes()).hexdigest(), (path, name))
    return dict(sorted(found.values()))


def measure_real(photo: Photo, estimator: HandEstimator) -> Record:
    """Contrasts of the side that a photo mostly shows, features, the darkest palm over its median, and the hand's size.

    Of the other side a photo shows slivers, which are mostly outlines and the backs of bent fingers.

    Raises:
        InputError: it shows no hand, or no pose fits.
    """
    fit = estimator.fit(photo, choose_hand(estimator.find(photo), "largest", photo.name))
    crop = crop_hand(photo, fit, initial_offsets(bundled_hand(), fit), ReconstructConfig(size=SIZE))
    surface = read_crop(crop)
    sides = {side: where & (surface.visibility >= SEEN) for side, where in side_masks(surface).items()}
    mostly = mostly_shows(surface)
    bands = split_bands(log_brightness(crop.image), surface.interior.float())
    found = contrasts([(bands, sides[mostly])]) if crop_side(fit) >= MIN_SIDE else None
    return {
        "crop_px": round(crop_side(fit)),
        "mostly": mostly,
        "contrast": {} if found is None else {mostly: found},
        "darkest": darkest_over_median(crop.image, sides["palm"]),
        "features": hand_features(over_ground(crop), crop.mask),
    }


def over_ground(crop: HandCrop) -> Float[Tensor, "S S 3"]:
    """The hand of a photo, cut out, before the colour that drawn hands are drawn before."""
    mask = crop.mask[..., None]
    return crop.image * mask + (1 - mask) * crop.image.new_tensor(GROUND)


def side_masks(surface: Surface) -> dict[str, Tensor]:
    """Pixels of the interior by `SIDES`; those in between belong to neither."""
    return {"palm": surface.interior & (surface.palm >= PALM), "back": surface.interior & (surface.palm <= BACK)}


def mostly_shows(surface: Surface) -> Literal["palm", "back"]:
    """The side of the hand that a picture mostly shows."""
    return "palm" if float(surface.palm[surface.interior].mean()) > 0.5 else "back"


def summarise_real(records: Sequence[Record]) -> Record:
    """The number of photos and hands of each of `SIDES`, and quartiles of the contrasts of photos."""
    table: Record = {}
    for side in SIDES:
        own = [record for record in records if side in record["contrast"]]
        bands = list(zip(*(record["contrast"][side] for record in own), strict=True))
        if len(own) < QUARTILES:
            continue
        quartiles = [statistics.quantiles(band, n=QUARTILES, method="inclusive") for band in bands]
        low, median, high = zip(*quartiles, strict=True)
        table[side] = {
            "photos": len(own), "hands": len({record["hand"] for record in own}),
            **{name: [round(value, DIGITS) for value in values]
               for name, values in (("quarter", low), ("median", median), ("three_quarters", high))},
        }  # fmt: skip
    return table


def reference_contrasts() -> Record:
    """The table of `summarise_real` that ships; `python -m studies real_hands` measured it."""
    return json.loads(asset("evaluation", "real_hands.json").read_text())
