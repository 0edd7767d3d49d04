"""The training loop of every network: stopped, resumed, in one process or several, with files that report.

A checkpoint holds weights, Adam's moments and a JSON header in one safetensors file; loading executes nothing.
"""

import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from safetensors.torch import save
from torch import Tensor, nn

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.data.json_text import whole
from oasis_warp.data.output_files import write_file
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.data.tensor_file import open_tensors, read_entry, read_tensors
from oasis_warp.ops.cuda_graph import CapturedCall
from oasis_warp.pretraining.distributed import (
    ProcessInfo,
    any_process,
    average_gradients,
    mean_over_processes,
    share_weights,
)

Network = TypeVar("Network", bound=nn.Module)
Batch = TypeVar("Batch", bound=tuple[Tensor, ...])
Yielded = TypeVar("Yielded", bound=tuple[Tensor, ...], covariant=True)

CHECKPOINT, WEIGHTS, METRICS, SHEET = "checkpoint.safetensors", "network.safetensors", "metrics.jsonl", "pictures.png"
"""Files in the folder of a training."""
SHEET_ROWS = 8
EAGER_STEPS = 4
"""Steps on CUDA before one is captured: they load the kernels, and show how much memory the pictures need."""
SLACK = 3.0
"""Factor of the memory that pictures needed for their Gaussians, since each hand and pose needs another amount."""
MAX_SKIPPED = 0.5
"""Share of the steps since the last line of metrics that a gradient that is not finite may leave without effect."""
COOLDOWN = 0.2
"""Share of the steps over which a cooldown lowers the learning rate."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """How a network is trained; the defaults are the prior's."""

    steps: int = 20_000
    """Batches per process."""
    learning_rate: float = 4e-4
    """Highest learning rate of Adam; the paper's."""
    warmup: int = 200
    """Steps over which the learning rate rises from 0."""
    decay: Literal["cosine", "cooldown", "none"] = "cosine"
    """Decay to 0 at the last step, over all steps or linearly over the last `COOLDOWN`, or constant as in the paper."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    """Precision of attention and perceptrons; geometry, Gaussians and weights are float32."""
    clip: float = 1.0
    """Norm to which the gradient of all weights is clipped."""
    checkpoint_every: int = 500
    """Steps between two checkpoints."""
    log_every: int = 20
    """Steps between two lines of metrics."""


@runtime_checkable
class BatchSource(Protocol[Yielded]):
    """Training data. Batch k of a process depends on k, rank and world only, so that training can resume anywhere."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[Yielded]:
        """Batches from step `first_step` on, on the device of the network."""
        ...


class StepResult(NamedTuple):
    """Results of one step; numbers are still on the device."""

    loss: Tensor
    metrics: dict[str, Tensor]
    """Further numbers to report."""
    pictures: tuple[Tensor, ...]
    """What `Trainer.sheet` needs."""


def learning_rate(config: PretrainConfig, step: int) -> float:
    """Learning rate of step `step`, counted from 0."""
    rise = min(1.0, (step + 1) / max(config.warmup, 1))
    match config.decay:
        case "cosine":
            fall = 0.5 + 0.5 * math.cos(math.pi * step / config.steps)
        case "cooldown":
            fall = min(1.0, (config.steps - step) / (COOLDOWN * config.steps))
        case "none":
            fall = 1.0
    return config.learning_rate * rise * fall


class Trainer(ABC, Generic[Network, Batch]):
    """A network in training and its optimizer; `step` counts the steps done. A subclass is one task with its loss."""

    def __init__(self, network: Network, config: PretrainConfig, process: ProcessInfo):
        self.network = network.to(process.device).train()
        self.config, self.process = config, process
        self.trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
        share_weights(self.trained, process.world)
        on_cuda = process.device.type == "cuda"
        # A captured step reads the learning rate from device memory.
        rate = torch.tensor(config.learning_rate, device=process.device) if on_cuda else config.learning_rate
        self.optimizer = torch.optim.Adam(self.trained, lr=rate, fused=on_cuda, capturable=on_cuda)
        self.step = 0
        self.skipped = torch.zeros((), device=process.device)
        """Steps so far whose gradient was not finite; they left the weights as they were."""
        self._recorded: CapturedCall[StepResult] | None = None
        self._eager_steps = 0

    @abstractmethod
    def evaluate(self, batch: Batch) -> StepResult:
        """Predict and compute the loss, without waiting for the device."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """What a checkpoint must agree with, as JSON values."""

    @abstractmethod
    def save_weights(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Write the weights file; `notes` are JSON values that say how the weights came about."""

    @abstractmethod
    def sheet(self, batch: Batch, result: StepResult) -> list[Tensor]:
        """Columns of the sheet of pictures: each a stack of square pictures of one size, one for each item."""

    def autocast(self) -> torch.autocast:
        """The context in which a network predicts in the precision of the config."""
        half = self.config.precision == "bfloat16"
        return torch.autocast(self.process.device.type, torch.bfloat16, enabled=half)

    def advance(self, batch: Batch) -> StepResult:
        """Take one step of Adam, without waiting for the device.

        On CUDA the result's tensors belong to a captured step, which overwrites them the next time.
        """
        for group in self.optimizer.param_groups:
            rate = learning_rate(self.config, self.step)
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
        if self._recorded is None and self.process.device.type == "cuda" and self._eager_steps >= EAGER_STEPS:
            self._recorded = CapturedCall(self._update, batch, SLACK)
        if self._recorded is None:
            self._eager_steps += 1
            result = self._update(batch)
        else:
            result = self._recorded(batch)
        self.step += 1
        return result

    def check_recording(self) -> None:
        """Capture anew if the last step had too little memory for its pictures; waits for the device."""
        if self._recorded is not None and self._recorded.lacked_memory():
            self._recorded, self._eager_steps = None, 0

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        save_checkpoint(path, self.network, self.optimizer, self.step, self.identity())

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one.

        Raises:
            InputError: it is damaged or of another network.
        """
        if path.is_file():
            self.step = load_checkpoint(path, self.network, self.optimizer, self.identity())

    def _update(self, batch: Batch) -> StepResult:
        result = self.evaluate(batch)
        gradients = torch.autograd.grad(result.loss, self.trained, allow_unused=True)
        for parameter, gradient in zip(self.trained, gradients, strict=True):
            if gradient is not None and gradient.stride() != parameter.stride():
                gradient = torch.empty_like(parameter).copy_(gradient)  # the fused optimizer needs the same strides
            parameter.grad = gradient
        average_gradients(self.trained, self.process.world)
        broken = (~torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip).isfinite()).float()
        self.skipped += broken
        if self.process.device.type == "cuda":
            # As torch.amp.GradScaler does: where this is 1, fused Adam changes nothing and nobody waits for the device.
            self.optimizer.found_inf = broken
            self.optimizer.step()
        elif not broken:
            self.optimizer.step()
        metrics = {name: value.detach() for name, value in result.metrics.items()} | {"skipped": self.skipped.clone()}
        return StepResult(result.loss.detach(), metrics, tuple(picture.detach() for picture in result.pictures))


@single_threaded_math()
def pretrain(
    trainer: Trainer[Network, Batch],
    source: BatchSource[Batch],
    folder: Path,
    *,
    about: Mapping[str, object] = MappingProxyType({}),
    should_stop: Callable[[], bool] = lambda: False,
    progress: Progress = silent,
) -> int:
    """Train until `trainer.config.steps`, from the checkpoint in `folder` if there is one; the number of steps done.

    Writes a checkpoint, the weights, a line of JSON every few steps, and a sheet of pictures. Only process 0 writes. On
    the CPU, a training that was stopped and resumed ends with the same bits as one that was not, because steps and
    batches count from the start and nothing else is random; torch has one thread, since its sums depend on how many.

    Args:
        trainer: The network in training; changed in place.
        source: Source of batches.
        folder: Where files go.
        about: Further notes for the weights file, beside the config, as JSON values.
        should_stop: Called after every step, with several processes only when metrics are written; True ends training.
        progress: Called for every step from here on.

    Raises:
        InputError: a checkpoint of another network, a folder that cannot be written, or a loss that is not finite in
            most steps; a step whose gradient is not finite changes nothing and is counted in the metrics.
    """
    config, process = trainer.config, trainer.process
    trainer.resume(folder / CHECKPOINT)
    if process.rank == 0:
        _drop_lines_after(folder / METRICS, trainer.step)
    start, first, reported, skipped = time.perf_counter(), trainer.step, trainer.step, 0.0
    batches = source(trainer.step, process.rank, process.world)
    stopping = trainer.step >= config.steps
    notes = {**about, **asdict(config)}
    if stopping and process.rank == 0:  # it may have been stopped between the checkpoint and the weights
        trainer.save_weights(folder / WEIGHTS, {"step": trainer.step, **notes})
    progress("pretraining", 0, config.steps - first)
    while not stopping:
        batch = next(batches)
        result = trainer.advance(batch)
        progress("pretraining", trainer.step - first, config.steps - first)
        log_now = trainer.step % config.log_every == 0
        # All processes must stop at the same step, and to agree on it they wait for the device.
        stop_now = (process.world == 1 or log_now) and any_process(should_stop(), process)
        stopping = stop_now or trainer.step == config.steps
        save_now = stopping or trainer.step % config.checkpoint_every == 0
        if log_now or save_now:
            numbers = _mean_metrics(result, process.world)
            trainer.check_recording()
            if numbers["skipped"] - skipped > MAX_SKIPPED * (trainer.step - reported):
                raise InputError(f"{folder}: the loss is not finite at step {trainer.step}; lower the learning rate.")
            reported, skipped = trainer.step, numbers["skipped"]
            if process.rank == 0:
                seconds = (time.perf_counter() - start) / (trainer.step - first)
                _append_line(folder / METRICS, {"step": trainer.step, "seconds_per_step": seconds, **numbers})
        if process.rank == 0 and save_now:
            trainer.save(folder / CHECKPOINT)
            trainer.save_weights(folder / WEIGHTS, {"step": trainer.step, **notes})
            _write_sheet(folder / SHEET, trainer.sheet(batch, result))
    return trainer.step


def _append_line(path: Path, numbers: Mapping[str, int | float]) -> None:
    """Append a line of JSON to `path`, with null for what is not finite."""
    finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    with path.open("a") as file:
        file.write(json.dumps(finite) + "\n")


def _write_sheet(path: Path, columns: Sequence[Tensor]) -> None:
    """Columns of pictures side by side, the first `SHEET_ROWS` of each."""
    write_picture(path, to_uint8(torch.cat([column[:SHEET_ROWS].flatten(0, 1) for column in columns], dim=1)))


def _mean_metrics(result: StepResult, world: int) -> dict[str, float]:
    """Loss and metrics of a step, averaged over the processes."""
    values = {"loss": result.loss, **result.metrics}
    return dict(zip(values, mean_over_processes(torch.stack([*values.values()]), world).tolist(), strict=True))


def _drop_lines_after(path: Path, step: int) -> None:
    """Drop the lines of steps that will be repeated, and those that were cut when training was killed."""
    if path.is_file():
        kept = [line for line in path.read_bytes().split(b"\n") if _step_of(line) <= step]
        write_file(path, b"".join(line + b"\n" for line in kept))


def _step_of(line: bytes) -> int | float:
    """The step of a line of metrics; infinite where it cannot be read."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return math.inf
    return step if type(step) is int else math.inf


FORMAT = "oasis-pretraining"
MOMENTS = ("exp_avg", "exp_avg_sq")
MAX_STEPS = 1 << 24
"""Most steps of a training; float32 counts no further, and Adam counts in it."""


def save_checkpoint(
    path: Path, network: nn.Module, optimizer: torch.optim.Adam, step: int, identity: Mapping[str, Any]
) -> None:
    """Write the state after `step` steps, all or nothing; `identity` says which network it is."""
    tensors: dict[str, Tensor] = {}
    for name, parameter in _trained(network).items():
        tensors[f"weights.{name}"] = parameter
        for moment in MOMENTS:
            # A switch may leave a part without gradients, for which Adam has no moments.
            tensors[f"{moment}.{name}"] = optimizer.state[parameter].get(moment, torch.zeros_like(parameter))
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_file(path, save(stored, {FORMAT: json.dumps({"step": step, **identity}, sort_keys=True)}))


def load_checkpoint(path: Path, network: nn.Module, optimizer: torch.optim.Adam, identity: Mapping[str, Any]) -> int:
    """Load a file of `save_checkpoint` into network and optimizer; the number of steps done.

    Raises:
        InputError: another format, a damaged file, or a checkpoint of another network.
    """
    with open_tensors(path, "a checkpoint", "choose another folder", "remove it") as file:
        header = read_entry(path, file, FORMAT, "remove it")
        if header is None:
            raise InputError(f"{path}: expected a checkpoint, got another safetensors file; remove it.")
        step = header.get("step")
        if not whole(step, 0, MAX_STEPS):
            raise InputError(f"{path}: damaged, its step is {shortened(repr(step))}; remove it.")
        if header != json.loads(json.dumps({"step": step, **identity})):
            raise InputError(
                f"{path}: the checkpoint of a network with other sizes or switches; choose another folder."
            )
        trained, parts = _trained(network), ("weights", *MOMENTS)
        expected = {f"{part}.{name}": parameter for name, parameter in trained.items() for part in parts}
        tensors = read_tensors(path, file, expected, "remove it")
    state = {}
    for k, (name, parameter) in enumerate(trained.items()):
        parameter.data.copy_(tensors[f"weights.{name}"])
        moments = {moment: tensors[f"{moment}.{name}"] for moment in MOMENTS}
        state[k] = {"step": torch.tensor(float(step)), **moments}
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return step


def _trained(network: nn.Module) -> dict[str, nn.Parameter]:
    return {name: parameter for name, parameter in network.named_parameters() if parameter.requires_grad}
