"""Write docs/results.md from what the evaluations left behind.

Six commands make the page; the first five measure:

    python studies/evaluate_photos.py tests/data/photos --out out/photos/learned --jobs 2
    python studies/evaluate_photos.py tests/data/photos --prior none --out out/photos/none --jobs 2
    python studies/evaluate_photos.py tests/data/photos/same_hand --pairs --out out/same_hand/learned --jobs 2
    python studies/evaluate_photos.py tests/data/photos/same_hand --prior none --pairs --out out/same_hand/none --jobs 2
    python studies/evaluate_masks.py tests/data/photos --out out/masks.md
    python studies/write_results.py out docs/results.md

The folder that the last one reads holds photos/, same_hand/ and masks.md.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

Row = dict[str, str]
PRIORS = ("none", "learned")

TEMPLATE = """# Measurements

Every photo with a hand that we test with (`tests/data/photos`, sources and licences there): {n_single} single photos
and {n_sets} photos of eight sets that show one hand each; a few photos are in both. Two CPU cores, no GPU, two photos
at a time.

```sh
{commands}
```

*Reprojection*: mean distance of the 21 landmarks to the model's, in % of the longer side of their box. *PSNR*: the
avatar in the photo's pose over black, against the photo at its own size (256 to 1024 px), inside the mask above the
wrist line; where the mask is wrong, black is compared with background, and a pixel of the outline is half background in
the photo and half black here. *Coverage*: share of the posed mesh's silhouette with alpha >= 0.9, the fading rim of the
wrist left out. *Fit* includes both masks and the second looks.

## The estimator

{estimator}

## The avatar

With the learned prior, which is the default, and without it (`--prior none`).

{avatar}

Times are with the other core busy, by other work too. With an H200 (`ReconstructConfig(device="cuda")`; `oasis
reconstruct` prints the stages) the single photos took 2.4 to 4.0 s once the process was warm, 2.9 in the median, and
when they were done again in the same process 2.9 to 4.4, 3.6 in the median; three of them on another day 2.2 to 2.9.
Most of that waits for one core of the machine's processor:

| median seconds | landmarks | fit | prior | outline | adaptation | detail | quality | total |
|---|---|---|---|---|---|---|---|---|
| first | 0.03 | 0.92 | 0.01 | 0.80 | 0.74 | 0.26 | 0.13 | 2.9 |
| again | 0.03 | 1.15 | 0.01 | 1.08 | 0.88 | 0.26 | 0.14 | 3.6 |

## Single photos

{single}

`palm_open_right_01` has the lowest PSNR of all: between its fingers the mask keeps white board, which the avatar
rightly leaves black. `backlit_victory_14` is nearly a silhouette; its avatar is as dark. Side and detection are right
on all, the two photos marked hard included.

![Each photo with the guesses of both priors and what adaptation makes of them](_static/priors.jpg)

The sheet is made by `python studies/compare_priors.py docs/_static/priors.jpg tests/data/photos/*.*`: the photo, then
for each prior its guess and the adapted hand, from the photo's view, the side and behind.

## Masks and surfaces against hand-drawn outlines

IoU above the wrist; two careful drawings of one photo agree to about 0.985.

{masks}

## The same hand in another photo

The avatar of photo A in the pose and camera of photo B (estimated with A's shape), compared inside both masks. The
photos differ in exposure, white balance and shading, hence one gain a channel.

{pairs}

Of two avatars of one photo, the one made with the learned prior is nearer to photo B on {pairs_won} of the pairs, by
PSNR with one gain a channel.
"""

ESTIMATOR = {
    "reprojection_percent": ("reprojection, % of the box", ".2f"),
    "mask_iou": ("fitted mesh against mask, IoU above the wrist", ".3f"),
    "landmarks_s": ("seconds: landmarks", ".2f"),
    "fit_s": ("seconds: fit", ".2f"),
    "outline_s": ("seconds: outline", ".2f"),
}
AVATAR = {
    "input_psnr_db": ("PSNR inside the mask, dB", ".1f"),
    "input_psnr_inner_db": ("PSNR 2 px inside the mask, dB", ".1f"),
    "coverage_worst": ("coverage, worst of 4 poses x 8 views", ".4f"),
    "prior_s": ("seconds: prior", ".2f"),
    "adaptation_s": ("seconds: adaptation", ".1f"),
    "total_s": ("seconds: photo to avatar, warm", ".1f"),
    "peak_gib": ("peak memory of the process, GiB", ".2f"),
}
SINGLE = {
    "side": ("side", "s"),
    "reprojection_percent": ("reprojection %", ".2f"),
    "mask_iou": ("mask IoU", ".3f"),
}
SINGLE_BY_PRIOR = {
    "input_psnr_db": ("PSNR dB", ".1f"),
    "input_psnr_inner_db": ("2 px inside, dB", ".1f"),
    "coverage_worst": ("coverage", ".3f"),
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


def spread(rows: dict[str, list[Row]], columns: dict[str, tuple[str, str]], title: str) -> str:
    """Percentiles and extremes of some columns as a Markdown table, with a line for each of the sets of `rows`."""
    sets = f" {title} | prior |" if len(rows) > 1 else f" {title} |"
    lines = [f"|{sets} 10 % | median | 90 % | least | most |", "|" + "---|" * (sets.count("|") + 5)]
    for key, (name, form) in columns.items():
        for label, part in rows.items():
            values = np.array([float(row[key]) for row in part if row.get(key)])
            numbers = [*np.percentile(values, (10, 50, 90)), values.min(), values.max()]
            cells = [name, label] if len(rows) > 1 else [name]
            lines.append("| " + " | ".join([*cells, *(format(number, form) for number in numbers)]) + " |")
    return "\n".join(lines)


def listing(rows: dict[str, list[Row]]) -> str:
    """One line a photo."""
    names = [name for name, _ in SINGLE.values()]
    names += [f"{name}, {prior}" for name, _ in SINGLE_BY_PRIOR.values() for prior in rows]
    lines = ["| photo | " + " | ".join(names) + " |", "|" + "---|" * (len(names) + 1)]
    for several in zip(*rows.values(), strict=True):
        row = several[0]
        if row["result"] != "ok":
            why = row["result"].split(": ")[1].split(";")[0]
            lines.append(f"| {row['photo']} | refused: {why} |" + " |" * (len(names) - 1))
            continue
        cells = [row[key] if form == "s" else format(float(row[key]), form) for key, (_, form) in SINGLE.items()]
        cells += [format(float(one[key]), form) for key, (_, form) in SINGLE_BY_PRIOR.items() for one in several]
        lines.append(f"| {row['photo']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def share_won(rows: dict[str, list[Row]], key: str) -> str:
    """Share of the pairs at which the learned prior has the larger value."""
    values = {prior: {(row["source"], row["target"]): float(row[key]) for row in part} for prior, part in rows.items()}
    both = values["none"].keys() & values["learned"].keys()
    return f"{np.mean([values['learned'][pair] > values['none'][pair] for pair in both]):.0%}"


def main() -> None:
    """Read the folder, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds photos/, same_hand/ and masks.md")
    parser.add_argument("page", type=Path)
    options = parser.parse_args()

    def both(folder: str, name: str) -> dict[str, list[Row]]:
        return {prior: read(options.folder / folder / prior / name) for prior in PRIORS}

    single, sets, pairs = both("photos", "photos.csv"), both("same_hand", "photos.csv"), both("same_hand", "pairs.csv")
    good = {prior: [row for row in single[prior] + sets[prior] if row["result"] == "ok"] for prior in PRIORS}
    commands = [line.strip() for line in (__doc__ or "").splitlines() if line.startswith("    python")]
    title = f"all {len(good['none'])} hands"
    page = TEMPLATE.format(
        n_single=sum(row["result"] == "ok" for row in single["none"]),
        n_sets=len(sets["none"]),
        commands="\n".join(commands),
        estimator=spread({"none": good["none"]}, ESTIMATOR, title),
        avatar=spread(good, AVATAR, title),
        single=listing(single),
        masks=(options.folder / "masks.md").read_text().strip(),
        pairs=spread(pairs, PAIRS, f"{len(pairs['none'])} ordered pairs"),
        pairs_won=share_won(pairs, "psnr_db"),
    )
    options.page.write_text(page)


if __name__ == "__main__":
    main()
