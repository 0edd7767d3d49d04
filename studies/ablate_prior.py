"""Train the network with one part removed at a time, and evaluate each on the same people: the paper's table 2.

    python studies/ablate_prior.py out/ablation --steps 3000 --device cuda --workers 14 --minutes 9

Every variant is trained without point evidence, which is ours and does part of the work of the paper's parts, and
with it; --evidence picks one of the two. Variants are trained side by side on the very same batches, which are
rendered once for all of them. A run that was stopped, or has had its --minutes, goes on from its checkpoints when the
same command comes again. With --only several processes share the training (in one folder); a run without it trains
what is left, evaluates all, prints the tables and leaves ablation.json.
"""

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.evaluation.ablation import ablation_table, as_markdown, heading
from oasis_warp.evaluation.held_out import POPULATIONS
from oasis_warp.evaluation.methods import BASELINE, ONE_SHOT, RAW, Method
from oasis_warp.evaluation.summary import Record
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import PROFILES, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.network.weights_file import load_network, save_network
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import (
    CHECKPOINT,
    WEIGHTS,
    PretrainConfig,
    Trainer,
    load_checkpoint,
    save_checkpoint,
)
from oasis_warp.pretraining.synthetic_source import SyntheticHands

FULL = "full"


class Variant(NamedTuple):
    """A row of the table."""

    title: str
    switches: dict[str, str]


VARIANTS = {
    FULL: Variant("full model", {}),
    "vet_off": Variant("w/o VETs", {"vet": "off"}),
    "no_aggr": Variant("w/o aggregation", {"vet": "no_aggr"}),
    "mlp": Variant("w/o LTEP", {"vet": "mlp"}),
    "vpia_off": Variant("w/o VPIA", {"vpia": "off"}),
    "no_bias": Variant("w/o bias", {"vpia": "no_bias"}),
    "fom_off": Variant("w/o FoM", {"fom": "off"}),
    "refine_off": Variant("w/o refinement", {"refine": "off"}),
    "literal": Variant("visibility as printed", {"visibility": "literal"}),
}
"""The paper's rows, then one of ours."""
WITH = "_with_evidence"
"""Ends the names of networks that have point evidence."""
TABLES = (("studio", "raw"), ("studio", "matched"), ("wild", "matched"))
"""Light and colours; matched ones tell less of the hand's tone, and so more of everything else."""
CHECKPOINT_EVERY, LOG_EVERY = 250, 25


def networks_of(options: argparse.Namespace) -> list[str]:
    """Names of what is trained, as folders have them."""
    ends = {"off": ("",), "on": (WITH,), "both": ("", WITH)}[options.evidence]
    return [name + end for end in ends for name in VARIANTS]


def config_of(name: str, options: argparse.Namespace) -> NetworkConfig:
    """The network of that name."""
    switches = VARIANTS[name.removesuffix(WITH)].switches
    return replace(PROFILES[options.profile], point_evidence="on" if name.endswith(WITH) else "off", **switches)


def rows_of(names: list[str], end: str) -> dict[str, str]:
    """Titles of a table's rows by the names of networks: those that end so, and what point evidence itself is worth."""
    titles = {name + end: variant.title for name, variant in VARIANTS.items() if name + end in names}
    if not end and FULL + WITH in names:
        titles[FULL + WITH] = "with point evidence"
    return titles


def make_trainer(name: str, options: argparse.Namespace, folder: Path) -> Trainer:
    """A network at the start, or where it was left."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        network = HandNetwork(config_of(name, options), bundled_hand())
    config = PretrainConfig(steps=options.steps, precision=options.precision)
    trainer = Trainer(network, config, ProcessInfo(0, 1, torch.device(options.device)))
    if (folder / CHECKPOINT).is_file():
        trainer.step = load_checkpoint(folder / CHECKPOINT, network, trainer.optimizer)
    return trainer


def train_together(names: list[str], options: argparse.Namespace, deadline: float) -> bool:
    """Train the networks side by side; those with weights already are left alone. Whether time was enough."""
    missing = [name for name in names if not (options.out / name / WEIGHTS).is_file()]
    if not missing:
        return True
    hands = SyntheticHands(
        seed=options.seed, people=options.people, hands=options.hands, views=options.views, size=options.size,
        device=torch.device(options.device), population=POPULATIONS["ordinary"], workers=options.workers,
    )  # fmt: skip
    cache = options.baked or options.out / "people"
    cache.mkdir(exist_ok=True)
    hands.bake(hands.people_met(0, 1, options.steps), cache, options.workers, report)
    trainers = {}
    for name in missing:
        (options.out / name).mkdir(exist_ok=True)
        trainers[name] = make_trainer(name, options, options.out / name)
    first = min(trainer.step for trainer in trainers.values())
    began = time.perf_counter()
    for step, batch in zip(range(first, options.steps), hands(first, 0, 1), strict=False):
        behind = {name: trainer for name, trainer in trainers.items() if trainer.step == step}
        found = {name: trainer.advance(batch).psnr for name, trainer in behind.items()}
        if (step + 1) % LOG_EVERY == 0:
            for trainer in behind.values():
                trainer.check_recording()
            line = {"step": step + 1, "psnr": {name: round(float(psnr), 3) for name, psnr in found.items()}}
            with (options.out / "training.jsonl").open("a") as file:
                file.write(json.dumps(line) + "\n")
            pace = (time.perf_counter() - began) / (step + 1 - first)
            print(f"step {step + 1}: {pace:.2f} s each, PSNR {line['psnr']}", file=sys.stderr)
        late = time.monotonic() > deadline and step + 1 < options.steps
        if late or (step + 1) % CHECKPOINT_EVERY == 0 or step + 1 == options.steps:
            for name, trainer in behind.items():
                save_checkpoint(options.out / name / CHECKPOINT, trainer.network, trainer.optimizer, trainer.step)
        if late:
            return False
    for name, trainer in trainers.items():
        save_network(options.out / name / WEIGHTS, trainer.network, notes=json.dumps({"step": trainer.step}))
    return True


def evaluate_all(names: list[str], options: argparse.Namespace) -> list[Record]:
    """Every network on the same held-out people; the records of all pictures."""
    hand = bundled_hand()
    priors = {name: NetworkPrior(load_network(options.out / name / WEIGHTS, hand)) for name in names}
    stages = (RAW, ONE_SHOT) if options.one_shot else (RAW,)
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.held_out, lights=("studio", "wild"), noise=(1.0,), curve=(),
        methods=(BASELINE, *(Method(name, stage) for name in priors for stage in stages)),
    )  # fmt: skip
    folder = options.out / f"evaluation_{options.held_out}_{stages[-1]}"
    found = evaluate(
        {"mean": MeanPrior(hand), **priors}, config, folder, torch.device(options.device), workers=options.workers,
        progress=report,
    )  # fmt: skip
    return found["pictures"]


def report(stage: str, done: int, total: int) -> None:
    """A line now and then."""
    if total and (done == total or done % max(1, total // 10) == 0):
        print(f"{stage}: {done} of {total}", file=sys.stderr)


def main() -> None:
    """Train, evaluate, write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--hands", type=int, default=16, help="photos a batch")
    parser.add_argument("--views", type=int, default=2, help="targets a photo")
    parser.add_argument("--people", type=int, default=512)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--profile", choices=PROFILES, default="compact")
    parser.add_argument("--evidence", choices=("off", "on", "both"), default="both", help="point evidence")
    parser.add_argument("--precision", choices=("bfloat16", "float32"), default="bfloat16")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--workers", type=int, default=8, help="processes that bake people and plan pictures")
    parser.add_argument("--baked", type=Path, help="folder of people that were baked before, as of oasis pretrain")
    parser.add_argument("--held-out", type=int, default=32, help="people to evaluate on")
    parser.add_argument("--one-shot", action="store_true", help="evaluate the adapted avatars too")
    parser.add_argument("--together", type=int, default=5, help="variants at a time: each holds a step's memory")
    parser.add_argument("--only", help="networks to train now, with commas between them; nothing is evaluated")
    parser.add_argument("--minutes", type=float, default=math.inf, help="to train; what is left waits")
    options = parser.parse_args()
    deadline = time.monotonic() + 60 * options.minutes
    everything = networks_of(options)
    names = everything if options.only is None else options.only.split(",")
    if unknown := set(names) - set(everything):
        parser.error(f"--only: expected some of {', '.join(everything)}, got {', '.join(sorted(unknown))}")
    fixed = ("steps", "hands", "views", "people", "size", "seed", "profile", "evidence", "precision")
    open_resumable_folder(
        options.out, "ablation_settings.json", {name: getattr(options, name) for name in fixed}, "ablations"
    )
    for k in range(0, len(names), options.together):
        if not train_together(names[k : k + options.together], options, deadline):
            print("stopped for lack of time; the same command goes on.", file=sys.stderr)
            return
    if options.only is not None:
        return
    records = evaluate_all(everything, options)
    tables = []
    for end in ("", WITH):
        for stage in (RAW, ONE_SHOT) if options.one_shot else (RAW,):
            variants = {name: (title, Method(name, stage)) for name, title in rows_of(everything, end).items()}
            if FULL + end in variants:
                tables += [ablation_table(records, *kind, stage, variants, FULL + end) for kind in TABLES]
    settings = {name: getattr(options, name) for name in (*fixed, "held_out")}
    write_file(options.out / "ablation.json", json.dumps({"settings": settings, "tables": tables}, indent=1).encode())
    for table in tables:
        print(f"{heading(table)}\n\n{as_markdown(table)}\n")


if __name__ == "__main__":
    main()
