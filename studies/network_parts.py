"""What each part of the network is worth: trained with one part removed at a time (the paper's table 2).

Fills docs/evaluation.md (network). All variants are trained on the very same batches. A run that was stopped, or has
used up its `--minutes`, goes on from its checkpoints when the same command comes again. With `--only` several processes
share the training; a run without it trains what is left and evaluates all.
"""

import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.data.output_files import open_resumable_folder
from oasis_warp.evaluation.held_out import POPULATIONS, CaptureConfig
from oasis_warp.evaluation.methods import BASELINE, RAW, Method
from oasis_warp.evaluation.summary import Record
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate_people
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import PROFILES, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.network.weights_file import load_network
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import WEIGHTS, PretrainConfig, pretrain
from oasis_warp.pretraining.prior_trainer import PriorTrainer
from oasis_warp.pretraining.synthetic_source import SyntheticHands
from studies.harness import SETTINGS, Row, StudyOptions, report, write_rows
from studies.parts import FULL, ablation_rows, ablation_text
from studies.tables import Section


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
TABLES = (("studio", "raw"), ("studio", "matched"), ("wild", "matched"))
"""Light and colours; matched ones say less of the hand's tone, and so more of everything else."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"device", "baked", "held_out", "targets", "only", "minutes"})
    steps: int = 3000
    hands: int = 16
    """Photos per batch."""
    views: int = 2
    """Targets of each photo."""
    people: int = 512
    size: int = 256
    seed: int = 0
    profile: str = "compact"
    evidence: Literal["off", "on"] = "off"
    """Networks without point evidence, which is ours and does part of the work of the paper's parts, or with it."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    baked: Path | None = None
    """Folder of people that were baked before, as of `oasis pretrain`."""
    held_out: int = 32
    """People to evaluate on."""
    targets: int = 4
    """Pictures of each of them."""
    only: tuple[str, ...] = ()
    """Networks to train now; nothing is evaluated."""
    minutes: float = math.inf
    """To train; the rest waits for the next run."""


def network_config(name: str, options: Options) -> NetworkConfig:
    """The network of that name."""
    return replace(PROFILES[options.profile], point_evidence=options.evidence, **VARIANTS[name].switches)


def train(name: str, hands: SyntheticHands, folder: Path, options: Options, deadline: float) -> bool:
    """Train one network, or go on from its checkpoint; whether there was enough time."""
    folder.mkdir(exist_ok=True)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        network = HandNetwork(network_config(name, options), bundled_hand())
    config = PretrainConfig(steps=options.steps, precision=options.precision)
    trainer = PriorTrainer(network, config, ProcessInfo(0, 1, hands.device))
    done = pretrain(trainer, hands, folder, should_stop=lambda: time.monotonic() > deadline, progress=report)
    return done == options.steps


def evaluate_all(names: list[str], folder: Path, options: Options) -> list[Record]:
    """Every network on the same held-out people; the records of all pictures."""
    hand = bundled_hand()
    priors = {name: NetworkPrior(load_network(folder / name / WEIGHTS, hand)) for name in names}
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.held_out, lights=("studio", "wild"), noise=(1.0,), curve=(),
        capture=CaptureConfig(size=options.size, targets=options.targets),
        methods=(BASELINE, *(Method(name, RAW) for name in priors)),
    )  # fmt: skip
    place, device = folder / f"evaluation_{options.held_out}", torch.device(options.device)
    priors = {"mean": MeanPrior(hand), **priors}
    return evaluate_people(priors, config, place, device, workers=options.workers, progress=report)["pictures"]


def run(options: Options) -> list[Row]:
    """Train, and evaluate when all are trained."""
    deadline, everything = time.monotonic() + 60 * options.minutes, list(VARIANTS)
    if unknown := set(options.only) - set(everything):
        raise SystemExit(f"--only: expected some of {', '.join(everything)}, got {', '.join(sorted(unknown))}")
    folder = options.out / "network_parts"
    options.out.mkdir(parents=True, exist_ok=True)
    open_resumable_folder(folder, SETTINGS, options.settings(), "ablations")
    hands = SyntheticHands(
        seed=options.seed, people=options.people, hands=options.hands, views=options.views, size=options.size,
        device=torch.device(options.device), population=POPULATIONS["ordinary"], workers=options.workers,
    )  # fmt: skip
    baked = options.baked or folder / "people"
    baked.mkdir(exist_ok=True)
    hands.bake(hands.people_met(0, 1, options.steps), baked, options.workers, report)
    for name in options.only or everything:
        if not train(name, hands, folder / name, options, deadline):
            print("stopped for lack of time; the same command continues.", file=sys.stderr)
            return []
    if options.only:
        return []
    records = evaluate_all(everything, folder, options)
    variants = {name: (variant.title, Method(name, RAW)) for name, variant in VARIANTS.items()}
    settings = {**options.settings(), "held_out": options.held_out}
    rows = [row for kind in TABLES for row in ablation_rows(records, *kind, RAW, variants, FULL)]
    return write_rows(folder, ({"settings": settings, **row} for row in rows))


SECTIONS = (Section("evaluation.md", "network", ablation_text),)
