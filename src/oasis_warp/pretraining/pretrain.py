"""Train the prior network on many hands: paper, section 4.1 and appendix B.2."""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from oasis_warp.avatar.observation import source_photos
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import TrainingBatch
from oasis_warp.data.output_files import write_file
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.losses.image import detail_difference
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import save_network
from oasis_warp.ops.cuda_graph import CapturedCall
from oasis_warp.pretraining.distributed import (
    ProcessInfo,
    any_process,
    average_gradients,
    mean_over_processes,
    share_weights,
)
from oasis_warp.pretraining.objective import (
    LossConfig,
    Perceptual,
    RenderBatch,
    draw_targets,
    objective,
    picture_psnr,
    true_pictures,
)

FORMAT = "oasis-pretraining"
MOMENTS = ("exp_avg", "exp_avg_sq")


def save_checkpoint(path: Path, network: HandNetwork, optimizer: torch.optim.Adam, step: int) -> None:
    """Write weights, Adam's moments and a JSON header after `step` steps as one safetensors file, atomically."""
    tensors: dict[str, Tensor] = {}
    for name, parameter in _trained(network).items():
        tensors[f"weights.{name}"] = parameter
        for moment in MOMENTS:
            # A switch may leave a part without gradients, for which Adam has no moments.
            tensors[f"{moment}.{name}"] = optimizer.state[parameter].get(moment, torch.zeros_like(parameter))
    header = {"step": step, "config": asdict(network.config), "hand_model": network.hand_name}
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_file(path, save(stored, {FORMAT: json.dumps(header, sort_keys=True)}))


def load_checkpoint(path: Path, network: HandNetwork, optimizer: torch.optim.Adam) -> int:
    """Load a file of `save_checkpoint` into network and optimizer; the number of steps done.

    Raises:
        InputError: another format, or a checkpoint of another network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = _read_header(path, file.metadata(), network)
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise InputError(f"{path}: expected a checkpoint, got a file cut short ({error}); remove it.") from error
    state = {}
    for k, (name, parameter) in enumerate(_trained(network).items()):
        parameter.data.copy_(tensors[f"weights.{name}"])
        moments = {moment: tensors[f"{moment}.{name}"] for moment in MOMENTS}
        state[k] = {"step": torch.tensor(float(header["step"])), **moments}
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return header["step"]


def _trained(network: HandNetwork) -> dict[str, torch.nn.Parameter]:
    return {name: parameter for name, parameter in network.named_parameters() if parameter.requires_grad}


def _read_header(path: Path, metadata: dict[str, str] | None, network: HandNetwork) -> dict[str, Any]:
    text = (metadata or {}).get(FORMAT)
    if text is None:
        raise InputError(f"{path}: expected a checkpoint, got another safetensors file; remove it.")
    header = json.loads(text)
    if header["config"] != asdict(network.config) or header["hand_model"] != network.hand_name:
        raise InputError(f"{path}: the checkpoint of a network with other sizes or switches; choose another folder.")
    return header


CHECKPOINT, WEIGHTS, METRICS, SHEET = "checkpoint.safetensors", "network.safetensors", "metrics.jsonl", "pictures.png"
"""Files in the folder of a training."""
SHEET_HANDS = 8
EAGER_STEPS = 4
"""Steps on CUDA before one is captured: they load the kernels, and show how much memory the pictures need."""
SLACK = 3.0
"""Factor of the memory that pictures needed for their Gaussians, since each hand and pose needs another amount."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """How the prior is trained."""

    steps: int = 20_000
    """Batches per process."""
    learning_rate: float = 4e-4
    """Highest learning rate of Adam; the paper's."""
    warmup: int = 200
    """Steps over which the learning rate rises from 0."""
    decay: Literal["cosine", "none"] = "cosine"
    """Decay to 0 at the last step, which short trainings need, or constant as in the paper."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    """Of attention and perceptrons; geometry, Gaussians and weights are float32."""
    clip: float = 1.0
    """Norm to which the gradient of all weights is clipped."""
    losses: LossConfig = field(default_factory=LossConfig)
    checkpoint_every: int = 500
    """Steps between two checkpoints."""
    log_every: int = 20
    """Steps between two lines of metrics."""


@runtime_checkable
class BatchSource(Protocol):
    """Training data. Batch k of a process depends on k, rank and world only, so that training can resume anywhere."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        """Batches from step `first_step` on, on the device of the network."""
        ...


class StepResult(NamedTuple):
    """Results of one step; numbers are still on the device."""

    loss: Tensor
    terms: dict[str, Tensor]
    psnr: Tensor
    drawn: RenderBatch
    true: RenderBatch


def learning_rate(config: PretrainConfig, step: int) -> float:
    """Learning rate of step `step`, counted from 0."""
    rise = min(1.0, (step + 1) / max(config.warmup, 1))
    fall = 0.5 + 0.5 * math.cos(math.pi * step / config.steps) if config.decay == "cosine" else 1.0
    return config.learning_rate * rise * fall


class Trainer:
    """A network in training and its optimizer; `step` counts the steps done."""

    def __init__(
        self,
        network: HandNetwork,
        config: PretrainConfig,
        process: ProcessInfo,
        perceptual: Perceptual = detail_difference,
    ):
        self.network = network.to(process.device).train()
        self.config, self.process, self.perceptual = config, process, perceptual
        self.trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
        share_weights(self.trained, process.world)
        on_cuda = process.device.type == "cuda"
        # A captured step reads the learning rate from device memory.
        rate = torch.tensor(config.learning_rate, device=process.device) if on_cuda else config.learning_rate
        self.optimizer = torch.optim.Adam(self.trained, lr=rate, fused=on_cuda, capturable=on_cuda)
        self.step = 0
        self._recorded: CapturedCall[StepResult] | None = None
        self._eager_steps = 0

    def advance(self, batch: TrainingBatch) -> StepResult:
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

    def evaluate(self, batch: TrainingBatch) -> StepResult:
        """Predict, render every target and compute the loss."""
        half = self.config.precision == "bfloat16"
        with torch.autocast(self.process.device.type, torch.bfloat16, enabled=half):
            prediction = self.network(source_photos(batch))
        drawn = draw_targets(prediction, batch, self.network)
        true = true_pictures(batch, self.network.faces, self.network.rim)
        loss, terms = objective(prediction, drawn, true, self.config.losses, self.perceptual)
        return StepResult(loss, terms, picture_psnr(drawn, true), drawn, true)

    def _update(self, batch: TrainingBatch) -> StepResult:
        result = self.evaluate(batch)
        gradients = torch.autograd.grad(result.loss, self.trained, allow_unused=True)
        for parameter, gradient in zip(self.trained, gradients, strict=True):
            if gradient is not None and gradient.stride() != parameter.stride():
                gradient = torch.empty_like(parameter).copy_(gradient)  # the fused optimizer needs the same strides
            parameter.grad = gradient
        average_gradients(self.trained, self.process.world)
        torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip)
        self.optimizer.step()
        return _without_history(result)


def _without_history(result: StepResult) -> StepResult:
    """The result, detached from the graph."""
    terms = {name: term.detach() for name, term in result.terms.items()}
    drawn, true = (RenderBatch(*(tensor.detach() for tensor in pictures)) for pictures in (result.drawn, result.true))
    return StepResult(result.loss.detach(), terms, result.psnr.detach(), drawn, true)


def pretrain(
    trainer: Trainer,
    source: BatchSource,
    folder: Path,
    *,
    about: Mapping[str, object] = MappingProxyType({}),
    should_stop: Callable[[], bool] = lambda: False,
    progress: Progress = silent,
) -> int:
    """Train until `trainer.config.steps`, from the checkpoint in `folder` if there is one; the number of steps done.

    Writes a checkpoint, the weights in half precision, a line of JSON every few steps, and a sheet of pictures: photo,
    target, rendered. Only process 0 writes. On the CPU, a training that was stopped and resumed ends with the same bits
    as one that was not, because steps and batches count from the start and nothing else is random.

    Args:
        trainer: The network in training; changed in place.
        source: Source of batches.
        folder: Where files go.
        about: Further notes for the weights file, beside the config, as JSON values.
        should_stop: Called after every step, with several processes only when metrics are written; True ends training.
        progress: Called for every step from here on.

    Raises:
        InputError: a checkpoint of another network, a folder that cannot be written, or a loss that is not finite.
    """
    config, process = trainer.config, trainer.process
    if (folder / CHECKPOINT).is_file():
        trainer.step = load_checkpoint(folder / CHECKPOINT, trainer.network, trainer.optimizer)
    if process.rank == 0:
        _drop_lines_after(folder / METRICS, trainer.step)
    start, first = time.perf_counter(), trainer.step
    batches = source(trainer.step, process.rank, process.world)
    stopping = trainer.step >= config.steps
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
            if not math.isfinite(numbers["loss"]):
                raise InputError(f"{folder}: the loss is not finite at step {trainer.step}; lower the learning rate.")
            if process.rank == 0:
                seconds = (time.perf_counter() - start) / (trainer.step - first)
                with (folder / METRICS).open("a") as file:
                    file.write(json.dumps({"step": trainer.step, "seconds_per_step": seconds, **numbers}) + "\n")
        if process.rank == 0 and save_now:
            save_checkpoint(folder / CHECKPOINT, trainer.network, trainer.optimizer, trainer.step)
            notes = {"step": trainer.step, **about, **asdict(config)}
            save_network(folder / WEIGHTS, trainer.network, notes=json.dumps(notes))
            write_picture(folder / SHEET, to_uint8(_sheet(batch, result)))
    return trainer.step


def _mean_metrics(result: StepResult, world: int) -> dict[str, float]:
    """Loss, PSNR and terms of a step, averaged over the processes."""
    names = ["loss", "psnr", *result.terms]
    values = torch.stack([result.loss, result.psnr, *result.terms.values()])
    return dict(zip(names, mean_over_processes(values, world).tolist(), strict=True))


def _drop_lines_after(path: Path, step: int) -> None:
    """Drop the lines of steps that will be repeated."""
    if path.is_file():
        lines = [line for line in path.read_text().splitlines() if json.loads(line)["step"] <= step]
        write_file(path, "".join(line + "\n" for line in lines).encode())


def _sheet(batch: TrainingBatch, result: StepResult) -> Tensor:
    """One row per hand: its photo, its first target and the rendering."""
    targets = batch.target_images.shape[1]
    size = batch.target_images.shape[2]
    photos = batch.image.permute(0, 3, 1, 2)
    photos = torch.nn.functional.interpolate(photos, size=(size, size), mode="bilinear").permute(0, 2, 3, 1)
    columns = [photos, result.true.images[::targets], result.drawn.images.detach()[::targets]]
    return torch.cat([column[:SHEET_HANDS].flatten(0, 1) for column in columns], dim=1)
