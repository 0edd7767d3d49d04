"""From numbers of single pictures to those of tables."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from oasis_warp.evaluation.methods import BASELINE, METHODS
from oasis_warp.evaluation.metrics import MEASURES

Record = dict[str, Any]
"""One drawn picture: what it is (`KEYS`, person, target), and `MEASURES`."""
KEYS = ("group", "light", "noise", "method", "colors")
"""What makes a row of the summary; `colors` are "raw", or "matched" to the target by one gain a channel."""


def summarise(records: Iterable[Record]) -> list[Record]:
    """The mean of every measure over the pictures of each row, over as many as have it; and how many people there are.

    Beside the means, how PSNR changed from the baseline on the same pictures, and the share of people it rose for.
    """
    rows: dict[tuple, list[Record]] = defaultdict(list)
    for record in records:
        rows[tuple(record[key] for key in KEYS)].append(record)
    summary = []
    for key, pictures in rows.items():
        about = dict(zip(KEYS, key, strict=True))
        baseline = rows.get(tuple({**about, "method": BASELINE}[name] for name in KEYS), [])
        means = {name: _mean(picture[name] for picture in pictures) for name in MEASURES}
        summary.append(
            {
                **about,
                "people": len({picture["person"] for picture in pictures}),
                "pictures": len(pictures),
                **means,
                **_gain(pictures, baseline),
            }
        )
    order = list(METHODS)
    return sorted(
        summary,
        key=lambda row: (row["group"], row["light"], row["noise"], row["colors"], order.index(row["method"])),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return statistics.fmean(there) if there else None


def _gain(pictures: Sequence[Record], baseline: Sequence[Record]) -> Record:
    """Of PSNR over the baseline's, a mean a person first: pictures of one hand are no independent trials."""
    before = {(picture["person"], picture["target"]): picture["psnr"] for picture in baseline}
    by_person = defaultdict(list)
    for picture in pictures:
        if (place := (picture["person"], picture["target"])) in before:
            by_person[picture["person"]].append(picture["psnr"] - before[place])
    gains = [statistics.fmean(values) for values in by_person.values()]
    if not gains:
        return {"gain": None, "gain_error": None, "better": None}
    error = statistics.stdev(gains) / len(gains) ** 0.5 if len(gains) > 1 else None
    return {
        "gain": statistics.fmean(gains),
        "gain_error": error,
        "better": sum(gain > 0 for gain in gains) / len(gains),
    }
