"""Where training stands, in one safetensors file: weights, Adam's moments, and a JSON header. No pickle."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.atomic import write_file
from oasis_warp.network.hand_network import HandNetwork

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
