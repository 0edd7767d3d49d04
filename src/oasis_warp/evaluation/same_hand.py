"""Evaluate avatars on photos of the same hands: appearance from one photo, pose from another."""

import functools
import json
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp import __version__
from oasis_warp.avatar.appearance import label_regions, region_masks
from oasis_warp.avatar.observation import Observation, inner_mask, observe
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.bands import split_bands
from oasis_warp.core.color import cielab
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import HandCrop, HandPose, Landmarks, Photo, Render
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.estimation.hand_crop import crop_hand, initial_offsets
from oasis_warp.evaluation.band_energy import BANDS, FEWEST, SIZE, Contrasts, contrasts, log_brightness
from oasis_warp.evaluation.methods import EVEN, KEEP, ONE_SHOT, RAW, Method, method_name, prior_digest
from oasis_warp.evaluation.metrics import COVERED, color_gain
from oasis_warp.evaluation.pictures import tile, write_sheet, write_strip
from oasis_warp.evaluation.summary import Record, read_result, select
from oasis_warp.evaluation.views import read_crop, read_surface
from oasis_warp.fitted_avatar import draw_as_photo, make_avatar
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import masked_psnr, ssim_map
from oasis_warp.reconstruction import Reconstruction, reconstruct

JUDGED = {"psnr": 1, "ssim_quarter": 1, "error": -1}
"""Measures by which methods are compared on a pair, and whether more or less is better."""
PHOTO_METHODS = (
    Method("mean", ONE_SHOT),
    Method("learned", RAW),
    Method("learned", EVEN),
    Method("learned", KEEP),
    Method("learned", ONE_SHOT),
)
"""Methods of the table."""
LIGHTS: dict[str, Literal["fit", "even", "keep"]] = {RAW: "fit", EVEN: "even", KEEP: "keep", ONE_SHOT: "fit"}
"""Light of the reconstruction by stage; on the surface of the first stands the guess."""
SETTINGS, METRICS, SHEET, HANDS = "evaluation.json", "metrics.json", "sheet.png", "hands"
"""Files that an evaluation writes; the last is a folder with the results of each hand."""
SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp"})
SHOWN = 2
"""Pairs of each hand on the sheet."""
DIGITS = 5
CONTRASTS = tuple(f"contrast {band}" for band in BANDS)
CHROMA = "chroma_seen", "chroma_hidden", "chroma_between"
"""Of skin that the first photo shows well, of skin that it hides, and of the difference of both, which exposure and
white balance hardly change."""
MEASURES = (
    "psnr", "psnr_plain", "ssim_quarter", "overlap", "error", "error_palm", "error_back", "error_nail", *CHROMA,
    *CONTRASTS,
)  # fmt: skip
"""Measures of a pair; an error of colours or the contrasts are missing where too little of the skin is seen."""
QUARTER = 4
"""Side of the blocks on which structure is compared [px]: a small pose error moves all detail."""
MIN_VERTICES = 20
"""Fewest vertices of a region whose colour is compared."""
MIN_SHARE = 0.05
"""Least share of the hand's interior whose a* and b* are compared."""
PAINTED = 0.9
"""Share of paint from which skin counts as hidden; below the rest it counts as seen."""


class PairScore(NamedTuple):
    """An avatar, drawn in the pose and view of another photo of the same hand, compared inside both masks."""

    psnr: float
    """After one gain per channel, since exposure and white balance differ between photos [dB]."""
    psnr_plain: float
    """Without it [dB]."""
    ssim_quarter: float
    """At a quarter of the size, after the gain."""
    region_errors: dict[str, float]
    """Distance of the mean colours of each region that the other photo shows [sRGB], after the gain."""
    overlap: float
    """Intersection over union of the drawn hand and the other photo's mask."""
    chroma_errors: dict[str, float]
    """By `CHROMA`, the distance of the mean a* and b* (CIELAB), without a gain. Empty for an avatar without paint."""
    contrasts: Contrasts | None
    """Contrast of the drawn skin over that of the other photo, by the size of detail (`band_energy.BANDS`); None where
    too little is seen, or where pictures are not of `band_energy.SIZE`."""


class Pair(NamedTuple):
    """Avatars of the photo `source` beside the photo `target`; pictures of left hands are mirrored."""

    source: str
    target: str
    photo: Float[Tensor, "S S 3"]
    drawn: dict[str, Float[Tensor, "S S 3"]]
    scores: dict[str, PairScore]
    """By name of the avatar, as `drawn`."""


def compare_pairs(
    estimator: HandEstimator,
    photos: Mapping[str, tuple[Photo, Landmarks]],
    avatars: Mapping[str, Mapping[str, Avatar]],
    config: ReconstructConfig,
) -> Iterator[Pair]:
    """Every ordered pair of different photos that show the same side; pose and camera of the second are estimated.

    Args:
        estimator: Fits the second photo, with the shape of the first one's avatars.
        photos: Photos of one hand, and where it is in each.
        avatars: By photo and then by a name, all of one photo with the same shape; photos without are targets only.
        config: Size of the pictures and device.
    """
    for target, (photo, landmarks) in photos.items():
        for source, made in avatars.items():
            if source == target or not made:
                continue
            first = next(iter(made.values()))
            fit = estimator.fit(photo, landmarks, shape=first.shape.cpu(), force=True)
            if fit.side != first.side:
                continue
            crops = {name: crop_hand(photo, fit, each.surface_offsets.cpu(), config) for name, each in made.items()}
            drawn = {name: draw_as_photo(avatar, crops[name], fit.pose) for name, avatar in made.items()}
            scores = {
                name: compare_with_photo(avatar, drawn[name], crops[name], fit.pose) for name, avatar in made.items()
            }
            shown = next(iter(crops.values())).image
            yield Pair(source, target, shown, {name: what.image for name, what in drawn.items()}, scores)


@torch.no_grad()
def compare_with_photo(avatar: Avatar, drawn: Render, crop: HandCrop, pose: HandPose) -> PairScore:
    """Compare what `draw_as_photo` drew of `avatar` in `pose` with the photo of `crop`."""
    image, alpha = drawn
    judged = crop.above_wrist > 0.5
    mask = (crop.mask > 0.5) & judged
    weight = ((inner_mask(crop.mask) > 0.5) & (alpha >= COVERED) & judged).to(image)
    gain = color_gain(image, crop.image, weight)
    matched = (image * gain).clamp(0, 1)
    covered = (alpha > 0.5) & judged
    return PairScore(
        psnr=masked_psnr(matched, crop.image, weight),
        psnr_plain=masked_psnr(image, crop.image, weight),
        ssim_quarter=_small_ssim(matched, crop.image, weight),
        region_errors=_region_errors(avatar, avatar.pose(pose).colors, crop, gain),
        overlap=float((covered & mask).sum() / (covered | mask).sum().clamp_min(1)),
        chroma_errors=_chroma_errors(avatar, drawn, crop) if len(image) == SIZE else {},
        contrasts=_contrast_ratios(image, alpha, crop) if len(image) == SIZE else None,
    )


def _chroma_errors(avatar: Avatar, drawn: Render, crop: HandCrop) -> dict[str, float]:
    if avatar.invented is None:
        return {}
    hand, posed = avatar.hand, crop.posed.vertices
    paint = read_surface(hand, posed, crop.camera, avatar.invented, label_regions(hand).palm).visibility
    where = read_crop(crop).interior & (drawn.alpha >= COVERED)
    shifts = {}
    for name, part in zip(CHROMA[:2], (where & (paint <= 1 - PAINTED), where & (paint >= PAINTED)), strict=True):
        if int(part.sum()) > max(FEWEST, MIN_SHARE * int(where.sum())):
            own, true = (cielab(image.clamp(0, 1)[part])[:, 1:].mean(0) for image in (drawn.image, crop.image))
            shifts[name] = own - true
    if len(shifts) == 2:
        shifts[CHROMA[2]] = shifts[CHROMA[1]] - shifts[CHROMA[0]]
    return {name: float(shift.norm()) for name, shift in shifts.items()}


def _contrast_ratios(image: Tensor, alpha: Tensor, crop: HandCrop) -> Contrasts | None:
    """Contrasts of what was drawn over those of the photo, on the same pixels, away from all outlines."""
    where = read_crop(crop).interior & (alpha >= COVERED)
    own, true = (
        contrasts([(split_bands(log_brightness(picture), where.to(picture)), where)]) for picture in (image, crop.image)
    )
    return None if own is None or true is None else tuple(a / max(b, 1e-6) for a, b in zip(own, true, strict=True))


def _small_ssim(image: Tensor, target: Tensor, weight: Tensor) -> float:
    """SSIM of the mean colours of blocks, over black beyond `weight`."""
    planes = torch.cat([image * weight[..., None], target * weight[..., None], weight[..., None]], -1)
    small = avg_pool2d(planes.permute(2, 0, 1), QUARTER).permute(1, 2, 0)
    share = small[..., 6]
    similarity = ssim_map(small[..., :3], small[..., 3:6])
    return float((similarity * share).sum() / share.sum().clamp_min(1e-6))


def _region_errors(avatar: Avatar, lit: Float[Tensor, "N 3"], crop: HandCrop, gain: Tensor) -> dict[str, float]:
    hand, index = avatar.hand, avatar.gaussians.vertex_index
    seen: Observation = observe(hand, crop)
    colors, present = torch.zeros_like(seen.colors), torch.zeros_like(seen.confidence)
    colors[index], present[index] = lit[: len(index)], 1
    errors = {}
    for name, where in region_masks(label_regions(hand)).items():
        weight = (where * seen.confidence * present)[:, None]
        if float(weight.sum()) < MIN_VERTICES:
            continue
        difference = ((colors * gain - seen.colors) * weight).sum(0) / weight.sum()
        errors[name] = float(difference.norm())
    return errors


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
        if len(photos := photos_in(inner)) > 1:
            hands[inner.name] = photos
    if not hands and len(photos := photos_in(folder)) > 1:
        hands[folder.resolve().name] = photos
    if not hands:
        raise InputError(
            f"{folder}: expected two photos of one hand or more, or a subfolder with them for each hand, found none."
        )
    return hands


def photos_in(folder: Path) -> list[Path]:
    """The photos in `folder` itself, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


def evaluate_photos(
    priors: Mapping[str, Prior],
    folder: Path,
    out: Path,
    config: ReconstructConfig,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make avatars of every photo, compare each with the other photos of its hand, and return the contents of METRICS.

    An interrupted run goes on with the hands that are missing. Photos that show no hand, or that no pose fits, are left
    out and named in METRICS.

    Args:
        priors: By the names of methods' priors: "mean" and, if there is one, "learned".
        folder: See `photos_of_hands`.
        out: Output folder.
        config: Its steps, seed and device are used, and its size for the pictures that are compared.
        progress: Called for photos and pairs.

    Raises:
        InputError: a folder that cannot be used, or no photo of which an avatar can be made.
    """
    hands = photos_of_hands(folder)
    methods = [method for method in PHOTO_METHODS if method.prior in priors]
    noted = {"steps": config.steps, "seed": config.seed, "size": config.size}
    config = ReconstructConfig(**noted, device=config.device)
    settings = {
        "version": __version__,
        "priors": {name: prior_digest(prior) for name, prior in priors.items()},
        "photos": {name: [path.name for path in paths] for name, paths in hands.items()},
        **noted,
    }
    open_resumable_folder(out, SETTINGS, settings, "an evaluation")
    (out / HANDS).mkdir(exist_ok=True)
    for name, paths in hands.items():
        file = out / HANDS / f"{name}.json"
        if _kept(file) is None:
            _measure_hand(name, paths, priors, methods, config, file, progress)
    found = [json.loads((out / HANDS / f"{name}.json").read_bytes()) for name in hands]
    pairs = [pair for hand in found for pair in hand["pairs"]]
    if not pairs:
        raise InputError(f"{folder}: no hand has two photos from which avatars could be made; see {out / HANDS}.")
    strips = [path for name in hands if (path := out / HANDS / f"{name}.png").exists()]
    write_sheet(out / SHEET, strips, ["looks of", "pose of", *map(method_name, methods)])
    left_out = {name: why for hand in found for name, why in hand["left_out"].items()}
    whole = {"settings": settings, "summary": summarise_pairs(pairs), "left_out": left_out, "pairs": pairs}
    write_file(out / METRICS, json.dumps(whole, allow_nan=False).encode())
    return whole


def _kept(file: Path) -> Record | None:
    """The pairs of one hand, where they have been measured."""
    return read_result(file, ("pairs", "left_out"), [path for path in (file.with_suffix(".png"),) if path.exists()])


def _measure_hand(
    name: str, paths: Sequence[Path], priors: Mapping[str, Prior], methods: Sequence[Method],
    config: ReconstructConfig, file: Path, progress: Progress,
) -> None:  # fmt: skip
    """Write pictures of a few pairs, then the records of one hand."""
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
            avatars[path.name], crops[path.name] = make_avatars(photo, priors, methods, config)
        except InputError as error:
            left_out[f"{name}/{path.name}"] = str(error)
    progress(stage, len(paths), len(paths))
    records, rows = [], []
    total = len(avatars) * (len(photos) - 1)
    for k, pair in enumerate(compare_pairs(estimator, photos, avatars, config)):
        records += [_record(name, pair, method) for method in methods]
        if len(rows) < SHOWN and pair.source not in [shown for shown, _ in rows]:
            drawn = [pair.drawn[method_name(method)] for method in methods]
            rows.append((pair.source, [tile(picture) for picture in (crops[pair.source], pair.photo, *drawn)]))
        progress(f"pairs of {name}", k + 1, total)
    if rows:
        write_strip(file.with_suffix(".png"), [tiles for _, tiles in rows])
    write_file(file, json.dumps({"pairs": records, "left_out": left_out}, allow_nan=False).encode())


def make_avatars(
    photo: Photo, priors: Mapping[str, Prior], methods: Sequence[Method], config: ReconstructConfig
) -> tuple[dict[str, Avatar], Float[Tensor, "S S 3"]]:
    """Avatars of one photo by the names of methods, and its crop.

    Avatars are made by `reconstruct`, with all detail of the photo, whatever the size of pictures in `config`. The
    prior's own guess is put on the surface that `reconstruct` finds with it.
    """

    @functools.cache
    def reconstruct_with(prior: str, light: Literal["fit", "even", "keep"]) -> Reconstruction:
        return reconstruct(photo, replace(config, size="auto", light=light), prior=priors[prior])

    hand, avatars = bundled_hand(), {}
    for method in methods:
        made = reconstruct_with(method.prior, LIGHTS[method.stage])
        avatar = made.avatar
        if method.stage == RAW:
            crop = crop_hand(photo, made.fit, initial_offsets(hand, made.fit), replace(config, size="auto"))
            avatar = make_avatar(made.fit, avatar.surface_offsets, crop, priors[method.prior](crop))
        avatars[method_name(method)] = avatar
    made = reconstruct_with(methods[-1].prior, LIGHTS[methods[-1].stage])
    return avatars, crop_hand(photo, made.fit, made.avatar.surface_offsets.cpu(), config).image


def _record(hand: str, pair: Pair, method: Method) -> Record:
    score: PairScore = pair.scores[method_name(method)]
    numbers = {name: getattr(score, name) for name in ("psnr", "psnr_plain", "ssim_quarter", "overlap")}
    errors = score.region_errors
    numbers |= {f"error_{region}": value for region, value in errors.items()}
    if errors:
        numbers["error"] = statistics.fmean(errors.values())
    numbers |= score.chroma_errors
    if score.contrasts is not None:
        numbers |= dict(zip(CONTRASTS, score.contrasts, strict=True))
    return {
        "hand": hand,
        "source": pair.source,
        "target": pair.target,
        **method._asdict(),
        **{name: round(value, DIGITS) for name, value in numbers.items()},
    }


def summarise_pairs(pairs: Sequence[Record]) -> list[Record]:
    """A row for each method: medians over pairs, and the share of pairs on which the last method is better."""
    rows, best = [], PHOTO_METHODS[-1]
    for method in PHOTO_METHODS:
        own = select(pairs, **method._asdict())
        if not own:
            continue
        row: Record = {**method._asdict(), "pairs": len(own)}
        for name in MEASURES:
            values = [pair[name] for pair in own if name in pair]
            row[name] = statistics.median(values) if values else None
        for name in JUDGED:
            changes = [] if method == best else gains(pairs, best, method, name)
            row[f"beaten_{name}"] = sum(change > 0 for change in changes) / len(changes) if changes else None
        rows.append(row)
    return rows


def gains(pairs: Sequence[Record], method: Method, other: Method, measure: str) -> list[float]:
    """By how much `method` is better than `other`, by one of `JUDGED`, on each pair for which both have it."""
    of_method = {_pair_key(pair): pair for pair in select(pairs, **method._asdict()) if measure in pair}
    return [
        JUDGED[measure] * (of_method[_pair_key(pair)][measure] - pair[measure])
        for pair in select(pairs, **other._asdict())
        if measure in pair and _pair_key(pair) in of_method
    ]


def _pair_key(pair: Record) -> tuple[str, str, str]:
    return pair["hand"], pair["source"], pair["target"]
