"""The weights file: safetensors with a JSON header that says what network they belong to; loading executes nothing.

Its metadata have one entry, "oasis-network": a JSON object with `version`, `config` (every field of `NetworkConfig`),
`hand_model`, `n_vertices`, `n_faces`, `creator` and `notes` (free text by the trainer). A frozen backbone's weights are
not in it: they lie in a file of their own.
"""

import json
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import save
from torch import Tensor
from torch.nn.modules.module import register_module_parameter_registration_hook

from oasis_warp import __version__
from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.hand_model import HandModel
from oasis_warp.data.output_files import write_file
from oasis_warp.data.tensor_file import open_tensors, read_entry, read_tensors, tensor_shapes
from oasis_warp.network.config import NetworkConfig
from oasis_warp.network.encoders import DinoV2Encoder
from oasis_warp.network.hand_network import HandNetwork

FORMAT = "oasis-network"
VERSION = 1
PRECISIONS = {"float16": torch.float16, "float32": torch.float32}
BACKBONE = 400_000_000
"""More weights than any DINOv2 that is known here has, which lie in a file of their own."""
SLACK = 1_000_000
"""Weights beyond twice those of the file up to which a network is made, to say which of its tensors do not fit."""
HEADER = {"version": int, "config": dict, "hand_model": str, "n_vertices": int, "n_faces": int}
"""Keys that a header has at least, and their types."""


def save_network(
    path: Path | str, network: HandNetwork, *, precision: Literal["float16", "float32"] = "float16", notes: str = ""
) -> None:
    """Write the trained weights of `network`, all or nothing.

    Raises:
        ValueError: a weight is not finite, or too large for `precision`.
        InputError: `path` cannot be written.
    """
    stored = {}
    for name, tensor in trained_state(network).items():
        stored[name] = tensor.to("cpu", PRECISIONS[precision]).contiguous()
        if not bool(stored[name].isfinite().all()):
            raise ValueError(f"network: expected weights that {precision} can hold, got others in {name}.")
    header = {
        "version": VERSION,
        "config": asdict(network.config),
        "hand_model": network.hand_name,
        "n_vertices": len(network.template_encoding),
        "n_faces": len(network.faces),
        "creator": f"oasis_warp {__version__}",
        "notes": notes,
    }
    write_file(path, save(stored, {FORMAT: json.dumps(header, allow_nan=False, sort_keys=True)}))


def load_network(path: Path | str, hand: HandModel, *, backbone_weights: Path | str | None = None) -> HandNetwork:
    """The network of a weights file, in float32 on the CPU, for inference.

    Args:
        path: What `save_network` wrote.
        hand: The hand model that it was trained for.
        backbone_weights: DINOv2's own file, where the network reads photos with it.

    Raises:
        InputError: missing, no weights file, of a newer version, cut short, for another hand model, with tensors that
            are missing, unknown or of another shape; or the backbone's file is missing.
    """
    path = Path(path)
    with _opened(path) as file:
        header = _checked_header(path, file)
        config = _config_of(path, header["config"])
        got = (header["hand_model"], header["n_vertices"], header["n_faces"])
        want = (hand.name, len(hand.template), len(hand.faces))
        if got != want:
            raise InputError(
                f"{path}: trained for the hand model {shortened(got[0])!r} ({got[1]} vertices, {got[2]} faces), but "
                f"the one in use is {want[0]!r} ({want[1]}, {want[2]}); give weights that fit."
            )
        held = sum(math.prod(shape) for _, shape in tensor_shapes(file).values())
        with _at_most(path, 2 * held + SLACK + (0 if config.backbone == "convolutional" else BACKBONE)), _known(path):
            network = HandNetwork(config, hand)
        network.load_state_dict(read_tensors(path, file, trained_state(network), "copy it again"), strict=False)
    if isinstance(network.encoder, DinoV2Encoder):
        if backbone_weights is None:
            raise InputError(f"{path}: reads photos with {config.backbone}; give the file of its weights too.")
        network.encoder.load(Path(backbone_weights))
    return network.eval()


def read_header(path: Path | str) -> dict[str, Any]:
    """What a weights file says of itself: `HEADER` and more, see above.

    Raises:
        InputError: missing, no weights file, of a newer version or cut short.
    """
    path = Path(path)
    with _opened(path) as file:
        return _checked_header(path, file)


def read_config(path: Path | str) -> NetworkConfig:
    """Sizes and switches of a weights file's network.

    Raises:
        InputError: as `read_header`, or of a network that is not known here.
    """
    return _config_of(Path(path), read_header(path)["config"])


def trained_state(network: HandNetwork) -> dict[str, Tensor]:
    """The tensors that training changes: all but a frozen backbone's."""
    frozen = isinstance(network.encoder, DinoV2Encoder)
    return {
        name: tensor.detach()
        for name, tensor in network.state_dict().items()
        if not (frozen and name.startswith("encoder."))
    }


def _opened(path: Path) -> AbstractContextManager[Any]:
    return open_tensors(path, "a network's weights", "`oasis pretrain` writes them")


def _checked_header(path: Path, file: Any) -> dict[str, Any]:
    header = read_entry(path, file, FORMAT, "copy it again")
    if header is None:
        raise InputError(f"{path}: a safetensors file, but not a network; give one that `oasis pretrain` wrote.")
    version = header.get("version")
    if type(version) is int and version > VERSION:
        raise InputError(
            f"{path}: a network of version {version}, newer than the known {VERSION}; update oasis-warp."
        )
    wrong = [key for key, kind in HEADER.items() if type(header.get(key)) is not kind]
    if wrong or version != VERSION:
        raise InputError(f"{path}: damaged, its header has no valid {(wrong or ['version'])[0]}; copy it again.")
    return header


def _config_of(path: Path, stored: dict[str, Any]) -> NetworkConfig:
    with _known(path):
        return NetworkConfig(**stored)


@contextmanager
def _known(path: Path) -> Iterator[None]:
    """Tell what no network can be; some sizes are refused only where it is made."""
    try:
        yield
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: its header describes no network known here ({error}); update oasis-warp.") from error


@contextmanager
def _at_most(path: Path, weights: int) -> Iterator[None]:
    """Let no network grow beyond so many weights, whatever its header says."""
    left = weights

    def count(module: torch.nn.Module, name: str, parameter: torch.nn.Parameter | None) -> None:
        nonlocal left
        left -= 0 if parameter is None else parameter.numel()
        if left < 0:
            raise InputError(f"{path}: holds fewer weights than the network that its header describes; copy it again.")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()
