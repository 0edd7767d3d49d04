"""The dense network's weights: safetensors in half precision, with a JSON header; loading executes nothing.

The metadata have one entry, "oasis-dense": a JSON object with `version`, `widths`, `depths`, `creator` and `notes`.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from oasis_warp import __version__
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file
from oasis_warp.network.dense_network import DEPTHS, WIDTHS, DenseNetwork

FORMAT = "oasis-dense"
VERSION = 1


def save_dense_network(path: Path | str, network: DenseNetwork, *, notes: str = "") -> None:
    """Write the weights, all or nothing.

    Raises:
        ValueError: half precision cannot hold a weight.
        InputError: `path` cannot be written.
    """
    stored = {name: tensor.detach().cpu().half().contiguous() for name, tensor in network.state_dict().items()}
    broken = [name for name, tensor in stored.items() if not bool(tensor.isfinite().all())]
    if broken:
        raise ValueError(f"network: expected weights that float16 can hold, got others in {broken[0]}.")
    header = {
        "version": VERSION, "widths": WIDTHS, "depths": DEPTHS, "creator": f"oasis_warp {__version__}", "notes": notes,
    }  # fmt: skip
    write_file(path, save(stored, {FORMAT: json.dumps(header, sort_keys=True)}))


def load_dense_network(path: Path | str) -> DenseNetwork:
    """The network of a file that `save_dense_network` wrote, in float32 on the CPU, for inference.

    Raises:
        InputError: no such file, another format, another version or other sizes, or weights that are damaged.
    """
    path = Path(path)
    with _opened(path) as file:
        _checked_header(path, file)
        tensors = {name: file.get_tensor(name).float() for name in file.keys()}
    network = DenseNetwork()
    if {name: t.shape for name, t in network.state_dict().items()} != {name: t.shape for name, t in tensors.items()}:
        raise InputError(f"{path}: its weights are not those of a dense network; copy it again.")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise InputError(f"{path}: expected finite weights of a dense network, got others; copy it again.")
    network.load_state_dict(tensors)
    return network.eval()


def read_dense_header(path: Path | str) -> dict[str, Any]:
    """What a file of `save_dense_network` says of itself.

    Raises:
        InputError: as `load_dense_network`.
    """
    path = Path(path)
    with _opened(path) as file:
        return _checked_header(path, file)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    if not path.is_file():
        raise InputError(f"{path}: expected the dense network's weights, found no such file; give another path.")
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except SafetensorError as error:
        raise InputError(
            f"{path}: expected the dense network's weights, got another format or a file cut short ({error}); "
            "copy it again."
        ) from error


def _checked_header(path: Path, file: Any) -> dict[str, Any]:
    try:
        header = json.loads((file.metadata() or {}).get(FORMAT, "null"))
    except json.JSONDecodeError:
        header = None
    sizes = [header.get(name) for name in ("version", "widths", "depths")] if isinstance(header, dict) else None
    if sizes != [VERSION, list(WIDTHS), list(DEPTHS)]:
        raise InputError(
            f"{path}: expected the weights of a dense network of version {VERSION}, got another file; give one that "
            "`oasis pretrain --task dense` wrote."
        )
    return header
