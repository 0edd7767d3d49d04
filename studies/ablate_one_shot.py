"""Adapt with one part removed at a time, and evaluate each on the same people: the paper's table 4.

    python studies/ablate_one_shot.py out/one_shot --prior learned --device cuda --people 32

The prior is the bundled one, or that of a weights file. A run that was stopped goes on; leaves ablation.json.
"""

import argparse
import json
import sys
from pathlib import Path

import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.data.output_files import write_file
from oasis_warp.evaluation.ablation import ablation_table, as_markdown, heading
from oasis_warp.evaluation.columns import COLORS
from oasis_warp.evaluation.methods import ONE_SHOT, Method
from oasis_warp.evaluation.summary import Record
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import choose_prior

FULL = "full"
LEARNED = Method("learned", ONE_SHOT)
SETTINGS = {
    FULL: AdaptConfig(),
    "calibration": AdaptConfig(calibration="off"),
    "texture": AdaptConfig(texture_steps=0),
    "references": AdaptConfig(reference_views=0),
    "light": AdaptConfig(light="even"),
    "schedule": AdaptConfig(calibration_steps=100, texture_steps=400),
    "paper": AdaptConfig(calibration_steps=100, texture="lora", texture_steps=400, references="all"),
}
"""How the learned prior is adapted; "full" is done for the mean prior too."""
TITLES = {
    FULL: "full model", "prior": "w/o learned prior", "calibration": "w/o colour calibration",
    "texture": "w/o texture learning", "references": "w/o reference views",
    "light": "w/o the photo's light", "schedule": "100 + 400 steps of the field",
    "paper": "the paper's 100 + 400 steps of LoRA",
}  # fmt: skip


def measure(name: str, options: argparse.Namespace) -> list[Record]:
    """The records of one setting; its methods are called after it, or "prior" for that of the mean hand."""
    priors = {"learned": choose_prior(Path(options.prior) if options.prior != "learned" else "learned")}
    if name == FULL:
        priors["mean"] = MeanPrior(bundled_hand())
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.people, noise=(1.0,), curve=(), adapt=SETTINGS[name],
        methods=tuple(Method(prior, ONE_SHOT) for prior in priors),
    )  # fmt: skip
    found = evaluate(
        priors, config, options.out / f"{name}_{options.people}", torch.device(options.device),
        workers=options.workers, progress=lambda *how_far: report(name, *how_far),
    )  # fmt: skip
    titles = {"learned": name, "mean": "prior"}
    return [{**record, "prior": titles[record["prior"]]} for record in found["pictures"]]


def report(setting: str, stage: str, done: int, total: int) -> None:
    """A line now and then."""
    if total and (done == total or done % max(1, total // 10) == 0):
        print(f"{setting}, {stage}: {done} of {total}", file=sys.stderr)


def main() -> None:
    """Measure every setting, write and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--prior", default="learned", help="learned, or a weights file")
    parser.add_argument("--people", type=int, default=32)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--workers", type=int, default=0, help="processes that measure people side by side")
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    records = [record for name in SETTINGS for record in measure(name, options)]
    variants = {name: (title, Method(name, ONE_SHOT)) for name, title in TITLES.items()}
    tables = [ablation_table(records, light, COLORS[light], ONE_SHOT, variants, FULL) for light in COLORS]
    settings = {"people": options.people, "prior": str(options.prior)}
    write_file(options.out / "ablation.json", json.dumps({"settings": settings, "tables": tables}, indent=1).encode())
    for table in tables:
        print(f"{heading(table)}\n\n{as_markdown(table)}\n")


if __name__ == "__main__":
    main()
