"""`oasis pretrain`: train the learned prior, or the dense network, on the synthetic world."""

import hashlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from oasis_warp.cli.developer_options import Pretrain
from oasis_warp.cli.progress import INTERRUPTED, Terminal, show_progress
from oasis_warp.cli.record import keep_command
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.published_files import published_file
from oasis_warp.data.output_files import open_resumable_folder, remove_leftovers
from oasis_warp.datasets.readers import PAPER, read_dataset, read_selection
from oasis_warp.datasets.training_source import DatasetHands, MixedHands
from oasis_warp.hand.mano import read_mano
from oasis_warp.hand.template import MANO_DIR, bundled_hand, chosen_hand
from oasis_warp.losses import load_lpips
from oasis_warp.network.config import PROFILES, NetworkConfig
from oasis_warp.network.dense_network import DenseNetwork, load_dense_network
from oasis_warp.network.encoders import DinoV2Encoder
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, read_config
from oasis_warp.pretraining.dense_trainer import DensePhotos, DenseTrainer
from oasis_warp.pretraining.distributed import ProcessInfo, join_processes, wait_for_all
from oasis_warp.pretraining.pretrain import CHECKPOINT, BatchSource, PretrainConfig, Trainer, pretrain
from oasis_warp.pretraining.prior_trainer import PriorTrainer
from oasis_warp.pretraining.sharp_prior import SharpPriorTrainer
from oasis_warp.pretraining.synthetic_source import MULTIPLE, SyntheticHands
from oasis_warp.synthetic.people import max_people_cached
from oasis_warp.synthetic.shots import EVERYBODY, PICTURES_EACH

SETTINGS, PEOPLE = "training.json", "people"
"""Names in the folder: the settings of the training, and the folder of people baked on a CPU."""
PRECISIONS = {"bf16": "bfloat16", "float32": "float32"}
DENSE_SCHEDULE: dict[str, Any] = {"learning_rate": 1e-3, "warmup": 300, "decay": "cooldown"}
"""Schedule of the dense network's training; a cooldown lets a training go on from weights before it."""
SHOWN_REASONS = 5
"""Number of reasons that are printed for samples left out; evaluation and Python give all."""
AHEAD = 4
"""Batches that a GPU renders together."""
SIZES = range(32, 1025, MULTIPLE)


def run(options: Pretrain) -> int:
    """Start or resume a training; Ctrl-C keeps what is done.

    Raises:
        InputError: a wrong option or folder, weights that do not fit, or a loss that is not finite.
    """
    check_device(options.device, "--")
    check_options(options)
    with join_processes(options.device) as process:
        shown = show_progress(Terminal()) if process.rank == 0 else nullcontext(silent)
        try:
            with shown as progress:
                done = train(options, process, progress)
        except KeyboardInterrupt:
            done = 0
    if process.rank == 0:
        keep_command(options.out)
    if done == options.steps:
        return 0
    if process.rank == 0:
        print(f"oasis: stopped; finished steps stay in {options.out}, the same command continues.", file=sys.stderr)
    return INTERRUPTED


def check_options(options: Pretrain) -> None:
    """Check the options before any work.

    Raises:
        InputError: a number out of range, or weights that the network does not need or lacks.
    """
    for name, least in {"steps": 1, "hands": 1, "people": 1, "seed": 0, "workers": 0}.items():
        value = getattr(options, name)
        if value < least:
            raise InputError(f"--{name}: expected {least} or more, got {value}.")
    if not 1 <= options.views <= PICTURES_EACH:
        raise InputError(f"--views: expected 1 to {PICTURES_EACH}, got {options.views}; increase --hands instead.")
    if options.size not in SIZES:
        raise InputError(
            f"--size: expected a multiple of {MULTIPLE} from {SIZES[0]} to {SIZES[-1]} pixels, got {options.size}."
        )
    if not 0 <= options.data_weight <= 1:
        raise InputError(f"--data-weight: expected 0 to 1, got {options.data_weight:g}.")
    if (options.data is None) != (options.root is None):
        raise InputError("--data and --root belong together: the name of a data set, and its folder; give both.")
    if options.selection is not None and options.data != "interhand":
        raise InputError("--selection: works only with --data interhand; leave it out.")
    if options.task == "prior":
        check_prior_options(options)
    else:
        for name in ("profile", "views", "hold_out", "backbone_weights", "lpips", "data", "sharp"):
            if getattr(options, name) != getattr(Pretrain, name, None):
                raise InputError(f"--{name.replace('_', '-')}: works only with --task prior; leave it out.")


def check_prior_options(options: Pretrain) -> None:
    """Check what only a prior's training takes.

    Raises:
        InputError: weights that the network does not need or lacks, or of another one.
    """
    backbone, weights = PROFILES[options.profile].backbone, options.backbone_weights
    if backbone == "convolutional" and weights is not None:
        raise InputError(f"--backbone-weights: the {options.profile} profile trains its own encoder; leave them out.")
    if backbone != "convolutional" and weights is None:
        raise InputError(
            f"--profile {options.profile}: reads photos with {backbone}; give its model.safetensors by "
            "--backbone-weights."
        )
    if weights is not None:
        published_file(weights, backbone, allow_download=options.allow_download)
    start = options.initial_weights
    if start is not None and read_config(start) != PROFILES[options.profile]:
        raise InputError(f"--initial-weights {start}: of another network than --profile {options.profile}.")


def train(options: Pretrain, process: ProcessInfo, progress: Progress) -> int:
    """Train as one of the processes; the number of steps done.

    Raises:
        InputError: a folder that cannot be used, weights that do not fit, or a loss that is not finite.
    """
    hands = prior_hands(options, process.device) if options.task == "prior" else dense_photos(options, process.device)
    source, counts = mixed(options, hands, process.device)
    met = hands.people_met(process.rank, process.world, options.steps)
    most = max_people_cached(str(process.device))
    if len(met) > most:
        raise InputError(
            f"--people: expected at most {most} that one {process.device.type} device meets, got {len(met)}; "
            "each takes 23 MB there."
        )
    trainer = make_trainer(options, process)
    settings = settings_of(options, process.world) | counts
    if process.rank == 0:
        claim(options.out, settings)
        if process.device.type == "cpu":
            (options.out / PEOPLE).mkdir(exist_ok=True)
            remove_leftovers(options.out / PEOPLE)
    wait_for_all(process)
    hands.bake(met, options.out / PEOPLE, options.workers, progress)
    with stop_signals(can_force=process.world == 1) as should_stop:
        return pretrain(trainer, source, options.out, about=settings, should_stop=should_stop, progress=progress)


def prior_hands(options: Pretrain, device: torch.device) -> SyntheticHands:
    """The batches of a prior's training."""
    return SyntheticHands(
        seed=options.seed, people=options.people, hands=options.hands, views=options.views, size=options.size,
        device=device, population=replace(EVERYBODY, **dict.fromkeys(options.hold_out, 0.0)),
        workers=options.workers, ahead=AHEAD if device.type == "cuda" else 1,
    )  # fmt: skip


def mixed(
    options: Pretrain, hands: SyntheticHands | DensePhotos, device: torch.device
) -> tuple[BatchSource[Any], dict[str, Any]]:
    """The synthetic source, mixed with the data set where one is asked for, and what to note of that.

    Raises:
        InputError: no data set there, or no files of MANO.
    """
    if options.data is None or options.root is None or not isinstance(hands, SyntheticHands):
        return hands, {}
    hand = chosen_hand("mano", options.mano_dir)
    folder = Path(options.mano_dir or os.environ[MANO_DIR])
    chosen = PAPER if options.selection is None else read_selection(options.selection)
    catalogue = read_dataset(options.data, options.root, folder, selection=chosen)
    n_samples, left_out = len(catalogue.samples), catalogue.left_out
    print(f"oasis: {n_samples} samples of {options.data}, {len(left_out)} left out", file=sys.stderr)
    for reason in list(left_out.values())[:SHOWN_REASONS]:
        print(f"oasis: left out: {reason}", file=sys.stderr)
    real = DatasetHands(
        catalogue=catalogue, models={side: read_mano(folder, side) for side in ("right", "left")}, hand=hand,
        seed=options.seed, hands=options.hands, views=options.views, size=options.size, device=device,
        workers=options.workers,
    )  # fmt: skip
    names = hashlib.sha256("\n".join(sample.name for sample in catalogue.samples).encode()).hexdigest()
    about = {"data": options.data, "data_weight": options.data_weight, "samples": n_samples, "samples_sha256": names}
    return MixedHands(real=real, synthetic=hands, weight=options.data_weight), about


def dense_photos(options: Pretrain, device: torch.device) -> DensePhotos:
    """The batches of a dense network's training."""
    return DensePhotos(
        seed=options.seed, people=options.people, hands=options.hands, size=options.size, device=device,
        workers=options.workers,
    )  # fmt: skip


def make_trainer(options: Pretrain, process: ProcessInfo) -> Trainer:
    """The network in training.

    Raises:
        InputError: weights do not fit.
    """
    precision = PRECISIONS[options.precision]
    if options.task == "dense":
        config = PretrainConfig(steps=options.steps, precision=precision, **DENSE_SCHEDULE)
        return DenseTrainer(make_dense_network(options.seed, options.initial_weights), config, process)
    config = PretrainConfig(steps=options.steps, precision=precision)
    network = make_network(PROFILES[options.profile], options.seed, options.backbone_weights, options.initial_weights)
    losses: dict[str, Any] = {}
    if options.lpips is not None:
        perceptual = load_lpips(*options.lpips, allow_download=options.allow_download)
        losses["perceptual"] = perceptual.to(process.device)
    if options.sharp:
        return SharpPriorTrainer(network, config, process, seed=options.seed, **losses)
    return PriorTrainer(network, config, process, **losses)


def make_dense_network(seed: int, start: Path | None) -> DenseNetwork:
    """A new dense network, or the one in the file `start`.

    Raises:
        InputError: weights do not fit.
    """
    if start is not None:
        return load_dense_network(start)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return DenseNetwork()


def make_network(config: NetworkConfig, seed: int, backbone_weights: Path | None, start: Path | None) -> HandNetwork:
    """A new network, or the one in the file `start`.

    Raises:
        InputError: weights do not fit.
    """
    if start is not None:
        return load_network(start, bundled_hand(), backbone_weights=backbone_weights)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = HandNetwork(config, bundled_hand())
    if isinstance(network.encoder, DinoV2Encoder) and backbone_weights is not None:
        network.encoder.load(backbone_weights)
    return network


def settings_of(options: Pretrain, processes: int) -> dict[str, Any]:
    """All settings that the resulting weights depend on, unlike the device and the number of workers."""
    names = ("steps", "hands", "people", "size", "seed", "precision")
    settings = {name: getattr(options, name) for name in names} | {"processes": processes}
    if options.task == "dense":
        settings["task"] = "dense"
    else:
        settings |= {name: getattr(options, name) for name in ("profile", "views")}
        settings["hold_out"] = sorted(options.hold_out)
        if options.sharp:
            settings["sharp"] = True
    files = {"backbone": options.backbone_weights, "start": options.initial_weights}
    if options.lpips is not None:
        files |= dict(zip(("lpips_trunk", "lpips"), options.lpips, strict=True))
    for name, path in files.items():
        if path is not None:
            with path.open("rb") as file:
                settings[f"{name}_sha256"] = hashlib.file_digest(file, "sha256").hexdigest()
    return settings


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Create the folder, or check that it holds the same training.

    Raises:
        InputError: it holds another training, or cannot be created.
    """
    if (folder / CHECKPOINT).exists() and not (folder / SETTINGS).exists():
        raise InputError(f"{folder}: holds a checkpoint but no {SETTINGS} that says of what; choose another folder.")
    open_resumable_folder(folder, SETTINGS, settings, "a training")


@contextmanager
def stop_signals(*, can_force: bool) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C or SIGTERM came; if `can_force`, a second Ctrl-C stops at once."""
    asked = False

    def ask(number: int, frame: object) -> None:
        nonlocal asked
        if asked and can_force and number == signal.SIGINT:
            raise KeyboardInterrupt
        if not asked:  # print is not reentrant, and may have been interrupted
            os.write(2, b"\noasis: stopping after this step.\n")
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
