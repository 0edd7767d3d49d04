"""The dense network's weights: safetensors in half precision, with a JSON header; loading executes nothing.

The metadata have one entry, "oasis-dense": a JSON object with `version`, `widths`, `depths`, `creator` and `notes`.
"""

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from safetensors.torch import save

from oasis_warp import __version__
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file
from oasis_warp.data.tensor_file import open_tensors, read_entry, read_tensors
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
        network = DenseNetwork()
        network.load_state_dict(read_tensors(path, file, network.state_dict(), "copy it again"))
    return network.eval()


def read_dense_header(path: Path | str) -> dict[str, Any]:
    """What a file of `save_dense_network` says of itself.

    Raises:
        InputError: as `load_dense_network`.
    """
    path = Path(path)
    with _opened(path) as file:
        return _checked_header(path, file)


def _opened(path: Path) -> AbstractContextManager[Any]:
    return open_tensors(path, "the dense network's weights", "give another path")


def _checked_header(path: Path, file: Any) -> dict[str, Any]:
    header = read_entry(path, file, FORMAT, "copy it again")
    expected = {"version": VERSION, "widths": list(WIDTHS), "depths": list(DEPTHS)}
    if header is None or not expected.items() <= header.items():
        raise InputError(
            f"{path}: expected the weights of a dense network of version {VERSION}, got another file; give one that "
            "`oasis pretrain --task dense` wrote."
        )
    return header
