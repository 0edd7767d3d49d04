"""What `oasis evaluate` measures: synthetic people, poses that are off, and photos of the same hands.

Fills docs/evaluation.md (synthetic, noise, same-hand; and the sheets beside them) from OUT/evaluation and
OUT/same_hand_photos, where these commands leave their results:

    oasis evaluate --dataset synthetic --seed 1 --device cuda --workers 8 --out out/evaluation
    oasis evaluate --dataset same-hand tests/data/photos/same_hand --out out/same_hand_photos
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation.methods import ONE_SHOT, Method, method_name
from oasis_warp.evaluation.same_hand import gains
from oasis_warp.evaluation.summary import (
    COLORS,
    GROUPS,
    LIGHTS,
    PHOTOS,
    SYNTHETIC,
    Record,
    cells,
    format_number,
    noise_rows,
    pose_name,
    select,
    with_values,
)
from studies.harness import Row, StudyOptions
from studies.tables import markdown, mean, section_of, write_jpeg

FOLDERS = {"synthetic": "evaluation", "same-hand": "same_hand_photos"}
FILES = tuple(f"{folder}/metrics.json" for folder in FOLDERS.values())
PICTURES = {"evaluation_sheet": "evaluation/sheet.png", "evaluation_attention": "evaluation/attention.png",
            "same_hand_sheet": "same_hand_photos/sheet.png"}  # fmt: skip
"""Pictures of docs/_static and where they come from."""
ROWS_SHOWN = 1300
"""Rows of a picture that are shown [px]."""
JUDGED = {"PSNR": "psnr", "SSIM": "ssim_quarter", "colours": "error"}
"""Measures by which priors are compared on a pair."""
MOST = 0.25
"""Share of the pairs on which two priors differ most."""

@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    people: int = 16
    seed: int = 1


def run(options: Options) -> list[Row]:
    """Run both commands."""
    from oasis_warp.cli import main

    options.out.mkdir(parents=True, exist_ok=True)
    common = ["--device", options.device]
    main(["evaluate", "--dataset", "synthetic", "--people", str(options.people), "--seed", str(options.seed),
          "--workers", str(options.workers), "--out", str(options.out / FOLDERS["synthetic"]), *common])  # fmt: skip
    main(["evaluate", "--dataset", "same-hand", "tests/data/photos/same_hand", "--out",
          str(options.out / FOLDERS["same-hand"]), *common])  # fmt: skip
    return load(options.out)


def load(out: Path) -> list[Row]:
    """What the commands left, a row for each of them."""
    paths = {dataset: out / folder / "metrics.json" for dataset, folder in FOLDERS.items()}
    return [
        {"dataset": dataset, "out": str(out), "found": json.loads(path.read_text())}
        for dataset, path in paths.items() if path.is_file()
    ]  # fmt: skip


def draw(rows: list[Row], static: Path) -> None:
    """The upper part of each sheet."""
    for name, file in PICTURES.items():
        path = Path(rows[0]["out"]) / file
        if path.is_file():
            write_jpeg(static / f"{name}.jpg", read_photo(path).rgb[:ROWS_SHOWN].numpy())


def name_of(row: Record) -> str:
    """The label of the row's method."""
    return method_name(Method(row["prior"], row["stage"]))


def synthetic(found: dict[str, Any]) -> str:
    """A table for each group and light."""
    settings, parts = found["settings"], []
    for group in settings["groups"]:
        for light in settings["lights"]:
            rows = [
                row for row in select(found["summary"], group=group, light=light, colors=COLORS[light])
                if row["noise"] in settings["noise"]
            ]  # fmt: skip
            shown = with_values(rows, SYNTHETIC)
            lines = [[name_of(row), pose_name(row["noise"]), *cells(row, shown)] for row in rows]
            headings = ["method", "pose", *(column.heading for column in shown.values())]
            parts.append(f"{GROUPS[group]}, {LIGHTS[light]}:\n\n{markdown(headings, lines)}")
    capture, weights = settings["capture"], str(settings["priors"].get("learned"))[:12]
    about = f"{settings['people']} people, {capture['targets']} targets each, {capture['size']} px. Weights {weights}."
    return "\n\n".join([*parts, about + ("" if settings["lpips"] else " LPIPS: its weights were not at hand.")])


def noise(found: dict[str, Any]) -> str:
    """PSNR by how wrong the pose is, for the first group and light."""
    settings = found["settings"]
    group, light, factors = settings["groups"][0], settings["lights"][0], sorted(settings["noise"] + settings["curve"])
    rows = noise_rows(found["summary"], group, light, factors)
    lines = [[method_name(Method(*key)), *(format_number(psnr, ".2f") for psnr in of)] for key, of in rows.items()]
    title = f"PSNR, {GROUPS[group][0].lower()}{GROUPS[group][1:]}, {LIGHTS[light]}:"
    return f"{title}\n\n{markdown(['method', *map(pose_name, factors)], lines)}"


def photos(found: dict[str, Any]) -> str:
    """Medians over pairs."""
    rows = found["summary"]
    words = f"{rows[0]['pairs']} ordered pairs of {len(found['settings']['photos'])} sets, medians."
    if found["left_out"]:
        words += f" Photos left out: {len(found['left_out'])}."
    words += f" {where_priors_differ(found['pairs'])} {hidden_chroma(found['pairs'])}"
    shown = with_values(rows, PHOTOS)
    headings = ["method", *(column.heading for column in shown.values())]
    return f"{markdown(headings, [[name_of(row), *cells(row, shown)] for row in rows])}\n\n{words}"


def where_priors_differ(pairs: list[Record]) -> str:
    """How often one-shot is better with the learned prior than without, where the two differ most by a measure."""
    learned, plain, parts = Method("learned", ONE_SHOT), Method("mean", ONE_SHOT), []
    for name, measure in JUDGED.items():
        differences = sorted(gains(pairs, learned, plain, measure), key=abs)
        most = differences[-max(1, round(len(differences) * MOST)) :]
        parts.append(f"{mean(gain > 0 for gain in most):.0%} by {name}")
    shares = ", ".join(parts)
    return f"Where learned and mean one-shot differ most (a quarter of the pairs), learned is better on {shares}."


def hidden_chroma(pairs: list[Record]) -> str:
    """How far a* and b* of hidden skin are off, compared with seen skin beside it, over the pairs of one-shot."""
    shown = select(pairs, **Method("learned", ONE_SHOT)._asdict())
    errors = sorted(pair["chroma_between"] for pair in shown if "chroma_between" in pair)
    if not errors:
        return ""
    low, middle, high = (errors[round(share * (len(errors) - 1))] for share in (0.25, 0.5, 0.75))
    return (
        f"The a* and b* of hidden skin, compared with seen skin's, on the {len(errors)} pairs that show both: "
        f"quartiles {low:.1f}, {middle:.1f} and {high:.1f}, at worst {errors[-1]:.1f}."
    )


SECTIONS = (
    section_of("evaluation.md", "synthetic", lambda row: synthetic(row["found"]), FILES[0], dataset="synthetic"),
    section_of("evaluation.md", "noise", lambda row: noise(row["found"]), FILES[0], dataset="synthetic"),
    section_of("evaluation.md", "same-hand", lambda row: photos(row["found"]), FILES[1], dataset="same-hand"),
)
