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

from oasis_warp.avatar.observation import input_of_batch
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
    """Write the state after `step` steps, all or nothing, in full precision."""
    tensors: dict[str, Tensor] = {}
    for name, parameter in _trained(network).items():
        tensors[f"weights.{name}"] = parameter
        for moment in MOMENTS:
            # a switch may leave a part without gradients, and Adam without moments for it
            tensors[f"{moment}.{name}"] = optimizer.state[parameter].get(moment, torch.zeros_like(parameter))
    header = {"step": step, "config": asdict(network.config), "hand_model": network.hand_name}
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_file(path, save(stored, {FORMAT: json.dumps(header, sort_keys=True)}))


def load_checkpoint(path: Path, network: HandNetwork, optimizer: torch.optim.Adam) -> int:
    """Fill in what `save_checkpoint` wrote; the number of steps done.

    Raises:
        InputError: another format, or the training of another network.
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
"""What training leaves in its folder."""
SHEET_HANDS = 8
EAGER_STEPS = 4
"""Steps on CUDA before one is recorded: they load kernels, and show how many Gaussians pictures may show."""
SLACK = 3.0
"""Times the memory that a picture needed for its Gaussians: each hand and pose needs another."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """How the prior is trained."""

    steps: int = 20_000
    """Batches that each process sees."""
    learning_rate: float = 4e-4
    """Of Adam, at its highest; the paper's."""
    warmup: int = 200
    """Steps over which the learning rate rises from nothing."""
    decay: Literal["cosine", "none"] = "cosine"
    """Down to nothing at the last step, which short trainings need, or constant as in the paper."""
    precision: Literal["bfloat16", "float32"] = "bfloat16"
    """Of attention and perceptrons; geometry, Gaussians and weights are float32."""
    clip: float = 1.0
    """Largest norm of the gradient of all weights together; a longer one is shortened."""
    losses: LossConfig = field(default_factory=LossConfig)
    checkpoint_every: int = 500
    """Steps between two checkpoints."""
    log_every: int = 20
    """Steps between two lines of metrics."""


@runtime_checkable
class BatchSource(Protocol):
    """Training data. Batch k of a process depends on k, rank and world alone, so that training can go on anywhere."""

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        """Batches from step `first_step` on, on the device of the network."""
        ...


class StepResult(NamedTuple):
    """What one step found; numbers are still on the device."""

    loss: Tensor
    terms: dict[str, Tensor]
    psnr: Tensor
    drawn: RenderBatch
    true: RenderBatch


def never_stop() -> bool:
    """Nobody asks to stop."""
    return False


def learning_rate(config: PretrainConfig, step: int) -> float:
    """Of step `step`, counted from 0."""
    rise = min(1.0, (step + 1) / max(config.warmup, 1))
    fall = 0.5 + 0.5 * math.cos(math.pi * step / config.steps) if config.decay == "cosine" else 1.0
    return config.learning_rate * rise * fall


class Trainer:
    """A network in training, and its optimiser; `step` counts the steps done."""

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
        # a recorded step reads the learning rate where it lies on the device
        rate = torch.tensor(config.learning_rate, device=process.device) if on_cuda else config.learning_rate
        self.optimizer = torch.optim.Adam(self.trained, lr=rate, fused=on_cuda, capturable=on_cuda)
        self.step = 0
        self._recorded: CapturedCall[StepResult] | None = None
        self._eager_steps = 0

    def advance(self, batch: TrainingBatch) -> StepResult:
        """One step of Adam; no value is waited for.

        On CUDA the result's tensors are those of a recorded step: the next one writes over them.
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
        """Record anew where the last step had too little memory for its pictures; waits for the device."""
        if self._recorded is not None and self._recorded.lacked_memory():
            self._recorded, self._eager_steps = None, 0

    def evaluate(self, batch: TrainingBatch) -> StepResult:
        """Predict, draw every target and compare."""
        half = self.config.precision == "bfloat16"
        with torch.autocast(self.process.device.type, torch.bfloat16, enabled=half):
            prediction = self.network(input_of_batch(batch))
        drawn = draw_targets(prediction, batch, self.network)
        true = true_pictures(batch, self.network.faces, self.network.rim)
        loss, terms = objective(prediction, drawn, true, self.config.losses, self.perceptual)
        return StepResult(loss, terms, picture_psnr(drawn, true), drawn, true)

    def _update(self, batch: TrainingBatch) -> StepResult:
        result = self.evaluate(batch)
        gradients = torch.autograd.grad(result.loss, self.trained, allow_unused=True)
        for parameter, gradient in zip(self.trained, gradients, strict=True):
            if gradient is not None and gradient.stride() != parameter.stride():
                gradient = torch.empty_like(parameter).copy_(gradient)  # the fused optimiser wants the same strides
            parameter.grad = gradient
        average_gradients(self.trained, self.process.world)
        torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip)
        self.optimizer.step()
        return _without_history(result)


def _without_history(result: StepResult) -> StepResult:
    """The same numbers, that hold on to nothing they were computed from."""
    terms = {name: term.detach() for name, term in result.terms.items()}
    drawn, true = (RenderBatch(*(tensor.detach() for tensor in pictures)) for pictures in (result.drawn, result.true))
    return StepResult(result.loss.detach(), terms, result.psnr.detach(), drawn, true)


def pretrain(
    network: HandNetwork,
    source: BatchSource,
    config: PretrainConfig,
    folder: Path,
    process: ProcessInfo,
    *,
    perceptual: Perceptual = detail_difference,
    about: Mapping[str, object] = MappingProxyType({}),
    should_stop: Callable[[], bool] = never_stop,
    progress: Progress = silent,
) -> int:
    """Train until `config.steps`, going on from the checkpoint in `folder` where there is one; the steps done in all.

    Leaves there a checkpoint, the weights in half precision, a line of JSON every few steps and a sheet of pictures:
    photo, target, drawn. Process 0 writes. A training that was stopped and taken up again ends, on the CPU, with the
    bits of one that was not, as steps and batches count from the start and nothing else is random.

    Args:
        network: Changed in place.
        source: Of batches.
        config: How to train.
        folder: Where files go.
        process: This process.
        perceptual: Term of the objective.
        about: More to say in the notes of the weights file, beside `config`: what JSON can hold.
        should_stop: Asked after every step, by several processes when they write metrics: then this is the last step.
        progress: Told of the steps to do from here on.

    Raises:
        InputError: a checkpoint of another network, a folder that cannot be written, or a loss that is not finite.
    """
    trainer = Trainer(network, config, process, perceptual)
    if (folder / CHECKPOINT).is_file():
        trainer.step = load_checkpoint(folder / CHECKPOINT, network, trainer.optimizer)
    if process.rank == 0:
        _forget_after(folder / METRICS, trainer.step)
    began, first = time.perf_counter(), trainer.step
    batches = source(trainer.step, process.rank, process.world)
    notes = {**about, **asdict(config)}
    stopping = trainer.step >= config.steps
    progress("pretraining", 0, config.steps - first)
    while not stopping:
        batch = next(batches)
        result = trainer.advance(batch)
        progress("pretraining", trainer.step - first, config.steps - first)
        log_here = trainer.step % config.log_every == 0
        # several processes stop together or wait for each other for ever, and agreeing costs a wait for the device
        asked = (process.world == 1 or log_here) and any_process(should_stop(), process)
        stopping = asked or trainer.step == config.steps
        save_here = stopping or trainer.step % config.checkpoint_every == 0
        if log_here or save_here:
            names = ["loss", "psnr", *result.terms]
            values = torch.stack([result.loss, result.psnr, *result.terms.values()])
            numbers = dict(zip(names, mean_over_processes(values, process.world).tolist(), strict=True))
            trainer.check_recording()
            if not math.isfinite(numbers["loss"]):
                raise InputError(f"{folder}: the loss is not finite at step {trainer.step}; lower the learning rate.")
            if process.rank == 0:
                pace = (time.perf_counter() - began) / (trainer.step - first)
                line = {"step": trainer.step, "seconds_per_step": pace, **numbers}
                with (folder / METRICS).open("a") as file:
                    file.write(json.dumps(line) + "\n")
        if process.rank == 0 and save_here:
            save_checkpoint(folder / CHECKPOINT, network, trainer.optimizer, trainer.step)
            save_network(folder / WEIGHTS, network, notes=json.dumps({"step": trainer.step, **notes}))
            write_picture(folder / SHEET, to_uint8(_sheet(batch, result)))
    return trainer.step


def _forget_after(path: Path, step: int) -> None:
    """Drop the lines of steps that will be done again."""
    if path.is_file():
        lines = [line for line in path.read_text().splitlines() if json.loads(line)["step"] <= step]
        write_file(path, "".join(line + "\n" for line in lines).encode())


def _sheet(batch: TrainingBatch, result: StepResult) -> Tensor:
    """A row a hand: its photo, its first target, and what was drawn of it."""
    targets = batch.target_images.shape[1]
    size = batch.target_images.shape[2]
    photos = batch.image.permute(0, 3, 1, 2)
    photos = torch.nn.functional.interpolate(photos, size=(size, size), mode="bilinear").permute(0, 2, 3, 1)
    columns = [photos, result.true.images[::targets], result.drawn.images.detach()[::targets]]
    return torch.cat([column[:SHEET_HANDS].flatten(0, 1) for column in columns], dim=1)
