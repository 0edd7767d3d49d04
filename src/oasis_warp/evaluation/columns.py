"""Headings and formats of the tables of evaluations."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from oasis_warp.evaluation.band_energy import BANDS
from oasis_warp.evaluation.kernel_distance import LAYERS
from oasis_warp.evaluation.summary import Record


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
"""Of `summary.summarise`."""
PHOTOS = {
    "psnr": Measure("PSNR, dB", ".2f"),
    "psnr_plain": Measure("without a gain", ".2f"),
    "ssim_quarter": Measure("SSIM at a quarter", ".3f"),
    "error_palm": Measure("colour of the palm", ".3f"),
    "error_back": Measure("of the back", ".3f"),
    "error_nail": Measure("of the nails", ".3f"),
    "beaten_psnr": Measure("one-shot better by PSNR", ".0%"),
    "beaten_ssim_quarter": Measure("by SSIM", ".0%"),
    "beaten_error": Measure("by colours", ".0%"),
}
"""Of `same_hand.summarise_pairs`."""
LOOKS = {
    "photos": Measure("photos", ".0f"),
    **{f"contrast {band}": Measure(f"{band} px: %", ".2f") for band in BANDS},
    **{f"ratio {band}": Measure(f"ratio {band}", ".2f") for band in BANDS},
}
"""Of the contrasts of `looks.summarise_looks`."""
REGIONS = {
    "seen": "seen, in the photo's view", "turned": "seen, in other poses", "hidden_palm": "palm that the photo hides",
    "hidden_back": "back that the photo hides",
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
"""Of the blemishes of `looks.summarise_looks`."""
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
