"""How tables of evaluations are worded, wherever they are printed: columns, and what rows stand under."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from oasis_warp.evaluation.summary import Record


class Column(NamedTuple):
    """Of a table."""

    words: str
    form: str
    """Of its numbers, as `format` takes it."""


SYNTHETIC = {
    "psnr": Column("PSNR", ".2f"),
    "gain": Column("gain", "+.2f"),
    "gain_error": Column("±", ".2f"),
    "better": Column("better for", ".0%"),
    "psnr_inner": Column("inside the outline", ".2f"),
    "psnr_visible": Column("visible", ".2f"),
    "psnr_hidden": Column("hidden", ".2f"),
    "psnr_stretched": Column("stretched", ".2f"),
    "psnr_squeezed": Column("squeezed", ".2f"),
    "psnr_unchanged": Column("neither", ".2f"),
    "ssim": Column("SSIM", ".4f"),
    "ssim_box": Column("in the box", ".4f"),
    "ssim_mask": Column("in the mask", ".4f"),
    "lpips": Column("LPIPS", ".4f"),
}
"""Of `summary.summarise`."""
PHOTOS = {
    "psnr": Column("PSNR, dB", ".2f"),
    "psnr_plain": Column("without a gain", ".2f"),
    "ssim_quarter": Column("SSIM at a quarter", ".3f"),
    "error_palm": Column("colour of the palm", ".3f"),
    "error_back": Column("of the back", ".3f"),
    "error_nail": Column("of the nails", ".3f"),
    "beaten_psnr": Column("one-shot better by PSNR", ".0%"),
    "beaten_ssim_quarter": Column("by SSIM", ".0%"),
    "beaten_error": Column("by colours", ".0%"),
}
"""Of `same_hand.summarise_pairs`."""
COLORS = {"same": "raw", "studio": "raw", "wild": "matched"}
"""How pictures are judged by the light: a photo in another light cannot tell the colours of even light."""
GROUPS = {"ordinary": "People as in training", "tattoo": "The same people with a tattoo", "ring": "And with a ring"}
LIGHTS = {
    "same": "photo and targets of one capture",
    "studio": "photo and targets in even light",
    "wild": "photo in any light, targets in even light, colours matched",
}


def pose_words(factor: float) -> str:
    """How wrong the pose is that avatars are made with."""
    if factor == 0:
        return "true pose"
    return "estimated" if factor == 1 else f"errors x {factor:g}"


def present(rows: Sequence[Record], columns: Mapping[str, Column]) -> dict[str, Column]:
    """The columns in which at least one row has a number."""
    return {name: column for name, column in columns.items() if any(row[name] is not None for row in rows)}


def cells(row: Record, columns: Mapping[str, Column]) -> list[str]:
    """The row's numbers as words; nothing where there is none."""
    return [number_words(row[name], column.form) for name, column in columns.items()]


def number_words(number: float | None, form: str) -> str:
    """The number in its form, or nothing."""
    return "" if number is None else format(number, form)


def markdown(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table."""
    rows = [heading, ["---"] * len(heading), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def noise_rows(
    summary: Sequence[Record], group: str, light: str, factors: Sequence[float]
) -> dict[tuple[str, str], list[float | None]]:
    """PSNR of each method (prior and stage) against how wrong poses are; None where that was not measured."""
    rows: dict[tuple[str, str], list[float | None]] = {}
    for row in summary:
        if (row["group"], row["light"], row["colors"]) == (group, light, COLORS[light]):
            found = rows.setdefault((row["prior"], row["stage"]), [None] * len(factors))
            if row["noise"] in factors:
                found[factors.index(row["noise"])] = row["psnr"]
    return rows
