"""Evaluate the looks of avatars of single photos: contrasts, distances to real hands, blemishes, contact sheets."""

import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from oasis_warp import __version__
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.data.output_files import check_apart, open_resumable_folder, write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.evaluation.band_energy import BANDS
from oasis_warp.evaluation.kernel_distance import (
    MIN_GROUPS,
    KernelDistance,
    Sample,
    kernel_distances,
)
from oasis_warp.evaluation.look_measures import measure_looks
from oasis_warp.evaluation.methods import prior_digest
from oasis_warp.evaluation.pictures import write_cells, write_overview
from oasis_warp.evaluation.real_hands import measure_real, real_photos, reference_contrasts
from oasis_warp.evaluation.same_hand import photos_in
from oasis_warp.evaluation.summary import Record, read_result
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses import Perceptual
from oasis_warp.reconstruction import reconstruct

SETTINGS, METRICS, OVERVIEW = "evaluation.json", "metrics.json", "overview.jpg"
AVATARS, REAL, SHEETS = "avatars", "real", "sheets"
"""Files and folders that an evaluation writes; those of REAL are measures of the photos themselves."""
IN_OVERVIEW = (0, 1, 4, 6, 8, 10, 12)
"""Cells of a sheet: photo, its view, 90, 180 and 270 degrees, open, fist."""
REGIONS = ("seen", "turned", "hidden_palm", "hidden_back", "painted_palm", "painted_back")
KINDS = {
    "input": "the photo's view", "painted": "the photo's view, painted", "side": "novel sides", "pose": "novel poses"
}  # fmt: skip
SPLITS = 20
"""Random halves of the real hands whose distance is the floor."""
WOUND = 0.4
"""Brightness of the darkest percent of an opened palm, over its median, below which that is a wound: the least of seven
real palms, open or nearly so, is .41."""
DIGITS = 4
"""Digits of numbers over all photos: significant digits of medians, decimals of distances."""


def evaluate_looks(
    prior: Prior,
    folder: Path,
    out: Path,
    config: ReconstructConfig,
    *,
    perceptual: Perceptual | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make an avatar of every photo in `folder`, measure its looks, draw its sheet, and return the contents of METRICS.

    The photos of `folder` and its subfolders are also the real hands of the kernel distance. An interrupted run goes on
    with what is missing. Photos that show no hand, or that no pose fits, are left out and named in METRICS.

    Args:
        prior: Prior of the avatars.
        folder: Folder of photos, each of another hand; a subfolder holds photos of one hand.
        out: Output folder.
        config: Its steps, seed and device are used; all else is as `reconstruct` ships it.
        perceptual: LPIPS, where its weights are at hand.
        progress: Called for photos.

    Raises:
        InputError: a folder that cannot be used, or no photo of which an avatar can be made.
    """
    photos, groups = find_photos(folder)
    noted = {"steps": config.steps, "seed": config.seed}
    config = ReconstructConfig(**noted, device=config.device)
    settings = {
        "version": __version__, "prior": {"name": prior.about["name"], "weights": prior_digest(prior)},
        "photos": [path.name for path in photos], "real": [path.name for path in groups],
        "lpips": perceptual is not None, **noted,
    }  # fmt: skip
    open_resumable_folder(out, SETTINGS, settings, "an evaluation")
    for inner in (AVATARS, REAL, SHEETS):
        (out / inner).mkdir(exist_ok=True)
    real, out_real = measure_all_real(groups, out / REAL, progress)
    found, samples, left_out = {}, {kind: [] for kind in KINDS}, {}
    for k, path in enumerate(photos):
        progress("avatars", k, len(photos))
        group = hand_of(path, groups)
        made = _measured(path, group, prior, config, out, perceptual)
        if "left_out" in made:
            left_out[path.name] = made["left_out"]
            continue
        for kind in KINDS:
            samples[kind] += [Sample(group, *sample) for sample in made["features"][kind]]
        found[path.name] = {name: value for name, value in made.items() if name != "features"}
    progress("avatars", len(photos), len(photos))
    if not found:
        raise InputError(f"{folder}: no avatar could be made from any photo; see {out / AVATARS}.")
    write_overview(out / OVERVIEW, [out / SHEETS / f"{Path(name).stem}.jpg" for name in found], IN_OVERVIEW)
    whole = {
        "settings": settings,
        "summary": summarise_looks(list(found.values()), reference_contrasts()),
        "kernel_distance": kernel_rows(samples, real),
        "photos": found, "left_out": left_out, "real_left_out": out_real,
    }  # fmt: skip
    write_file(out / METRICS, json.dumps(whole, allow_nan=False).encode())
    return whole


def find_photos(folder: Path) -> tuple[list[Path], dict[Path, str]]:
    """The photos of which avatars are made, and those of real hands with the hand that each one shows.

    Raises:
        InputError: there is none, or the records of two would have one name.
    """
    if not folder.is_dir() or not (photos := photos_in(folder)):
        raise InputError(f"{folder}: expected a folder with photos of hands, found none there.")
    groups = real_photos(folder)
    names = [real_name(path, hand) for path, hand in groups.items()]
    check_apart(photos, [path.stem for path in photos], "record", "rename one of them")
    check_apart(list(groups), names, "record", "rename one of them")
    return photos, groups


def hand_of(path: Path, groups: Mapping[Path, str]) -> str:
    """The hand that a photo shows, by `real_photos`, which may hold it in a subfolder."""
    data = path.read_bytes()
    same = (name for other, name in groups.items() if other == path or other.read_bytes() == data)
    return next(same, path.stem)


def real_name(path: Path, hand: str) -> str:
    """Name of the record of a real photo."""
    return f"{hand}_{path.stem}"


def measure_all_real(
    groups: Mapping[Path, str], folder: Path, progress: Progress = silent
) -> tuple[list[Record], dict[str, str]]:
    """Records of real photos with their `hand`, kept in `folder`, and the reasons of those that are left out."""
    estimator, records, left_out = HandEstimator(bundled_hand()), [], {}
    for k, (path, hand) in enumerate(groups.items()):
        progress("real hands", k, len(groups))
        name = f"{hand}/{path.name}"
        file = folder / f"{real_name(path, hand)}.json"
        record = read_result(file, ("hand", "mostly", "features"))
        if record is None:
            try:
                record = {"hand": hand, "photo": path.name, **measure_real(read_photo(path), estimator)}
            except InputError as error:
                record = {"left_out": str(error)}
            write_file(file, json.dumps(record, allow_nan=False).encode())
            record = json.loads(file.read_bytes())  # with lists, as a kept one has them
        if "left_out" in record:
            left_out[name] = record["left_out"]
        else:
            records.append(record)
    progress("real hands", len(groups), len(groups))
    return records, left_out


def _measured(
    path: Path, group: str, prior: Prior, config: ReconstructConfig, out: Path, perceptual: Perceptual | None
) -> Record:
    """The record of one photo's avatar, from its file if there is one; its sheet is drawn first."""
    file, sheet = out / AVATARS / f"{path.stem}.json", out / SHEETS / f"{path.stem}.jpg"
    record: Record | None = read_result(file, ("contrast", "features", "haze"), [sheet])
    if record is not None:
        return record
    try:
        photo = read_photo(path)
        looks = measure_looks(
            photo, reconstruct(photo, config, prior=prior), group, prior, config.seed, perceptual
        )
    except InputError as error:
        record = {"left_out": str(error)}
    else:
        write_cells(sheet, looks.cells)
        features = {kind: [sample[1:] for sample in own] for kind, own in looks.samples.items()}
        record = {**looks.record, "features": features}
    write_file(file, json.dumps(record, allow_nan=False).encode())
    return json.loads(file.read_bytes())


def relative_contrasts(record: Record, reference: Record) -> dict[str, list[float]]:
    """Contrasts of each of `REGIONS` over the photo's own, or of hidden skin over those of real hands."""
    contrast = record["contrast"]
    yardsticks = {
        "seen": contrast.get("photo"), "turned": contrast.get("photo"),
        **{f"painted_{side}": contrast.get(f"photo_{side}") for side in ("palm", "back")},
        **{f"hidden_{side}": reference.get(side, {}).get("median") for side in ("palm", "back")},
    }  # fmt: skip
    return {
        region: [a / max(b, 1e-6) for a, b in zip(contrast[region], yardstick, strict=True)]
        for region, yardstick in yardsticks.items() if yardstick and region in contrast
    }  # fmt: skip


def summarise_looks(records: Sequence[Record], reference: Record) -> Record:
    """Medians over photos: contrasts [%] and ratios of each region, and of each blemish the median and the worst."""
    contrast: list[Record] = []
    for region in REGIONS:
        own = [record for record in records if region in record["contrast"]]
        ratios = [found[region] for record in own if region in (found := relative_contrasts(record, reference))]
        if ratios:
            drawn = [record["contrast"][region] for record in own]
            contrast.append({
                "region": region, "photos": len(ratios),
                **{f"contrast {band}": _median(v) for band, v in zip(BANDS, zip(*drawn, strict=True), strict=True)},
                **{f"ratio {band}": _median(v) for band, v in zip(BANDS, zip(*ratios, strict=True), strict=True)},
            })  # fmt: skip
    return {"contrast": contrast, "blemishes": summarise_blemishes(records)}


def summarise_blemishes(records: Sequence[Record]) -> Record:
    """Medians over photos; the ratio of the sums of haze; and the share of opened palms with a wound.

    `back_brightness` is the factor by which the back is brighter or darker than the front, `back_hue` that by which its
    brightest channel changes more than the others.
    """
    found: Record = {
        name: _median([record[name] for record in records if record[name] is not None])
        for name in ("input_psnr_db", "haze", "palm_minus_back", "darkest", "lpips")
    }
    of_mean = sum(record["haze_of_mean"] for record in records)
    found["haze_ratio"] = sum(record["haze"] for record in records) / max(of_mean, 1e-9)
    dark = [record["darkest"] < WOUND for record in records if record["darkest"] is not None]
    found["wounded"] = sum(dark) / len(dark) if dark else None
    light = [record["back_over_front"] for record in records if record["back_over_front"] is not None]
    means = [statistics.fmean(ratios) for ratios in light]
    found["back_brightness"] = _median([max(ratio, 1 / ratio) for ratio in means])
    found["back_hue"] = _median([max(ratios) / min(ratios) for ratios in light])
    return found


def kernel_rows(samples: Mapping[str, Sequence[Sample]], real: Sequence[Record], seed: int = 0) -> list[Record]:
    """Distances to real hands by kind of view, with the distance of halves of the real hands, and of palms and backs.

    No rows where there are too few real hands; none of the avatars where there are too few avatars.
    """
    crowd = [Sample(record["hand"], record["mostly"], record["features"]) for record in real]
    backs, palms = ([sample for sample in crowd if sample.mostly == side] for side in ("back", "palm"))
    groups = sorted({sample.group for sample in crowd})
    if len(groups) < 2 * MIN_GROUPS:
        return []
    rows = []
    drawn_backs = [sample for sample in samples["side"] if sample.mostly == "back"]
    pairs = {
        **{KINDS[kind]: (own, crowd) for kind, own in samples.items()},
        "novel sides that show the back, to real backs": (drawn_backs, backs),
        "real palms to real backs": (palms, backs),
    }
    for name, (drawn, others) in pairs.items():
        if min(len({sample.group for sample in part}) for part in (drawn, others)) >= MIN_GROUPS:
            rows.append(_kernel_row(name, len(drawn), kernel_distances(drawn, others, crowd, seed)))
    random, halves = np.random.default_rng(seed), []
    for _ in range(SPLITS):
        half = set(random.permutation(groups)[: len(groups) // 2].tolist())
        parts = [[sample for sample in crowd if (sample.group in half) == inside] for inside in (True, False)]
        halves.append(kernel_distances(*parts, crowd, subsets=0))
    floor = {
        layer: KernelDistance(statistics.fmean(values), statistics.stdev(values))
        for layer in halves[0] if (values := [half[layer].value for half in halves])
    }  # fmt: skip
    return [*rows, _kernel_row("halves of the real hands", len(crowd), floor)]


def _kernel_row(name: str, pictures: int, distances: Mapping[str, KernelDistance]) -> Record:
    numbers = {layer: round(found.value, DIGITS) for layer, found in distances.items()}
    errors = {f"{layer}_error": round(found.error, DIGITS) for layer, found in distances.items()}
    return {"name": name, "pictures": pictures, **numbers, **errors}


def _median(values: Sequence[float]) -> float | None:
    return float(f"{statistics.median(values):.{DIGITS}g}") if values else None
