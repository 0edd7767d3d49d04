"""Train the network with one part removed at a time, and evaluate each on the same people: the paper's table 2.

    python tools/ablate_prior.py out/ablation --steps 3000 --device cuda --workers 14

Variants are trained side by side on the very same batches, which are rendered once for all of them. A run that was
stopped goes on from its checkpoints. With --only several processes share the training (in one folder); a run
without it trains what is left, evaluates all, prints the tables and leaves ablation.json.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.data.atomic import write_file
from oasis_warp.data.claimed_folder import claim_folder
from oasis_warp.evaluation.ablation import ablation_rows, as_markdown
from oasis_warp.evaluation.columns import COLORS
from oasis_warp.evaluation.held_out import POPULATIONS
from oasis_warp.evaluation.methods import BASELINE, ONE_SHOT, RAW, Method
from oasis_warp.evaluation.summary import Record
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import PROFILES, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.network.weights_file import load_network, save_network
from oasis_warp.training.checkpoint import load_checkpoint, save_checkpoint
from oasis_warp.training.distributed import Place
from oasis_warp.training.pretrain import CHECKPOINT, WEIGHTS, PretrainConfig, Trainer
from oasis_warp.training.synthetic_source import SyntheticHands

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
    "evidence": Variant("point evidence switched", {}),
}
"""The paper's rows, then ours. The last has what the others have not, or not what they have: see --evidence."""
CHECKPOINT_EVERY, LOG_EVERY = 250, 25


def config_of(name: str, options: argparse.Namespace) -> NetworkConfig:
    """The variant's network."""
    evidence = options.evidence
    if name == "evidence":
        evidence = "off" if evidence == "on" else "on"
    return replace(PROFILES[options.profile], point_evidence=evidence, **VARIANTS[name].switches)


def make_trainer(name: str, options: argparse.Namespace, folder: Path) -> Trainer:
    """A network at the start, or where it was left."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        network = HandNetwork(config_of(name, options), bundled_hand())
    config = PretrainConfig(steps=options.steps, precision=options.precision)
    trainer = Trainer(network, config, Place(0, 1, torch.device(options.device)))
    if (folder / CHECKPOINT).is_file():
        trainer.step = load_checkpoint(folder / CHECKPOINT, network, trainer.optimizer)
    return trainer


def train_together(names: list[str], options: argparse.Namespace) -> None:
    """Train the variants side by side; those with weights already are left alone."""
    missing = [name for name in names if not (options.out / name / WEIGHTS).is_file()]
    if not missing:
        return
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
        if (step + 1) % CHECKPOINT_EVERY == 0 or step + 1 == options.steps:
            for name, trainer in behind.items():
                save_checkpoint(options.out / name / CHECKPOINT, trainer.network, trainer.optimizer, trainer.step)
    for name, trainer in trainers.items():
        save_network(options.out / name / WEIGHTS, trainer.network, notes=json.dumps({"step": trainer.step}))


def evaluate_all(options: argparse.Namespace) -> list[Record]:
    """Every variant on the same held-out people; the records of all pictures."""
    hand = bundled_hand()
    priors = {name: NetworkPrior(load_network(options.out / name / WEIGHTS, hand)) for name in VARIANTS}
    stages = (RAW, ONE_SHOT) if options.one_shot else (RAW,)
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.held_out, noise=(1.0,), curve=(),
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
    parser.add_argument(
        "--evidence", choices=("on", "off"), default="off",
        help="point evidence of all rows but the last: it is ours, and the paper's parts do its work without it",
    )  # fmt: skip
    parser.add_argument("--precision", choices=("bfloat16", "float32"), default="bfloat16")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--workers", type=int, default=8, help="processes that bake people and plan pictures")
    parser.add_argument("--baked", type=Path, help="folder of people that were baked before, as of oasis pretrain")
    parser.add_argument("--held-out", type=int, default=32, help="people to evaluate on")
    parser.add_argument("--one-shot", action="store_true", help="evaluate the adapted avatars too")
    parser.add_argument("--together", type=int, default=5, help="variants at a time: each holds a step's memory")
    parser.add_argument("--only", help="variants to train now, with commas between them; nothing is evaluated")
    options = parser.parse_args()
    names = list(VARIANTS) if options.only is None else options.only.split(",")
    if unknown := set(names) - VARIANTS.keys():
        parser.error(f"--only: expected some of {', '.join(VARIANTS)}, got {', '.join(sorted(unknown))}")
    fixed = ("steps", "hands", "views", "people", "size", "seed", "profile", "evidence", "precision")
    claim_folder(options.out, "ablation_settings.json", {name: getattr(options, name) for name in fixed}, "ablations")
    for k in range(0, len(names), options.together):
        train_together(names[k : k + options.together], options)
    if options.only is not None:
        return
    records = evaluate_all(options)
    tables = []
    for stage in (RAW, ONE_SHOT) if options.one_shot else (RAW,):
        variants = {name: (variant.title, Method(name, stage)) for name, variant in VARIANTS.items()}
        tables += [(light, stage, ablation_rows(records, light, variants, FULL)) for light in COLORS]
    found = [{"light": light, "stage": stage, "rows": rows} for light, stage, rows in tables]
    settings = {name: getattr(options, name) for name in (*fixed, "held_out")}
    text = json.dumps({"settings": settings, "whole": FULL, "tables": found}, indent=1)
    write_file(options.out / "ablation.json", text.encode())
    for light, stage, rows in tables:
        print(f"{light} photos, {stage.replace('_', '-')}\n\n{as_markdown(rows, FULL)}\n")


if __name__ == "__main__":
    main()
