"""Put what was evaluated into docs/evaluation.md, each table between its two markers, and the pictures beside it.

    oasis evaluate --dataset synthetic --seed 1 --device cuda --workers 8 --out out/evaluation
    oasis evaluate --dataset same-hand tests/data/photos/same_hand --out out/same_hand
    python studies/ablate_prior.py out/ablation --steps 3000 --device cuda --workers 14
    python studies/probe_prior.py out/probe --device cuda --workers 8
    python studies/ablate_one_shot.py out/one_shot --people 10 --device cuda --workers 8
    python studies/curve_one_shot.py out/curve
    python studies/write_evaluation.py docs/evaluation.md out

What has no file in the folder stays as it is on the page.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import curve_one_shot
import torch

from oasis_warp.data.output_files import write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.evaluation.ablation import as_markdown, heading
from oasis_warp.evaluation.columns import (
    COLORS,
    GROUPS,
    LIGHTS,
    PHOTOS,
    SYNTHETIC,
    cells,
    markdown,
    noise_rows,
    number_words,
    pose_words,
    present,
)
from oasis_warp.evaluation.methods import Method, label
from oasis_warp.evaluation.summary import Record, select

PICTURES = {"evaluation": ("sheet.png", "attention.png"), "same_hand": ("sheet.png",)}
"""Copied beside the page as _static/FOLDER_NAME.jpg."""
ROWS_SHOWN = 1300
"""Of a picture on the page [px]."""


def name_of(row: Record) -> str:
    """Of the row's method."""
    return label(Method(row["prior"], row["stage"]))


def synthetic(found: dict[str, Any]) -> str:
    """A table for each group and light."""
    settings, parts = found["settings"], []
    for group in settings["groups"]:
        for light in settings["lights"]:
            rows = [
                row for row in select(found["summary"], group=group, light=light, colors=COLORS[light])
                if row["noise"] in settings["noise"]
            ]  # fmt: skip
            shown = present(rows, SYNTHETIC)
            lines = [[name_of(row), pose_words(row["noise"]), *cells(row, shown)] for row in rows]
            names = ["method", "pose", *(column.words for column in shown.values())]
            parts.append(f"{GROUPS[group]}, {LIGHTS[light]}:\n\n{markdown(names, lines)}")
    shoot = settings["shoot"]
    parts.append(
        f"{settings['people']} people, {shoot['targets']} targets each, {shoot['size']} px. "
        f"Weights {str(settings['priors'].get('learned'))[:12]}."
        + ("" if settings["lpips"] else " LPIPS: its weights were not at hand.")
    )
    return "\n\n".join(parts)


def noise(found: dict[str, Any]) -> str:
    """PSNR by how wrong the pose is, for the first group and light."""
    settings = found["settings"]
    group, light, factors = settings["groups"][0], settings["lights"][0], sorted(settings["noise"] + settings["curve"])
    rows = noise_rows(found["summary"], group, light, factors)
    lines = [[label(Method(*method)), *(number_words(psnr, ".2f") for psnr in of)] for method, of in rows.items()]
    title = f"PSNR, {GROUPS[group][0].lower()}{GROUPS[group][1:]}, {LIGHTS[light]}:"
    return f"{title}\n\n{markdown(['method', *map(pose_words, factors)], lines)}"


def photos(found: dict[str, Any]) -> str:
    """Medians over pairs."""
    rows = found["summary"]
    words = f"{rows[0]['pairs']} ordered pairs of {len(found['settings']['photos'])} sets, medians."
    if found["left_out"]:
        words += f" Photos left out: {len(found['left_out'])}."
    shown = present(rows, PHOTOS)
    names = ["method", *(column.words for column in shown.values())]
    return f"{markdown(names, [[name_of(row), *cells(row, shown)] for row in rows])}\n\n{words}"


def ablation(found: dict[str, Any]) -> str:
    """Its tables, and how they were made."""
    parts = [f"{heading(table)}:\n\n{as_markdown(table)}" for table in found["tables"]]
    settings = ", ".join(f"{name} {value}" for name, value in found["settings"].items())
    return "\n\n".join([*parts, f"Settings: {settings}."])


def curve(found: dict[str, Any]) -> str:
    """A table a light."""
    parts = [curve_one_shot.as_markdown(one) for one in found["tables"]]
    return "\n\n".join([*parts, f"Weights {found['settings']['weights'][:12]}, {found['settings']['device']}."])


SECTIONS: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "synthetic": ("evaluation/metrics.json", synthetic),
    "noise": ("evaluation/metrics.json", noise),
    "same-hand": ("same_hand/metrics.json", photos),
    "network": ("ablation/ablation.json", ablation),
    "probe": ("probe/ablation.json", ablation),
    "one-shot": ("one_shot/ablation.json", ablation),
    "curve": ("curve/curve.json", curve),
}
"""By the word in the markers: file below the folder, and what is made of it."""


def fill(page: str, folder: Path) -> str:
    """The page with its sections replaced where their files are there."""
    for name, (file, made) in SECTIONS.items():
        if (folder / file).is_file():
            begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
            head, rest = page.split(begin)
            _, tail = rest.split(end)
            page = f"{head}{begin}\n{made(json.loads((folder / file).read_text()))}\n{end}{tail}"
    return page


def copy_pictures(folder: Path, beside: Path) -> None:
    """The upper part of each sheet."""
    for inner, names in PICTURES.items():
        for name in names:
            if (folder / inner / name).is_file():
                rows: torch.Tensor = read_photo(folder / inner / name).rgb[:ROWS_SHOWN]
                write_picture(beside / f"{inner}_{Path(name).stem}.jpg", rows.contiguous())


def main() -> None:
    """Read the folder, rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("folder", type=Path, help="holds evaluation, same_hand, ablation, probe, one_shot and curve")
    options = parser.parse_args()
    write_file(options.page, fill(options.page.read_text(), options.folder).encode())
    copy_pictures(options.folder, options.page.parent / "_static")


if __name__ == "__main__":
    main()
