"""Write docs/results.md from what the evaluations left behind.

Four commands make the page; the first three measure:

    python tools/evaluate_photos.py tests/data/photos --out out/photos --jobs 2
    python tools/evaluate_photos.py tests/data/photos/same_hand --pairs --out out/same_hand --jobs 2
    python tools/evaluate_masks.py tests/data/photos --out out/masks.md
    python tools/write_results.py out docs/results.md

The folder that the last one reads holds photos/, same_hand/ and masks.md.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

Row = dict[str, str]

TEMPLATE = """# Measurements

Every photo with a hand that we test with (`tests/data/photos`, sources and licences there): {n_single} single photos
and {n_sets} photos of eight sets that show one hand each; a few photos are in both. Two CPU cores, no GPU, two photos
at a time.

```sh
{commands}
```

*Reprojection*: mean distance of the 21 landmarks to the model's, in % of the longer side of their box. *PSNR*: the
avatar in the photo's pose over black, against the photo, at 256 px, inside the mask above the wrist line; where the
mask is wrong, black is compared with background. *Coverage*: share of the posed mesh's silhouette with alpha >= 0.9,
the fading rim of the wrist left out. *Fit* includes both masks and the second looks.

{summary}

Times are with the other core busy: alone, a fit takes about 0.8 s and the adaptation about 4 s.

## Single photos

{single}

`palm_open_right_01` has the lowest PSNR of all: between its fingers the mask keeps white board, which the avatar
rightly leaves black. `backlit_victory_14` is nearly a silhouette; its avatar is as dark. Side and detection are right
on all, the two photos marked hard included.

## Masks and surfaces against hand-drawn outlines

IoU above the wrist; two careful drawings of one photo agree to about 0.985.

{masks}

## The same hand in another photo

The avatar of photo A in the pose and camera of photo B (estimated with A's shape), compared inside both masks. The
photos differ in exposure, white balance and shading, hence one gain a channel. It is the baseline for what follows:
the first prior knows mean colours only, and a colour seen in one light is drawn in another.

{pairs}
"""

SUMMARY = {
    "reprojection_percent": ("reprojection, % of the box", ".2f"),
    "mask_iou": ("fitted mesh against mask, IoU above the wrist", ".3f"),
    "input_psnr_db": ("PSNR inside the mask, dB", ".1f"),
    "input_psnr_inner_db": ("PSNR 2 px inside the mask, dB", ".1f"),
    "coverage_worst": ("coverage, worst of 4 poses x 8 views", ".4f"),
    "landmarks_s": ("seconds: landmarks", ".2f"),
    "fit_s": ("seconds: fit", ".2f"),
    "outline_s": ("seconds: outline", ".2f"),
    "adaptation_s": ("seconds: adaptation", ".1f"),
    "total_s": ("seconds: photo to avatar, warm", ".1f"),
    "peak_gib": ("peak memory of the process, GiB", ".2f"),
}
SINGLE = {
    "side": ("side", "s"),
    "reprojection_percent": ("reprojection %", ".2f"),
    "mask_iou": ("mask IoU", ".3f"),
    "input_psnr_db": ("PSNR dB", ".1f"),
    "input_psnr_inner_db": ("PSNR 2 px inside, dB", ".1f"),
    "coverage_worst": ("coverage, worst of 32", ".3f"),
    "fit_s": ("fit s", ".1f"),
    "adaptation_s": ("adaptation s", ".1f"),
    "total_s": ("total s", ".1f"),
}
PAIRS = {
    "psnr_db": ("PSNR with one gain a channel, dB", ".1f"),
    "psnr_plain_db": ("PSNR without it, dB", ".1f"),
    "overlap": ("overlap (IoU) of drawn hand and mask", ".3f"),
    "error_palm": ("colour error of the palm [sRGB]", ".3f"),
    "error_back": ("colour error of the back [sRGB]", ".3f"),
    "error_nail": ("colour error of the nails [sRGB]", ".3f"),
}


def read(path: Path) -> list[Row]:
    """Rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def spread(rows: list[Row], columns: dict[str, tuple[str, str]], title: str) -> str:
    """Percentiles and extremes of some columns as a Markdown table."""
    lines = [f"| {title} | 10 % | median | 90 % | least | most |", "|---|---|---|---|---|---|"]
    for key, (name, form) in columns.items():
        values = np.array([float(row[key]) for row in rows if row.get(key)])
        numbers = [*np.percentile(values, (10, 50, 90)), values.min(), values.max()]
        lines.append(f"| {name} | " + " | ".join(format(number, form) for number in numbers) + " |")
    return "\n".join(lines)


def listing(rows: list[Row]) -> str:
    """One line a photo."""
    lines = ["| photo | " + " | ".join(name for name, _ in SINGLE.values()) + " |", "|" + "---|" * (len(SINGLE) + 1)]
    for row in rows:
        if row["result"] != "ok":
            why = row["result"].split(": ")[1].split(";")[0]
            lines.append(f"| {row['photo']} | refused: {why} |" + " |" * (len(SINGLE) - 1))
            continue
        cells = (row[key] if form == "s" else format(float(row[key]), form) for key, (_, form) in SINGLE.items())
        lines.append(f"| {row['photo']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Read the folder, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds photos/, same_hand/ and masks.md")
    parser.add_argument("page", type=Path)
    options = parser.parse_args()
    single, sets = read(options.folder / "photos" / "photos.csv"), read(options.folder / "same_hand" / "photos.csv")
    pairs = read(options.folder / "same_hand" / "pairs.csv")
    good = [row for row in single + sets if row["result"] == "ok"]
    commands = [line.strip() for line in (__doc__ or "").splitlines() if line.startswith("    python")]
    page = TEMPLATE.format(
        n_single=sum(row["result"] == "ok" for row in single),
        n_sets=len(sets),
        commands="\n".join(commands),
        summary=spread(good, SUMMARY, f"all {len(good)} hands"),
        single=listing(single),
        masks=(options.folder / "masks.md").read_text().strip(),
        pairs=spread(pairs, PAIRS, f"{len(pairs)} ordered pairs"),
    )
    options.page.write_text(page)


if __name__ == "__main__":
    main()
