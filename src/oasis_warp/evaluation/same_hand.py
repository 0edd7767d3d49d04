"""Evaluate avatars on real photos of the same hands: the looks from one photo, the pose from another."""

import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from oasis_warp import __version__
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Landmarks, Photo
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation.methods import EVEN, KEEP, ONE_SHOT, RAW, Method, label, prior_digest, reconstructions
from oasis_warp.evaluation.photo_pairs import Pair, PairScore, compare_pairs
from oasis_warp.evaluation.pictures import tile, write_sheet, write_strip
from oasis_warp.evaluation.summary import Record, select
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.reconstruction import crop_hand, initial_offsets, make_avatar

PHOTO_METHODS = (
    Method("mean", ONE_SHOT),
    Method("learned", RAW),
    Method("learned", EVEN),
    Method("learned", KEEP),
    Method("learned", ONE_SHOT),
)
"""No prior, no adaptation, and both."""
SETTINGS, METRICS, SHEET, HANDS = "evaluation.json", "metrics.json", "sheet.png", "hands"
"""What an evaluation leaves in its folder; the last is a folder of what was found of each hand."""
SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp"})
SHOWN = 2
"""Pairs of each hand on the sheet."""
DIGITS = 5


def photos_of_hands(folder: Path) -> dict[str, list[Path]]:
    """The photos in each subfolder of `folder` that holds two or more, in the order of their names.

    Where no subfolder does, the photos of `folder` itself are those of one hand.

    Raises:
        InputError: no folder, or none with two photos.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: expected a folder with a subfolder of photos for each hand, found {found}.")
    hands = {}
    for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
        if len(photos := _photos_in(inner)) > 1:
            hands[inner.name] = photos
    if not hands and len(photos := _photos_in(folder)) > 1:
        hands[folder.resolve().name] = photos
    if not hands:
        raise InputError(
            f"{folder}: expected two photos of one hand or more, or a subfolder with them for each hand, found none."
        )
    return hands


def _photos_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


def evaluate_photos(
    priors: Mapping[str, Prior],
    folder: Path,
    out: Path,
    config: ReconstructConfig,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make avatars of every photo and hold each against the other photos of its hand; what METRICS then holds.

    A run that was stopped goes on with the hands that are missing. Photos that show no hand, or that no pose fits, are
    named and left out.

    Args:
        priors: By the names that methods have for them: "mean", and "learned" where there is one.
        folder: See `photos_of_hands`.
        out: Where files go; its parent must exist.
        config: Its steps, seed, size and device are used.
        progress: Told of photos and pairs.

    Raises:
        InputError: a folder that cannot be used, or no photo of which an avatar can be made.
    """
    hands = photos_of_hands(folder)
    methods = [method for method in PHOTO_METHODS if method.prior in priors]
    settings = {
        "version": __version__,
        "priors": {name: prior_digest(prior) for name, prior in priors.items()},
        "photos": {name: [path.name for path in paths] for name, paths in hands.items()},
        **{name: getattr(config, name) for name in ("steps", "seed", "size")},
    }
    open_resumable_folder(out, SETTINGS, settings, "an evaluation")
    (out / HANDS).mkdir(exist_ok=True)
    for name, paths in hands.items():
        place = out / HANDS / f"{name}.json"
        if not place.exists():
            _measure_hand(name, paths, priors, methods, config, place, progress)
    found = [json.loads((out / HANDS / f"{name}.json").read_text()) for name in hands]
    pairs = [pair for hand in found for pair in hand["pairs"]]
    if not pairs:
        raise InputError(f"{folder}: of no hand are there two photos that avatars can be made of; see {out / HANDS}.")
    strips = [path for name in hands if (path := out / HANDS / f"{name}.png").exists()]
    write_sheet(out / SHEET, strips, ["looks of", "pose of", *map(label, methods)])
    left_out = {name: why for hand in found for name, why in hand["left_out"].items()}
    whole = {"settings": settings, "summary": summarise_pairs(pairs), "left_out": left_out, "pairs": pairs}
    write_file(out / METRICS, json.dumps(whole, allow_nan=False).encode())
    return whole


def _measure_hand(
    name: str, paths: Sequence[Path], priors: Mapping[str, Prior], methods: Sequence[Method],
    config: ReconstructConfig, place: Path, progress: Progress,
) -> None:  # fmt: skip
    """Write the records of one hand, and pictures of a few pairs; the records last."""
    estimator = HandEstimator(bundled_hand())
    photos: dict[str, tuple[Photo, Landmarks]] = {}
    avatars: dict[str, dict[str, Avatar]] = {}
    crops, left_out = {}, {}
    stage = f"avatars of {name}"
    for k, path in enumerate(paths):
        progress(stage, k, len(paths))
        try:
            photo = read_photo(path)
            photos[path.name] = photo, choose_hand(estimator.find(photo), "largest", photo.name)
            avatars[path.name], crops[path.name] = _make_avatars(estimator, *photos[path.name], priors, methods, config)
        except InputError as error:
            left_out[f"{name}/{path.name}"] = str(error)
    progress(stage, len(paths), len(paths))
    records, rows = [], []
    total = len(avatars) * (len(photos) - 1)
    for k, pair in enumerate(compare_pairs(estimator, photos, avatars, config)):
        records += [_record(name, pair, method) for method in methods]
        if len(rows) < SHOWN and pair.source not in [shown for shown, _ in rows]:
            drawn = [pair.drawn[label(method)] for method in methods]
            rows.append((pair.source, [tile(picture) for picture in (crops[pair.source], pair.photo, *drawn)]))
        progress(f"pairs of {name}", k + 1, total)
    if rows:
        write_strip(place.with_suffix(".png"), [tiles for _, tiles in rows])
    write_file(place, json.dumps({"pairs": records, "left_out": left_out}, allow_nan=False).encode())


def _make_avatars(
    estimator: HandEstimator, photo: Photo, landmarks: Landmarks, priors: Mapping[str, Prior],
    methods: Sequence[Method], config: ReconstructConfig,
):  # fmt: skip
    """Avatars of one photo by the labels of methods, and its crop; the photo is fitted once."""
    hand = bundled_hand()
    fit = estimator.fit(photo, landmarks)
    offsets = initial_offsets(hand, fit)
    crop = crop_hand(photo, fit, offsets, config)
    settings = AdaptConfig(texture_steps=config.steps, seed=config.seed)
    avatars = {
        label(method): make_avatar(fit, offsets, crop, *made)
        for method, made in reconstructions(hand, crop, priors, methods, settings)
    }
    return avatars, crop.image


def _record(hand: str, pair: Pair, method: Method) -> Record:
    score: PairScore = pair.scores[label(method)]
    numbers = {name: getattr(score, name) for name in ("psnr", "psnr_plain", "ssim_quarter", "overlap")}
    errors = score.region_errors
    numbers |= {f"error_{region}": value for region, value in errors.items()}
    if errors:
        numbers["error"] = statistics.fmean(errors.values())
    return {
        "hand": hand,
        "source": pair.source,
        "target": pair.target,
        **method._asdict(),
        **{name: round(value, DIGITS) for name, value in numbers.items()},
    }


MEASURES = (
    "psnr", "psnr_plain", "ssim_quarter", "overlap", "error", "error_palm", "error_back", "error_nail"
)  # fmt: skip
"""Of a pair; an error of colours is missing where too little of the region is seen."""


def summarise_pairs(pairs: Sequence[Record]) -> list[Record]:
    """A row a method: medians over pairs, and on which share of them the last method does better than this one."""
    rows, best = [], PHOTO_METHODS[-1]
    of_best = {_who(pair): pair for pair in select(pairs, **best._asdict())}
    for method in PHOTO_METHODS:
        own = select(pairs, **method._asdict())
        if not own:
            continue
        row: Record = {**method._asdict(), "pairs": len(own)}
        for name in MEASURES:
            values = [pair[name] for pair in own if name in pair]
            row[name] = statistics.median(values) if values else None
        for name, sign in (("psnr", 1), ("ssim_quarter", 1), ("error", -1)):
            changes = [
                sign * (of_best[_who(pair)][name] - pair[name])
                for pair in own
                if _who(pair) in of_best and name in pair and name in of_best[_who(pair)]
            ]
            compared = bool(changes) and method != best
            row[f"beaten_{name}"] = sum(change > 0 for change in changes) / len(changes) if compared else None
        rows.append(row)
    return rows


def _who(pair: Record) -> tuple[str, str, str]:
    return pair["hand"], pair["source"], pair["target"]
