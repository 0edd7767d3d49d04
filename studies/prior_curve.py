"""How the prior's quality grows with people, width and steps, and what a discriminator adds on hidden skin.

Fills docs/prior.md (curve, sharp). Networks of the curve are trained from scratch, each with several seeds; those of
the second table go on from the weights that ship. All are measured on the same held-out people. A run that was stopped
goes on from its checkpoints. With `--only` several processes share the training; a run without it trains what is left
and measures all.
"""

import statistics
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch

from oasis_warp.data.output_files import open_resumable_folder
from oasis_warp.evaluation.held_out import POPULATIONS, CaptureConfig
from oasis_warp.evaluation.methods import ONE_SHOT, PAINTED, RAW, Method
from oasis_warp.evaluation.metrics import HIDDEN_CONTRASTS, HIDDEN_LIKENESS
from oasis_warp.evaluation.summary import Record, mean, select
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate_people
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior, bundled_prior
from oasis_warp.network.weights_file import load_network
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import WEIGHTS, PretrainConfig, pretrain
from oasis_warp.pretraining.prior_trainer import PriorTrainer
from oasis_warp.pretraining.sharp_prior import SharpConfig, SharpPriorTrainer
from oasis_warp.pretraining.synthetic_source import SyntheticHands
from studies.harness import SETTINGS, Row, StudyOptions, report, write_rows
from studies.tables import Section, markdown


class Variant(NamedTuple):
    """One network."""

    title: str
    people: int = 256
    width: int = COMPACT.width
    steps: int = 900
    start: bool = False
    """Whether it goes on from the weights that ship."""
    adversarial: float | None = None
    """Weight of the discriminator; None without one."""


CURVE = {
    "middle": Variant("256 people, 192 channels, 900 steps"),
    "few": Variant("64 people", people=64),
    "many": Variant("1024 people", people=1024),
    "narrow": Variant("128 channels", width=128),
    "wide": Variant("256 channels", width=256),
    "short": Variant("300 steps", steps=300),
    "long": Variant("2700 steps", steps=2700),
}
SHARP = {
    "longer": Variant("2,700 steps more, as before", steps=2700, start=True),
    "sharp": Variant("2,700 steps more with a discriminator", steps=2700, start=True, adversarial=0.1),
    "sharper": Variant("the same, three times its weight", steps=2700, start=True, adversarial=0.3),
}
SHIPPED = "learned"
MEASURES = ("psnr_inner", "psnr_visible", "psnr_hidden", *HIDDEN_CONTRASTS, *HIDDEN_LIKENESS)


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"device", "only", "held_out", "seeds", "of"})
    of: tuple[str, ...] = ("curve", "sharp")
    """Tables to make."""
    only: tuple[str, ...] = ()
    """Networks to train now, as NAME or NAME_SEED; nothing is measured."""
    seeds: int = 3
    """Seeds of the networks of the curve; the others have one."""
    hands: int = 8
    """Photos per batch."""
    views: int = 2
    """Targets of each photo."""
    size: int = 256
    held_out: int = 100
    """People to measure on."""


def runs(options: Options) -> dict[str, tuple[Variant, int]]:
    """Each network's name, and its variant and seed."""
    found: dict[str, tuple[Variant, int]] = {}  # in the order of seeds: networks of one seed learn from the same people
    if "curve" in options.of:
        found |= {f"{name}_{seed}": (each, seed) for seed in range(options.seeds) for name, each in CURVE.items()}
    if "sharp" in options.of:
        found = {f"{name}_0": (each, 0) for name, each in SHARP.items()} | found
    return found


def train(variant: Variant, seed: int, folder: Path, options: Options) -> None:
    """Train one network, or go on from its checkpoint."""
    if (folder / "done").exists():
        return
    folder.mkdir(exist_ok=True)
    device = torch.device(options.device)
    hands = SyntheticHands(
        seed=100 + seed, people=variant.people, hands=options.hands, views=options.views, size=options.size,
        device=device, population=POPULATIONS["ordinary"], workers=options.workers, ahead=4,
    )  # fmt: skip
    hands.bake(hands.people_met(0, 1, variant.steps), None, options.workers, report)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = HandNetwork(replace(COMPACT, width=variant.width), bundled_hand())
    if variant.start:
        network.load_state_dict(bundled_prior().network.state_dict())
    trainer = PriorTrainer if variant.adversarial is None else partial(
        SharpPriorTrainer, seed=seed, sharp=SharpConfig(adversarial=variant.adversarial)
    )  # fmt: skip
    pretrain(
        trainer(network, PretrainConfig(steps=variant.steps), ProcessInfo(0, 1, device)), hands, folder, progress=report
    )
    (folder / "done").touch()


def measure(names: list[str], folder: Path, options: Options) -> list[Record]:
    """Every network on the same held-out people; the records of all pictures."""
    hand = bundled_hand()
    priors = {name: NetworkPrior(load_network(folder / name / WEIGHTS, hand)) for name in names}
    whole = [name for name in (SHIPPED, *names) if name.rsplit("_", 1)[0] in (SHIPPED, *SHARP)]
    methods = [Method(name, RAW) for name in (SHIPPED, *names)]
    methods += [Method(name, stage) for name in whole for stage in (ONE_SHOT, PAINTED)]
    config = SyntheticEvaluation(
        groups=("ordinary",), people=options.held_out, lights=("studio",), noise=(1.0,), curve=(),
        capture=CaptureConfig(size=options.size), methods=tuple(methods),
    )  # fmt: skip
    place = folder / f"evaluation_{'_'.join(options.of)}_{options.held_out}"
    return evaluate_people(
        {SHIPPED: bundled_prior(), **priors}, config, place, torch.device(options.device), workers=options.workers,
        progress=report,
    )["pictures"]  # fmt: skip


def run(options: Options) -> list[Row]:
    """Train, and measure when all are trained."""
    wanted = runs(options)
    chosen = [name for name in wanted if not options.only or {name, name.rsplit("_", 1)[0]} & set(options.only)]
    folder = options.out / "prior_curve"
    options.out.mkdir(parents=True, exist_ok=True)
    open_resumable_folder(folder, SETTINGS, options.settings(), "trainings")
    for name in chosen:
        train(*wanted[name], folder / name, options)
    if options.only:
        return []
    records = select(measure(list(wanted), folder, options), colors="raw")
    rows = []
    for name, stage in dict.fromkeys((record["prior"], record["stage"]) for record in records):
        own = select(records, prior=name, stage=stage)
        variant, seed = wanted.get(name, (Variant("as shipped"), 0))
        rows.append({
            "network": name, "stage": stage, "title": variant.title, "seed": seed,
            "people": len({record["person"] for record in own}), **{key: mean(own, key) for key in MEASURES},
        })  # fmt: skip
    return write_rows(folder, rows)


def curve(rows: list[Row]) -> str | None:
    """A line for each network of the curve: means over the seeds and their standard deviation."""
    lines = []
    for name, variant in CURVE.items():
        own = [row for row in rows if row["network"].rsplit("_", 1)[0] == name]
        if own:
            cells = (_spread([row[key] for row in own], ".2f") for key in ("psnr_inner", "psnr_visible", "psnr_hidden"))
            lines.append([variant.title, *cells, _bands(own, HIDDEN_CONTRASTS)])
    headings = ["network", "PSNR inside the outline", "visible", "hidden", "contrast of hidden skin over the truth's"]
    return markdown(headings, lines) if lines else None


def sharp(rows: list[Row]) -> str | None:
    """A line for each network and stage."""
    lines = []
    for row in rows:
        name = row["network"].rsplit("_", 1)[0]
        if name in (SHIPPED, *SHARP):
            numbers = (format(row[key], ".2f") for key in ("psnr_visible", "psnr_hidden"))
            bands = (_bands([row], keys) for keys in (HIDDEN_CONTRASTS, HIDDEN_LIKENESS))
            lines.append([row["title"], row["stage"].replace("_", "-"), *numbers, *bands])
    headings = ["network", "stage", "PSNR visible", "hidden", "contrast over the truth's", "likeness"]
    return markdown(headings, lines) if any(row["network"] != SHIPPED for row in rows) else None


def _spread(values: list[float], form: str) -> str:
    if len(values) == 1:
        return format(values[0], form)
    return f"{statistics.fmean(values):{form}} ± {statistics.stdev(values):{form}}"


def _bands(rows: list[Row], keys: tuple[str, ...]) -> str:
    """Means over rows, one a band."""
    return " / ".join(f"{statistics.fmean(row[key] for row in rows):.2f}" for key in keys)


SECTIONS = (Section("prior.md", "curve", curve), Section("prior.md", "sharp", sharp))
