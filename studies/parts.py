"""What each part of adaptation is worth: synthetic people without one part at a time (the paper's table 4).

Fills docs/evaluation.md (one-shot). A run that was stopped goes on. `network_parts` makes tables of the same kind.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.evaluation.held_out import CaptureConfig
from oasis_warp.evaluation.methods import ONE_SHOT, Method
from oasis_warp.evaluation.summary import COLORS, LIGHTS, SYNTHETIC, Measure, Record, difference, mean, select
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate_people
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import NetworkPrior, choose_prior
from studies.harness import Row, StudyOptions, prior_choice, report, write_rows
from studies.tables import Section, groups, markdown

FULL = "full"
ADAPTATIONS = {
    FULL: AdaptConfig(),
    "calibration": AdaptConfig(calibration="off"),
    "texture": AdaptConfig(texture_steps=0),
    "references": AdaptConfig(reference_views=0),
    "light": AdaptConfig(light="even"),
    "schedule": AdaptConfig(calibration_steps=100, texture_steps=400),
    "paper": AdaptConfig(calibration_steps=100, texture="lora", texture_steps=400, references="all"),
}
"""How the learned prior's guess is adapted; "full" is done for the mean prior too."""
TITLES = {
    FULL: "full model", "prior": "w/o learned prior", "calibration": "w/o colour calibration",
    "texture": "w/o texture learning", "references": "w/o reference views", "light": "w/o the photo's light",
    "schedule": "100 + 400 steps of the field", "paper": "the paper's 100 + 400 steps of LoRA",
}  # fmt: skip
CONTRASTS = {"hidden_more": ("psnr_hidden", "psnr_visible"), "stretched_more": ("psnr_stretched", "psnr_unchanged")}
"""How much better one part of a picture's hand is than the other. What is gained everywhere cancels."""
COLUMNS = {
    **{
        name: SYNTHETIC[name]
        for name in ("psnr", "psnr_inner", "psnr_visible", "psnr_hidden", "psnr_stretched", "psnr_unchanged")
    },
    "hidden_more": Measure("hidden above visible", ".2f"),
    "stretched_more": Measure("stretched above unchanged", ".2f"),
    **{name: SYNTHETIC[name] for name in ("ssim", "ssim_mask", "lpips")},
}


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    prior: str = "learned"
    """learned, or a weights file."""
    people: int = 16
    targets: int = 4
    """Pictures of each of them to compare with."""
    size: int = 256
    """Side of photos and targets [px]."""


# ---- tables of ablations, also of `network_parts`


def ablation_rows(
    records: Sequence[Record], light: str, colors: str, stage: str, variants: Mapping[str, tuple[str, Method]],
    whole: str,
) -> list[Row]:  # fmt: skip
    """A row for each variant: means, and how they differ from those of the variant `whole`, with errors over people.

    Args:
        records: Records of single pictures.
        light: Light of photos and targets.
        colors: "raw", or "matched" to the target.
        stage: How far avatars were adapted.
        variants: Title, and method in the records, by name.
        whole: The variant with all parts.
    """
    seen = [_contrasted(record) for record in select(records, light=light, colors=colors)]
    own = {name: select(seen, **method._asdict()) for name, (_, method) in variants.items()}
    rows = []
    for name, (title, _) in variants.items():
        if own[name]:
            changes = {measure: difference(own[name], own[whole], measure) for measure in COLUMNS}
            rows.append({
                "light": light, "colors": colors, "stage": stage, "whole": whole, "variant": name, "title": title,
                "people": len({record["person"] for record in own[name]}),
                **{measure: mean(own[name], measure) for measure in COLUMNS},
                "change": {measure: change and change._asdict() for measure, change in changes.items()},
            })  # fmt: skip
    return rows


def _contrasted(record: Record) -> Record:
    pairs = {name: (record[part], record[rest]) for name, (part, rest) in CONTRASTS.items()}
    return record | {name: None if None in pair else pair[0] - pair[1] for name, pair in pairs.items()}


def ablation_text(rows: list[Row]) -> str | None:
    """The tables, a heading above each, and how they were made."""
    parts = []
    for table in groups(rows, "light", "colors", "stage", "whole").values():
        shown = {name: column for name, column in COLUMNS.items() if any(row[name] is not None for row in table)}
        lines = [[row["title"], *(_cell(row, name, column) for name, column in shown.items())] for row in table]
        made = markdown(["", *(column.heading for column in shown.values())], lines)
        parts.append(f"{heading(table[0])}:\n\n{made}")
    settings = ", ".join(f"{name} {value}" for name, value in rows[0].get("settings", {}).items()) if rows else ""
    return "\n\n".join([*parts, *([f"Settings: {settings}."] if settings else [])]) or None


def heading(row: Row) -> str:
    """What the table of `row` is of."""
    light = LIGHTS[row["light"]]
    colors = ", colours matched" if row["colors"] == "matched" and "matched" not in light else ""
    return f"{light[0].upper()}{light[1:]}{colors}; {row['stage'].replace('_', '-')}, {row['people']} people"


def _cell(row: Row, measure: str, column: Measure) -> str:
    """The mean of the whole, and the difference from it with its standard error over people."""
    change = row["change"][measure]
    if row[measure] is None:
        return ""
    if row["variant"] == row["whole"]:
        return format(row[measure], column.form)
    if change is None:
        return ""
    error = "" if change["error"] is None else f" ± {format(change['error'], column.form)}"
    return f"{format(change['mean'], '+' + column.form)}{error}"


# ---- adaptation


def evaluate_without(name: str, prior: NetworkPrior, options: Options) -> list[Record]:
    """The pictures' records of one setting; its methods are called after it, or "prior" for that of the mean hand."""
    priors: dict[str, Any] = {"learned": prior, **({"mean": MeanPrior(bundled_hand())} if name == FULL else {})}
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.people, noise=(1.0,), curve=(), adapt=ADAPTATIONS[name],
        capture=CaptureConfig(size=options.size, targets=options.targets),
        methods=tuple(Method(prior, ONE_SHOT) for prior in priors),
    )  # fmt: skip
    folder = options.out / "parts" / f"{name}_{options.people}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    found = evaluate_people(
        priors, config, folder, torch.device(options.device), workers=options.workers, progress=report
    )
    titles = {"learned": name, "mean": "prior"}
    return [{**record, "prior": titles[record["prior"]]} for record in found["pictures"]]


def run(options: Options) -> list[Row]:
    """Evaluate every variant in every light."""
    prior = choose_prior(prior_choice(options.prior))
    if not isinstance(prior, NetworkPrior):
        raise SystemExit("--prior: expected a network.")
    records = [record for name in ADAPTATIONS for record in evaluate_without(name, prior, options)]
    variants = {name: (title, Method(name, ONE_SHOT)) for name, title in TITLES.items()}
    settings = {"people": options.people, "prior": options.prior}
    rows = [
        {"settings": settings, **row}
        for light in COLORS for row in ablation_rows(records, light, COLORS[light], ONE_SHOT, variants, FULL)
    ]  # fmt: skip
    return write_rows(options.out / "parts", rows)


SECTIONS = (Section("evaluation.md", "one-shot", ablation_text),)
