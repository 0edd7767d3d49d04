"""The tables of the paper on a data set: which rows are measured, and how they stand beside what papers print.

What papers print are constants with their source, and nothing that we measured. All are those of OASIS (MM '26), which
took over the rows of other methods from their papers or ran them; OHTA is Zheng et al. (CVPR 2024). SSIM and LPIPS
depend on how they are computed, see docs/evaluation.md: compare with care.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import ReconstructConfig, adapt_config
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_files
from oasis_warp.evaluation.data_sets import Row
from oasis_warp.evaluation.methods import ONE_SHOT, RAW
from oasis_warp.evaluation.summary import Record
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior


class Published(NamedTuple):
    """A row of a paper's table."""

    name: str
    psnr: float
    """[dB]"""
    ssim: float
    lpips: float
    """100 times LPIPS."""


RESULTS = {
    "interhand": (
        Published("SelfRecon", 26.38, 0.879, 14.21),
        Published("HumanNeRF", 27.64, 0.884, 11.45),
        Published("HandAvatar", 28.23, 0.894, 10.35),
        Published("HARP", 19.82, 0.761, 22.49),
        Published("Handy", 25.56, 0.794, 14.98),
        Published("HandAvatar, one photo", 23.79, 0.820, 17.78),
        Published("OHTA", 26.11, 0.864, 12.93),
        Published("LHM, no fine-tuning", 24.45, 0.901, 13.96),
        Published("OASIS, no fine-tuning", 26.48, 0.950, 11.74),
        Published("OASIS", 27.38, 0.956, 11.45),
    ),
    "hanco": (
        Published("HandAvatar", 24.68, 0.896, 8.25),
        Published("OHTA", 25.24, 0.923, 7.18),
        Published("OASIS", 25.86, 0.974, 6.76),
    ),
}
"""By data set: OASIS, table 1 and the table of HanCo in its appendix."""
MODEL_ABLATION = {
    "a": Published("full model", 27.38, 0.956, 11.45),
    "b": Published("w/o VETs", 26.97, 0.955, 12.11),
    "b.1": Published("w/o aggregation", 27.08, 0.955, 11.87),
    "b.2": Published("w/o LTEP", 27.12, 0.955, 11.98),
    "c": Published("w/o VPIA", 27.10, 0.955, 12.09),
    "c.1": Published("w/o bias", 27.07, 0.955, 12.08),
    "d": Published("w/o FoM", 27.13, 0.955, 12.35),
}
"""OASIS, table 2, on InterHand2.6M."""
ONE_SHOT_ABLATION = {
    "a": Published("full model", 27.38, 0.956, 11.45),
    "b": Published("w/o texture prior", 25.88, 0.912, 16.24),
    "c": Published("w/o colour calibration", 26.59, 0.951, 11.98),
    "d": Published("w/o texture learning", 27.02, 0.953, 12.18),
    "e": Published("w/o regularisation", 27.08, 0.954, 12.28),
    "f": Published("w/o LoRA: full tuning", 27.11, 0.954, 12.06),
}
"""OASIS, the ablation of one-shot reconstruction in its appendix, on InterHand2.6M."""
SPEED = {"OASIS": (390.0, 5.0), "OHTA": (0.16, 60.0), "HandAvatar": (0.16, None)}
"""Frames a second on an A100, and minutes for a person ("approximately 5", "around 1 hour"): OASIS, section 4.2."""

POSE_ERRORS = (2.0, 5.0, 10.0)
"""Standard deviations [degrees] of the curve."""
SHIPPED, GUESS = "ours", "ours, no fine-tuning"
SWITCHES: dict[tuple[str, str], str] = {
    ("vet", "off"): "b", ("vet", "no_aggr"): "b.1", ("vet", "mlp"): "b.2", ("vpia", "off"): "c",
    ("vpia", "no_bias"): "c.1", ("fom", "off"): "d",
}  # fmt: skip
"""Letters of the paper's rows by the switch of the network that is off."""
MEASURES = (
    ("PSNR", "psnr_whole", ".2f"), ("SSIM", "ssim", ".3f"), ("LPIPS*", "lpips", ".2f"),
    ("PSNR in the mask", "psnr", ".2f"), ("SSIM in the box", "ssim_box", ".3f"),
    ("SSIM in the mask", "ssim_mask", ".3f"), ("adaptation, s", "seconds", ".1f"), ("frames a second", "fps", ".1f"),
)  # fmt: skip
"""Heading, key and form of a column; the first three are also printed by papers. LPIPS* is 100 times LPIPS."""


class PaperTable(NamedTuple):
    """A table as text."""

    name: str
    """Name of its files."""
    title: str
    headings: list[str]
    lines: list[list[str]]


def letter_of(config: NetworkConfig) -> str:
    """The row of the paper's ablation of the model that a network belongs to; "a" with everything on.

    Raises:
        InputError: two parts are off, which no row of the paper has.
    """
    found = [letter for (name, value), letter in SWITCHES.items() if getattr(config, name) == value]
    if len(found) > 1:
        raise InputError(f"--ablations: rows {' and '.join(found)} at once: the paper switches off one part at a time.")
    return found[0] if found else "a"


def rows_of_tables(priors: dict[str, Prior], ablated: Sequence[Prior], steps: int | None, seed: int) -> list[Row]:
    """What has to be measured; puts the networks of the ablations into `priors`.

    Args:
        priors: With "learned", a network.
        ablated: Networks with one part switched off.
        steps: Steps of texture learning in every row, instead of the paper's 400 and our own 56.
        seed: Seed of adaptation.
    """
    learned = priors["learned"]
    shipped = adapt_config(ReconstructConfig(steps=steps, seed=seed))
    rows = [Row(GUESS, "learned", RAW, shipped), Row(SHIPPED, "learned", ONE_SHOT, shipped)]
    rows += [Row(f"pose {degrees:g}", "learned", ONE_SHOT, shipped, degrees) for degrees in POSE_ERRORS]
    if not isinstance(learned, NetworkPrior):
        return rows
    priors["untrained"] = untrained(learned, seed)
    paper = adapt_config(ReconstructConfig(adapt="lora", light="keep", steps=steps, seed=seed))
    variants = {
        "a": ("learned", paper),
        "b": ("untrained", replace(paper, texture="full")),
        "c": ("learned", replace(paper, calibration="off")),
        "d": ("learned", replace(paper, texture_steps=0)),
        "e": ("learned", replace(paper, reference_views=0)),
        "f": ("learned", replace(paper, texture="full")),
    }
    rows += [Row(f"one-shot {letter}", prior, ONE_SHOT, adapt) for letter, (prior, adapt) in variants.items()]
    for prior in ablated:
        if isinstance(prior, NetworkPrior) and (letter := letter_of(prior.network.config)) != "a":
            priors[f"model {letter}"] = prior
            rows.append(Row(f"model {letter}", f"model {letter}", ONE_SHOT, paper))
    return rows


def untrained(prior: NetworkPrior, seed: int) -> NetworkPrior:
    """A network of the same sizes that has learned nothing, its encoder neither: its heads draw the mean hand."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = HandNetwork(replace(prior.network.config, backbone="convolutional"), bundled_hand())
    return NetworkPrior(network, {"name": "untrained"})


def make_tables(data_set: str, summary: Sequence[Record]) -> list[PaperTable]:
    """All tables that the rows of a summary fill."""
    by_name = {row["row"]: row for row in summary}
    headings = ["method", *(heading for heading, _, _ in MEASURES)]
    lines = [[published.name, *_printed(published)] for published in RESULTS.get(data_set, ())]
    for name in (GUESS, SHIPPED):
        lines.append([name, *_measured(by_name.get(name))])
    if "one-shot a" in by_name:
        lines.append(["ours, one-shot as in the paper", *_measured(by_name["one-shot a"])])
    tables = [PaperTable("results", f"Results on {data_set}", headings, lines)]
    for name, title, printed in (
        ("model", "Ablation of the network", MODEL_ABLATION),
        ("one-shot", "Ablation of one-shot reconstruction", ONE_SHOT_ABLATION),
    ):
        lines = []
        for letter, published in printed.items():
            own = by_name.get("one-shot a" if letter == "a" else f"{name} {letter}")
            lines.append([f"{letter} {published.name}", *_printed(published)[:3], *_measured(own)])
        papers = [f"paper: {heading}" for heading, _, _ in MEASURES[:3]]
        tables.append(PaperTable(name, title, ["row", *papers, *headings[1:]], lines))
    curve = {"as fitted": SHIPPED, **{f"{degrees:g} degrees": f"pose {degrees:g}" for degrees in POSE_ERRORS}}
    lines = [[name, *_measured(by_name.get(row))] for name, row in curve.items()]
    tables.append(PaperTable("pose-errors", "Against wrong poses", ["errors of joints", *headings[1:]], lines))
    own = by_name[SHIPPED]
    lines = [[name, _form(fps, "g"), _form(minutes, "g")] for name, (fps, minutes) in SPEED.items()]
    lines.append(["ours, here", _form(own["fps"], ".1f"), _form(own["seconds"] / 60, ".2f")])
    tables.append(PaperTable("speed", "Speed", ["method", "frames a second", "minutes for a person"], lines))
    return tables


def pose_curve(summary: Sequence[Record]) -> list[tuple[float, float]]:
    """Errors of the pose [degrees] and the PSNR that is left with them [dB]."""
    by_name = {row["row"]: row["psnr"] for row in summary}
    names = {0.0: SHIPPED, **{degrees: f"pose {degrees:g}" for degrees in POSE_ERRORS}}
    return [(degrees, by_name[name]) for degrees, name in names.items() if by_name.get(name) is not None]


def _printed(published: Published) -> list[str]:
    three = [f"{published.psnr:.2f}", f"{published.ssim:.3f}", f"{published.lpips:.2f}"]
    return three + [""] * (len(MEASURES) - 3)


def _measured(row: Record | None) -> list[str]:
    if row is None:
        return [""] * len(MEASURES)
    scaled = {**row, "lpips": None if row["lpips"] is None else 100 * row["lpips"]}
    return [_form(scaled[key], form) for _, key, form in MEASURES]


def _form(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def write_tables(folder: Path, tables: Sequence[PaperTable]) -> list[Path]:
    """Write tables.md, tables.tex and a .csv of each table; what was written."""
    files = {folder / "tables.md": "\n\n".join(map(as_markdown, tables)) + "\n"}
    files[folder / "tables.tex"] = "\n\n".join(map(as_latex, tables)) + "\n"
    files |= {folder / f"{table.name}.csv": as_csv(table) for table in tables}
    write_files({path: text.encode() for path, text in files.items()})
    return list(files)


def as_markdown(table: PaperTable) -> str:
    """A table of Markdown below its title."""
    lines = (table.headings, ["---"] * len(table.headings), *table.lines)
    return f"## {table.title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def as_csv(table: PaperTable) -> str:
    """Lines of comma-separated values, the first with the headings."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table.headings, *table.lines])
    return text.getvalue()


def as_latex(table: PaperTable) -> str:
    """A table of LaTeX with booktabs."""
    rows = [" & ".join(map(_escaped, line)) + r" \\" for line in (table.headings, *table.lines)]
    body = "\n".join([r"\toprule", rows[0], r"\midrule", *rows[1:], r"\bottomrule"])
    columns = "l" + "c" * (len(table.headings) - 1)
    begin = f"\\begin{{table}}\n\\caption{{{_escaped(table.title)}}}\n\\begin{{tabular}}{{{columns}}}"
    return f"{begin}\n{body}\n\\end{{tabular}}\n\\end{{table}}"


def _escaped(text: str) -> str:
    for sign in "&%$#_{}":
        text = text.replace(sign, f"\\{sign}")
    return text
