"""Aggregate the scores of single pictures into the rows of tables."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

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
