"""Checkpoints: weights, Adam's moments and a JSON header in one safetensors file; loading executes nothing."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor, nn

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.data.json_text import whole
from oasis_warp.data.output_files import write_file
from oasis_warp.data.tensor_file import open_tensors, read_entry, read_tensors

FORMAT = "oasis-pretraining"
MOMENTS = ("exp_avg", "exp_avg_sq")
MOST_STEPS = 1 << 24
"""Of a training; float32 counts no further, and Adam counts in it."""


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
        if not whole(step, 0, MOST_STEPS):
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
