"""Put what was evaluated into docs/evaluation.md, each table between its two markers, and the pictures beside it.

    oasis evaluate --dataset synthetic --people 32 --device cuda --out out/evaluation
    oasis evaluate --dataset same-hand tests/data/photos/same_hand --out out/same_hand
    python tools/ablate_prior.py out/ablation --steps 3000 --device cuda --workers 14
    python tools/ablate_one_shot.py out/one_shot --device cuda
    python tools/write_evaluation.py docs/evaluation.md out

What has no file in the folder stays as it is on the page.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from oasis_warp.data.atomic import write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.evaluation.ablation import COLORS, as_markdown
from oasis_warp.evaluation.methods import Method, label
from oasis_warp.evaluation.summary import Record, select

GROUPS = {"ordinary": "People as in training", "tattoo": "The same people with a tattoo", "ring": "And with a ring"}
LIGHTS = {"studio": "photo in even light", "wild": "photo in any light, colours matched to the target"}
SYNTHETIC = {
    "psnr": ("PSNR", ".2f"), "gain": ("gain", "+.2f"), "gain_error": ("±", ".2f"), "better": ("better for", ".0%"),
    "psnr_inner": ("inside the outline", ".2f"), "psnr_visible": ("visible", ".2f"), "psnr_hidden": ("hidden", ".2f"),
    "psnr_stretched": ("stretched", ".2f"), "ssim": ("SSIM", ".4f"), "ssim_box": ("in the box", ".4f"),
    "ssim_mask": ("in the mask", ".4f"), "lpips": ("LPIPS", ".4f"),
}  # fmt: skip
PHOTOS = {
    "psnr": ("PSNR, dB", ".2f"), "psnr_plain": ("without a gain", ".2f"), "ssim_quarter": ("SSIM at a quarter", ".3f"),
    "error_palm": ("colour of the palm", ".3f"), "error_back": ("of the back", ".3f"),
    "error_nail": ("of the nails", ".3f"), "beaten_psnr": ("one-shot better by PSNR", ".0%"),
    "beaten_ssim_quarter": ("by SSIM", ".0%"), "beaten_error": ("by colours", ".0%"),
}  # fmt: skip
PICTURES = {"evaluation": ("sheet.png", "attention.png"), "same_hand": ("sheet.png",)}
"""Copied beside the page as _static/FOLDER_NAME.jpg."""
ROWS_SHOWN = 1300
"""Of a picture on the page [px]."""


def table(rows: list[Record], columns: dict[str, tuple[str, str]], first: dict[str, Callable[[Record], str]]) -> str:
    """Markdown; columns that no row has are left out."""
    shown = {name: form for name, form in columns.items() if any(row[name] is not None for row in rows)}
    heading = [*first, *(words for words, _ in shown.values())]
    lines = [heading, ["---"] * len(heading)]
    for row in rows:
        cells = ["" if row[name] is None else format(row[name], form) for name, (_, form) in shown.items()]
        lines.append([*(words(row) for words in first.values()), *cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def name_of(row: Record) -> str:
    """Of the row's method."""
    return label(Method(row["prior"], row["stage"]))


def synthetic(found: dict[str, Any]) -> str:
    """A table for each group and light, and the curve."""
    settings, parts = found["settings"], []
    first = {"method": name_of, "pose": lambda row: "true" if row["noise"] == 0 else "estimated"}
    for group in settings["groups"]:
        for light in settings["lights"]:
            rows = [
                row for row in select(found["summary"], group=group, light=light, colors=COLORS[light])
                if row["noise"] in settings["noise"]
            ]  # fmt: skip
            parts.append(f"{GROUPS[group]}, {LIGHTS[light]}:\n\n{table(rows, SYNTHETIC, first)}")
    shoot = settings["shoot"]
    parts.append(
        f"{settings['people']} people, {shoot['targets']} targets each, {shoot['size']} px. "
        f"Weights {str(settings['priors'].get('learned'))[:12]}."
        + ("" if settings["lpips"] else " LPIPS: its weights were not at hand.")
    )
    return "\n\n".join(parts)


def noise(found: dict[str, Any]) -> str:
    """PSNR by how wrong the pose is, people without tattoos and rings."""
    settings = found["settings"]
    group, factors = settings["groups"][0], settings["noise"] + settings["curve"]
    lines = [["method", "photo", *("true pose" if factor == 0 else f"errors x {factor:g}" for factor in factors)]]
    lines.append(["---"] * len(lines[0]))
    for light in settings["lights"]:
        rows = select(found["summary"], group=group, light=light, colors=COLORS[light])
        for method in dict.fromkeys(name_of(row) for row in rows):
            psnr = {row["noise"]: row["psnr"] for row in rows if name_of(row) == method}
            lines.append([method, light, *(f"{psnr[factor]:.2f}" for factor in factors)])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def photos(found: dict[str, Any]) -> str:
    """Medians over pairs."""
    rows = found["summary"]
    words = f"{rows[0]['pairs']} ordered pairs of {len(found['settings']['photos'])} sets, medians."
    if found["left_out"]:
        words += f" Photos left out: {len(found['left_out'])}."
    return f"{table(rows, PHOTOS, {'method': name_of})}\n\n{words}"


def ablation(found: dict[str, Any]) -> str:
    """A table for each light and stage."""
    parts = []
    for made in found["tables"]:
        people = made["rows"][0]["people"]
        heading = f"{LIGHTS[made['light']][0].upper()}{LIGHTS[made['light']][1:]}, {made['stage'].replace('_', '-')}"
        parts.append(f"{heading}, {people} people:\n\n{as_markdown(made['rows'], found['whole'])}")
    settings = ", ".join(f"{name} {value}" for name, value in found["settings"].items())
    return "\n\n".join([*parts, f"Settings: {settings}."])


SECTIONS: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "synthetic": ("evaluation/metrics.json", synthetic),
    "noise": ("evaluation/metrics.json", noise),
    "same-hand": ("same_hand/metrics.json", photos),
    "network": ("ablation/ablation.json", ablation),
    "one-shot": ("one_shot/ablation.json", ablation),
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
    parser.add_argument("folder", type=Path, help="holds evaluation, same_hand, ablation and one_shot, or some of them")
    options = parser.parse_args()
    write_file(options.page, fill(options.page.read_text(), options.folder).encode())
    copy_pictures(options.folder, options.page.parent / "_static")


if __name__ == "__main__":
    main()
