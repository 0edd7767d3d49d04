"""The dense network's weights: safetensors in half precision, with a JSON header; loading executes nothing.

The metadata have one entry, "oasis-dense": a JSON object with `version`, `widths`, `depths`, `creator` and `notes`.
"""

import json
from pathlib import Path

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
    if not path.is_file():
        raise InputError(f"{path}: expected the dense network's weights, found no such file; give another path.")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(FORMAT, "null"))
            sizes = [header.get(name) for name in ("version", "widths", "depths")] if isinstance(header, dict) else None
            if sizes != [VERSION, list(WIDTHS), list(DEPTHS)]:
                raise InputError(
                    f"{path}: expected the weights of a dense network of version {VERSION}, got another file; give one "
                    "that `oasis pretrain --task dense` wrote."
                )
            network = DenseNetwork()
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}
    except (SafetensorError, json.JSONDecodeError) as error:
        raise InputError(
            f"{path}: expected the dense network's weights, got another format or a file cut short ({error}); "
            "copy it again."
        ) from error
    shapes = {name: tensor.shape for name, tensor in network.state_dict().items()}
    if shapes != {name: tensor.shape for name, tensor in tensors.items()}:
        raise InputError(f"{path}: its weights are not those of a dense network; copy it again.")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values()):
        raise InputError(f"{path}: expected finite weights, got others; copy it again.")
    network.load_state_dict(tensors)
    return network.eval()
