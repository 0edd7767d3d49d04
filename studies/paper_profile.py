"""The paper's own settings on one GPU: memory and time of a step, and four synthetic people learned by heart.

Fills docs/network.md (paper cost, paper curve, paper adaptation). Weights are random, those of DINOv2 and LPIPS too:
neither memory nor time depends on them, and four photos can be told apart by random features. On a machine without the
packages of the command line: `python -c "from studies import paper_profile as p; p.run(p.Options())"`.
"""

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.core.config import PAPER_ADAPTATION
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import TrainingBatch
from oasis_warp.evaluation.synthetic import crop_of
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses import Lpips, detail_difference
from oasis_warp.network.config import PROFILES
from oasis_warp.network.encoders import DinoV2Encoder
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import EAGER_STEPS, PretrainConfig
from oasis_warp.pretraining.prior_trainer import PriorTrainer
from oasis_warp.pretraining.synthetic_source import SyntheticHands
from studies.harness import Row, StudyOptions, measured, report
from studies.tables import Column, Section, table

PEOPLE, VIEWS = 4, 4
"""Synthetic people that are learned by heart, and targets of a photo, which are the paper's."""
PHOTOS = 1_000_000
"""Number of photos that the cost of a training is told for: the paper names neither its steps nor its batch."""
SPREAD = 0.02
"""Standard deviation of random positions and of the weights of random LPIPS layers, as transformers start with."""
SHOWN = (0, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Steps of the curve."""
WARM = EAGER_STEPS + 4
"""Steps before the clock starts: eager ones, the capture, and some replays."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    device: Literal["cpu", "cuda"] = "cuda"
    profiles: tuple[str, ...] = ("paper", "compact")
    """Networks to measure."""
    hands: tuple[int, ...] = (1, 4, 8, 16)
    """Photos a step, for memory and time."""
    steps: int = 1000
    """In which four people are learned by heart."""
    learning_rate: float = 4e-4
    """The paper's."""
    warmup: int = 200
    """Steps over which the learning rate rises."""
    timed: int = 40
    """Steps that are timed, after some to warm up."""
    size: int = 256
    """Side of photos and targets [px]."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    planners: int = 8
    """Processes that plan pictures ahead where steps with new pictures are timed."""
    seed: int = 0


def random_network(profile: str, seed: int) -> HandNetwork:
    """A network of that profile, its backbone random too."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = HandNetwork(PROFILES[profile], bundled_hand())
        if isinstance(network.encoder, DinoV2Encoder):
            for table_ in (network.encoder.position, network.encoder.cls):
                torch.nn.init.normal_(table_.data, std=SPREAD)
    return network


def random_lpips(seed: int, device: str) -> Lpips:
    """LPIPS on VGG-16 with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Lpips("vgg")
        for line in network.lines:
            torch.nn.init.normal_(line.data, std=SPREAD).abs_()
    return network.to(device)


def trainer_of(profile: str, lpips: bool, steps: int, options: Options) -> PriorTrainer:
    """A new network in training."""
    config = PretrainConfig(
        steps=steps, precision=options.precision, learning_rate=options.learning_rate, warmup=options.warmup
    )
    return PriorTrainer(
        random_network(profile, options.seed), config, ProcessInfo(0, 1, torch.device(options.device)),
        perceptual=random_lpips(options.seed, options.device) if lpips else detail_difference,
    )  # fmt: skip


def batches(hands: int, options: Options, planners: int = 0) -> Iterator[TrainingBatch]:
    """Batches of the synthetic people."""
    source = SyntheticHands(
        seed=options.seed, people=PEOPLE, hands=hands, views=VIEWS, size=options.size,
        device=torch.device(options.device), workers=planners,
    )  # fmt: skip
    folder = options.out / "paper_profile" / "people"
    folder.mkdir(parents=True, exist_ok=True)
    source.bake(list(range(PEOPLE)), folder, 0, report)
    return source(0, 0, 1)


def wait(device: str) -> None:
    """Until the device has done its work."""
    if device == "cuda":
        torch.cuda.synchronize()


def seconds_each(call: Callable[[], object], options: Options) -> float:
    """Seconds of a call, over `options.timed` calls."""
    wait(options.device)
    start = time.perf_counter()
    for _ in range(options.timed):
        call()
    wait(options.device)
    return (time.perf_counter() - start) / options.timed


def start_memory(device: str) -> None:
    """Begin to watch how much memory is taken, after what is no longer needed is gone."""
    gc.collect()
    if device == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def memory_gib(device: str) -> float | None:
    """Most that torch has taken from the device since, its reserves too [GiB]; None on the CPU."""
    return torch.cuda.max_memory_reserved() / 2**30 if device == "cuda" else None


def measure_cost(profile: str, hands: int, lpips: bool, options: Options) -> Row:
    """Memory and time of a step with so many photos, on the same pictures again and on new ones every time.

    Raises:
        InputError: the device has not enough memory.
    """
    coming = batches(hands, options, options.planners)
    batch = next(coming)
    start_memory(options.device)
    try:
        trainer = trainer_of(profile, lpips, 1_000_000, options)
        for _ in range(WARM if options.device == "cuda" else 1):
            trainer.advance(batch)
        step = seconds_each(lambda: trainer.advance(batch), options)
        with_pictures = seconds_each(lambda: trainer.advance(next(coming)), options)
    except torch.cuda.OutOfMemoryError as error:
        raise InputError(f"{hands} photos: more memory than the device has; give fewer.") from error
    return {
        "kind": "cost", "profile": profile, "hands": hands, "lpips": lpips, "step_s": step, "loop_s": with_pictures,
        "peak_gib": memory_gib(options.device), "device": device_name(options),
        "trained": sum(parameter.numel() for parameter in trainer.trained),
    }  # fmt: skip


def device_name(options: Options) -> str:
    """What was measured on."""
    return torch.cuda.get_device_name() if options.device == "cuda" else "CPU"


def measure_curve(profile: str, options: Options) -> list[Row]:
    """Loss and PSNR of four people's pictures that a network sees again and again, and PSNR of others of them."""
    coming = batches(PEOPLE, options)
    batch, other = next(coming), next(coming)
    trainer = trainer_of(profile, False, options.steps, options)
    shown, rows = {*SHOWN, options.steps}, []
    for step in range(options.steps + 1):
        if step in shown:
            with torch.no_grad():
                same, unseen = (trainer.evaluate(pictures) for pictures in (batch, other))
            rows.append({
                "kind": "curve", "profile": profile, "step": step, "loss": float(same.loss),
                "psnr": float(same.metrics["psnr"]), "psnr_other": float(unseen.metrics["psnr"]),
            })  # fmt: skip
            report(f"{profile}, {rows[-1]['psnr']:.2f} dB", step, options.steps)
            trainer.check_recording()
        if step < options.steps:
            trainer.advance(batch)
    return [*rows, measure_adaptation(profile, trainer.network, batch, options)]


def measure_adaptation(profile: str, network: HandNetwork, batch: TrainingBatch, options: Options) -> Row:
    """Memory and time of the paper's one-shot adaptation to one photo, the kernels loaded before."""
    photo = crop_of(TrainingBatch(*(part[:1] for part in batch)))
    prior, hand = NetworkPrior(network), bundled_hand()
    start_memory(options.device)
    for adapting in (replace(PAPER_ADAPTATION, texture_steps=1), PAPER_ADAPTATION):
        wait(options.device)
        start = time.perf_counter()
        guess, heads = prior.with_heads(photo)
        wait(options.device)
        guessed = time.perf_counter()
        adapted = adapt(hand, [guess], [photo], adapting, heads=heads)
        wait(options.device)
        done = time.perf_counter()
    return {
        "kind": "adaptation", "profile": profile, "peak_gib": memory_gib(options.device),
        "steps": f"{PAPER_ADAPTATION.calibration_steps} + {len(adapted.losses)}", "guess_s": guessed - start,
        "adapt_s": done - guessed, "first": adapted.losses[0], "last": adapted.losses[-1],
    }  # fmt: skip


def measure_profile(what: str, options: Options, *about: object) -> list[Row] | Row:
    """A case."""
    functions: dict[str, Callable[..., list[Row] | Row]] = {"cost": measure_cost, "curve": measure_curve}
    return functions[what](*about, options)


def run(options: Options) -> list[Row]:
    """Measure every profile: costs with and without LPIPS, then the curve."""
    cases: dict[str, tuple] = {}
    for profile in options.profiles:
        for hands in options.hands:
            cases[f"{profile}, {hands}"] = ("cost", options, profile, hands, False)
            if profile == "paper":
                cases[f"{profile}, {hands}, LPIPS"] = ("cost", options, profile, hands, True)
        cases[f"{profile}, curve"] = ("curve", options, profile)
    return measured("paper_profile", cases, measure_profile, options)


# ---- tables


def of_kind(kind: str) -> Callable[[list[Row]], list[Row]]:
    """Selects rows."""
    return lambda rows: [row for row in rows if row.get("kind") == kind]


def gpu_hours(row: Row, seconds: str) -> float:
    """For `PHOTOS` photos, by the seconds of a step."""
    return PHOTOS / row["hands"] * row[seconds] / 3600


COST = (
    Column("profile", "profile"), Column("photos a step", "hands"),
    Column("LPIPS", lambda row: "VGG-16" if row["lpips"] else "no"), Column("GiB", "peak_gib", ".1f"),
    Column("ms a step", lambda row: 1e3 * row["step_s"], ".1f"),
    Column("with new pictures", lambda row: 1e3 * row["loop_s"], ".1f"),
    Column("photos a second", lambda row: row["hands"] / row["step_s"], ".1f"),
    Column("GPU hours for a million", lambda row: gpu_hours(row, "step_s"), ".1f"),
    Column("with new pictures", lambda row: gpu_hours(row, "loop_s"), ".1f"),
)  # fmt: skip
CURVE = (
    Column("profile", "profile"), Column("step", "step"), Column("loss", "loss", ".3f"),
    Column("PSNR, the pictures it learns", "psnr", ".2f"),
    Column("other pictures of these people", "psnr_other", ".2f"),
)  # fmt: skip
ADAPTATION = (
    Column("profile", "profile"), Column("steps", "steps"), Column("s for the guess", "guess_s", ".3f"),
    Column("s to adapt", "adapt_s", ".1f"), Column("GiB", "peak_gib", ".1f"), Column("loss at first", "first", ".3f"),
    Column("at last", "last", ".3f"),
)  # fmt: skip
SECTIONS = (
    Section("network.md", "paper cost", table(COST, of_kind("cost"))),
    Section("network.md", "paper curve", table(CURVE, of_kind("curve"))),
    Section("network.md", "paper adaptation", table(ADAPTATION, of_kind("adaptation"))),
)
