"""Aggregate the scores of single pictures into the rows of tables.

Results of one person, hand or photo are kept, so that an evaluation that was stopped goes on with the others.
"""

import json
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import logger
from oasis_warp.data.photo import read_photo
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
    """What an earlier run has kept; None where it has not, or where the disk has damaged it, which is logged.

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
