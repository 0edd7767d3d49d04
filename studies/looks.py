"""How avatars of single photos look: contrast by band, kernel distance, blemishes, and the sheets that eyes judge.

Fills docs/looks.md (contrast, kernel-distance, blemishes, each-photo; and the sheets) from OUT/looks, where this
command leaves its results, and from OUT/looks_0.2.0, where version 0.2.0 left its own:

    oasis evaluate tests/data/photos --dataset looks --out out/looks
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation.kernel_distance import LAYERS
from oasis_warp.evaluation.looks import SHEETS, relative_contrasts
from oasis_warp.evaluation.real_hands import reference_contrasts
from oasis_warp.evaluation.summary import BLEMISHES, LOOKS, REGIONS, cells, kernel_cells, with_values
from studies.harness import Row, StudyOptions
from studies.inputs import PHOTOS
from studies.tables import Column, Section, markdown, table, write_jpeg

FOLDERS = {"0.2.0": "looks_0.2.0", "now": "looks"}
"""Folders of results by what they are called in tables."""
FILES = (f"{FOLDERS['now']}/metrics.json",)
SHOWN = {
    "looks_best": "back_flat_right_04", "looks_worst_1": "shaka_back_right_12",
    "looks_worst_2": "thumb_up_cutout_right_07", "looks_worst_3": "two_fingers_dark_skin_16",
}  # fmt: skip
"""Pictures of docs/_static and the photos whose sheets they are."""
WIDTH, QUALITY = 1800, 85
"""Width of these pictures [px], and quality of their JPEG: 100 to 250 KB each."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    photos: Path = PHOTOS


def run(options: Options) -> list[Row]:
    """Run the command."""
    from oasis_warp.cli import main

    options.out.mkdir(parents=True, exist_ok=True)
    main(["evaluate", str(options.photos), "--dataset", "looks", "--device", options.device, "--out",
          str(options.out / FOLDERS["now"])])  # fmt: skip
    return load(options.out)


def load(out: Path) -> list[Row]:
    """What the command left, a row for each folder."""
    paths = {name: out / folder / "metrics.json" for name, folder in FOLDERS.items()}
    return [
        {"name": name, "folder": str(path.parent), "found": json.loads(path.read_text())}
        for name, path in paths.items() if path.is_file()
    ]  # fmt: skip


def draw(rows: list[Row], static: Path) -> None:
    """Some sheets of the last version, made smaller."""
    for name, photo in SHOWN.items():
        path = Path(rows[-1]["folder"]) / SHEETS / f"{photo}.jpg"
        if path.is_file():
            pixels = read_photo(path).rgb.numpy()
            size = WIDTH, round(len(pixels) * WIDTH / pixels.shape[1])
            write_jpeg(static / f"{name}.jpg", cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), QUALITY)


def contrast(rows: list[Row]) -> str | None:
    """A line for each kind of skin and version."""
    found = [(row["name"], line) for row in rows for line in row["found"]["summary"]["contrast"]]
    shown = with_values([line for _, line in found], LOOKS) if found else {}
    order = list(REGIONS)
    lines = [
        [REGIONS[line["region"]], name, *cells(line, shown)]
        for name, line in sorted(found, key=lambda pair: order.index(pair[1]["region"]))
    ]
    return markdown(["skin", "version", *(column.heading for column in shown.values())], lines) if lines else None


def distances(rows: list[Row]) -> str | None:
    """A line for each kind of picture and version."""
    found = [(row["name"], line) for row in rows for line in row["found"]["kernel_distance"]]
    names = list(dict.fromkeys(line["name"] for _, line in found))
    lines = [
        [line["name"], "" if line["name"] in FLOORS else name, f"{line['pictures']}", *kernel_cells(line)]
        for name, line in sorted(found, key=lambda pair: names.index(pair[1]["name"]))
        if line["name"] not in FLOORS or name == rows[-1]["name"]
    ]
    return markdown(["pictures", "version", "number", "all", *LAYERS], lines) if lines else None


FLOORS = ("halves of the real hands", "real palms to real backs")
"""Rows of the kernel distance that depend on no avatar."""


def blemishes(rows: list[Row]) -> str | None:
    """A column for each version."""
    shown = with_values([row["found"]["summary"]["blemishes"] for row in rows], BLEMISHES) if rows else {}
    lines = [
        [column.heading, *(column_text(row["found"]["summary"]["blemishes"].get(name), column.form) for row in rows)]
        for name, column in shown.items()
    ]
    return markdown(["median over photos", *(row["name"] for row in rows)], lines) if lines else None


def column_text(value: Any, form: str) -> str:
    """A number in a form; empty for None."""
    return "" if value is None else format(value, form)


def photos(rows: list[Row]) -> list[Row]:
    """A row for each photo of the last version."""
    reference, found = reference_contrasts(), []
    for name, record in (rows[-1]["found"]["photos"] if rows else {}).items():
        ratios = relative_contrasts(record, reference)
        found.append({
            "photo": Path(name).stem, "psnr": record["input_psnr_db"], "side": record["side"],
            **{region: " / ".join(f"{ratio:.2f}" for ratio in own) for region, own in ratios.items()},
            "haze": record["haze"] / max(record["haze_of_mean"], 1e-9), "palm": record["palm_minus_back"],
            "darkest": record["darkest"],
            "light": " / ".join(f"{ratio:.2f}" for ratio in record["back_over_front"] or []),
        })  # fmt: skip
    return found


SECTIONS = (
    Section("looks.md", "contrast", contrast),
    Section("looks.md", "kernel-distance", distances),
    Section("looks.md", "blemishes", blemishes),
    Section("looks.md", "each-photo", table(
        (
            Column("photo", "photo"), Column("PSNR dB", "psnr", ".1f"),
            *(Column(REGIONS[name], name) for name in ("turned", "hidden_palm", "hidden_back")),
            Column("haze ratio", "haze", ".0f"),
            Column("palm minus back, a*", "palm", "+.1f"), Column("darkest palm", "darkest", ".2f"),
            Column("back over front, R / G / B", "light"),
        ),
        photos,
    )),
)  # fmt: skip
