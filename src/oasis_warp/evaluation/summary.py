"""Aggregate the scores of single pictures into the rows of tables; headings and formats of their columns.

Results of one person, hand or photo are kept, so that an evaluation that was stopped goes on with the others.
"""

import json
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import logger
from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation.band_energy import BANDS
from oasis_warp.evaluation.kernel_distance import LAYERS
from oasis_warp.evaluation.methods import BASELINE, STAGES
from oasis_warp.evaluation.metrics import MEASURES

Record = dict[str, Any]
"""One rendered picture: `KEYS`, person, target and `MEASURES`."""
KEYS = ("group", "light", "noise", "colors", "prior", "stage")
"""Keys of a row of the summary; `colors` are "raw", or "matched" to the target by one gain per channel."""


class Difference(NamedTuple):
    """Difference of one measure between two methods on the same pictures."""

    mean: float
    error: float | None
    """Standard error; None of a single person."""
    better: float
    """Share of people for whom it rose."""


def select(records: Iterable[Record], **wanted: object) -> list[Record]:
    """The records with these values."""
    return [record for record in records if all(record[key] == value for key, value in wanted.items())]


def mean(records: Iterable[Record], measure: str) -> float | None:
    """Mean of a measure over the pictures that have it."""
    values = [record[measure] for record in records if record[measure] is not None]
    return statistics.fmean(values) if values else None


def difference(records: Sequence[Record], reference: Sequence[Record], measure: str) -> Difference | None:
    """Difference of `records` from `reference`; None if they have no picture in common.

    Each person counts once, since pictures of one hand are not independent.
    """
    before = {_place(record): record[measure] for record in reference}
    by_person = defaultdict(list)
    for record in records:
        old, new = before.get(_place(record)), record[measure]
        if old is not None and new is not None:
            by_person[record["person"]].append(new - old)
    changes = [statistics.fmean(values) for values in by_person.values()]
    if not changes:
        return None
    error = statistics.stdev(changes) / len(changes) ** 0.5 if len(changes) > 1 else None
    return Difference(statistics.fmean(changes), error, sum(change > 0 for change in changes) / len(changes))


def _place(record: Record) -> tuple:
    return tuple(record[key] for key in ("group", "light", "noise", "colors", "person", "target"))


def summarise(records: Iterable[Record]) -> list[Record]:
    """A row for each combination of `KEYS`: means of the measures, how many people and pictures, and the gain.

    The gain is that of PSNR over the baseline on the same pictures, with its standard error and the share of people
    who gain; nothing where the baseline was not measured.
    """
    rows: dict[tuple, list[Record]] = defaultdict(list)
    for record in records:
        rows[tuple(record[key] for key in KEYS)].append(record)
    summary = []
    for key, pictures in rows.items():
        about = dict(zip(KEYS, key, strict=True))
        gain = difference(pictures, rows.get((*key[:-2], *BASELINE), []), "psnr")
        summary.append(
            {
                **about,
                "people": len({picture["person"] for picture in pictures}),
                "pictures": len(pictures),
                **{name: mean(pictures, name) for name in MEASURES},
                "gain": gain and gain.mean,
                "gain_error": gain and gain.error,
                "better": gain and gain.better,
            }
        )
    return sorted(
        summary,
        key=lambda row: (*(row[key] for key in KEYS[:4]), row["prior"] != "mean", STAGES.index(row["stage"])),
    )


def read_result(file: Path, keys: Sequence[str], pictures: Sequence[Path] = ()) -> Any:
    """The result that an earlier run saved; None if there is none, or if it is damaged, which is logged.

    Args:
        file: JSON: an object with the `keys`, or one that only says why it was "left_out", or a list of such objects.
        keys: See above.
        pictures: Drawn with the result; one that cannot be read is damage, too.
    """
    try:
        value = json.loads(file.read_bytes())
        records = value if isinstance(value, list) else [value]
        if not records or not all(_is_whole(record, keys) for record in records):
            raise ValueError("not an evaluation's")
        for picture in pictures if "left_out" not in value or "left_out" in keys else ():
            read_photo(picture)
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError, InputError):
        logger.warning("%s: is damaged, so this part is measured again.", file)
        return None
    return value


def _is_whole(record: object, keys: Sequence[str]) -> bool:
    return isinstance(record, dict) and (record.keys() >= set(keys) or record.keys() == {"left_out"})


class Measure(NamedTuple):
    """A column of a table."""

    heading: str
    form: str
    """Format of its numbers, as `format` takes it."""


SYNTHETIC = {
    "psnr": Measure("PSNR", ".2f"),
    "gain": Measure("gain", "+.2f"),
    "gain_error": Measure("±", ".2f"),
    "better": Measure("better for", ".0%"),
    "psnr_inner": Measure("inside the outline", ".2f"),
    "psnr_visible": Measure("visible", ".2f"),
    "psnr_hidden": Measure("hidden", ".2f"),
    "psnr_stretched": Measure("stretched", ".2f"),
    "psnr_squeezed": Measure("squeezed", ".2f"),
    "psnr_unchanged": Measure("neither", ".2f"),
    "ssim": Measure("SSIM", ".4f"),
    "ssim_box": Measure("in the box", ".4f"),
    "ssim_mask": Measure("in the mask", ".4f"),
    "lpips": Measure("LPIPS", ".4f"),
}
"""Columns of `summary.summarise`."""
HIDDEN = {
    "psnr_hidden": Measure("PSNR", ".2f"),
    **{f"hidden contrast {band}": Measure(f"contrast {band} px", ".2f") for band in BANDS},
    **{f"hidden likeness {band}": Measure(f"likeness {band} px", ".2f") for band in BANDS},
}
"""Columns of skin that the photo hides, of the same rows."""
PHOTOS = {
    "psnr": Measure("PSNR, dB", ".2f"),
    "psnr_plain": Measure("without a gain", ".2f"),
    "ssim_quarter": Measure("SSIM at a quarter", ".3f"),
    "error_palm": Measure("colour of the palm", ".3f"),
    "error_back": Measure("of the back", ".3f"),
    "error_nail": Measure("of the nails", ".3f"),
    "chroma_seen": Measure("a*, b* of seen skin, delta E", ".1f"),
    "chroma_hidden": Measure("of hidden skin", ".1f"),
    "chroma_between": Measure("of their difference", ".1f"),
    **{f"contrast {band}": Measure(f"contrast {band} px", ".2f") for band in BANDS},
    "beaten_psnr": Measure("one-shot better by PSNR", ".0%"),
    "beaten_ssim_quarter": Measure("by SSIM", ".0%"),
    "beaten_error": Measure("by colours", ".0%"),
}
"""Columns of `same_hand.summarise_pairs`."""
LOOKS = {
    "photos": Measure("photos", ".0f"),
    **{f"contrast {band}": Measure(f"{band} px: %", ".2f") for band in BANDS},
    **{f"ratio {band}": Measure(f"ratio {band}", ".2f") for band in BANDS},
}
"""Columns of the contrasts of `looks.summarise_looks`."""
REGIONS = {
    "seen": "seen, in the photo's view", "turned": "seen, in other poses", "hidden_palm": "palm that the photo hides",
    "hidden_back": "back that the photo hides", "painted_palm": "palm, painted in the photo's view",
    "painted_back": "back, painted in the photo's view",
}  # fmt: skip
BLEMISHES = {
    "input_psnr_db": Measure("PSNR of the photo's view, dB", ".1f"),
    "lpips": Measure("LPIPS of it", ".3f"),
    "haze": Measure("haze", ".1e"),
    "haze_ratio": Measure("over the mean prior's", ".1f"),
    "palm_minus_back": Measure("palm minus back, a*", "+.1f"),
    "darkest": Measure("darkest 1 % of the opened palm", ".2f"),
    "wounded": Measure("palms with a wound", ".0%"),
    "back_brightness": Measure("back brighter or darker, times", ".2f"),
    "back_hue": Measure("its hue, times", ".2f"),
}
"""Columns of the blemishes of `looks.summarise_looks`."""
COLORS = {"same": "raw", "studio": "raw", "wild": "matched"}
"""How colours are compared in each light: a photo in another light does not show the colours of even light."""
GROUPS = {"ordinary": "People as in training", "tattoo": "The same people with a tattoo", "ring": "And with a ring"}
LIGHTS = {
    "same": "photo and targets of one capture",
    "studio": "photo and targets in even light",
    "wild": "photo in any light, targets in even light, colours matched",
}


def pose_name(factor: float) -> str:
    """Name of the pose that avatars are made with."""
    if factor == 0:
        return "true pose"
    return "estimated" if factor == 1 else f"errors x {factor:g}"


def with_values(rows: Sequence[Record], columns: Mapping[str, Measure]) -> dict[str, Measure]:
    """The columns in which at least one row has a number."""
    return {name: column for name, column in columns.items() if any(row[name] is not None for row in rows)}


def cells(row: Record, columns: Mapping[str, Measure]) -> list[str]:
    """The formatted numbers of a row, empty where it has none."""
    return [format_number(row[name], column.form) for name, column in columns.items()]


def format_number(number: float | int | None, form: str) -> str:
    """The formatted number, or an empty string."""
    return "" if number is None else format(number, form)


def kernel_cells(row: Record) -> list[str]:
    """Distance and standard error of a row of `looks.kernel_rows`, of all layers and of each."""
    return [f"{row[layer]:.2f} ± {row[f'{layer}_error']:.2f}" for layer in ("all", *LAYERS)]


def noise_rows(
    summary: Sequence[Record], group: str, light: str, factors: Sequence[float]
) -> dict[tuple[str, str], list[float | None]]:
    """PSNR of each method (prior and stage) by the factor of the pose's errors; None where it was not measured."""
    rows: dict[tuple[str, str], list[float | None]] = {}
    for row in summary:
        if (row["group"], row["light"], row["colors"]) == (group, light, COLORS[light]):
            found = rows.setdefault((row["prior"], row["stage"]), [None] * len(factors))
            if row["noise"] in factors:
                found[factors.index(row["noise"])] = row["psnr"]
    return rows
