"""Rows of measurements as CSV and JSON files with the same keys, and what the numbers depend on."""

import csv
import importlib.metadata
import io
import json
import math
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

import torch

from oasis_warp import __version__
from oasis_warp.bench.scenes import GaussianScene, MeshScene
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file

Kind = TypeVar("Kind")


def to_record(row: Any) -> dict[str, Any]:
    """The values of a row by the keys of the files: `pass_` becomes `pass`, and numbers that are not finite None."""

    def clean(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {name.rstrip("_"): clean(value) for name, value in asdict(row).items()}


def keys(row: Any) -> tuple[str, ...]:
    """The keys of a row, or kind of row, in files."""
    return tuple(field.name.rstrip("_") for field in fields(row))


def csv_text(rows: Sequence[Any]) -> str:
    """Rows, one or more of one kind, as CSV with a heading."""
    out = io.StringIO()
    writer = csv.DictWriter(out, keys(rows[0]), lineterminator="\n")
    writer.writeheader()
    words = {True: "yes", False: "no"}
    for row in rows:
        record = to_record(row)
        writer.writerow({key: words[v] if isinstance(v, bool) else v for key, v in record.items()})
    return out.getvalue()


def json_text(rows: Sequence[Any], command: str | None = None) -> str:
    """Rows as a JSON array of objects, each with the `command` that measured it if there is one."""
    about = {} if command is None else {"command": command}
    return json.dumps([to_record(row) | about for row in rows], indent=1, allow_nan=False) + "\n"


def write_rows(rows: Sequence[Any], csv_path: Path, json_path: Path, command: str | None = None) -> None:
    """Write both files, each whole or not at all; the JSON with the `command` that measured, if there is one.

    Raises:
        InputError: one cannot be written.
    """
    write_file(csv_path, csv_text(rows).encode())
    write_file(json_path, json_text(rows, command).encode())


def from_record(kind: type[Kind], record: dict[str, Any]) -> Kind:
    """The inverse of `to_record`; a number that was not finite becomes infinity."""
    values = {}
    for field in fields(kind):
        value, kinds = record[field.name.rstrip("_")], get_args(field.type) or (field.type,)
        values[field.name] = math.inf if value is None and type(None) not in kinds else value
    return kind(**values)


def read_json(kind: type[Kind], path: Path) -> list[Kind]:
    """The rows of a file of `write_rows` or `json_text`.

    Raises:
        InputError: no such file, or rows of another kind.
    """
    try:
        return [from_record(kind, record) for record in json.loads(path.read_text())]
    except OSError as error:
        raise InputError(f"{path}: expected a JSON file of `oasis bench`, got {error.strerror}.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected the rows of a {kind.__name__}, found something else.") from error


def device_name(device: torch.device) -> str:
    """The name of the GPU or of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions() -> str:
    """Versions of the software that the numbers depend on."""
    return (
        f"oasis_warp {__version__}, warp {importlib.metadata.version('warp-lang')}, torch {torch.__version__}, "
        f"python {platform.python_version()}, {platform.system()} {platform.machine()}"
    )


def commit() -> str:
    """The commit of the checkout that this package is imported from, with "+" for changes; "" without a checkout.

    A package installed inside another project's checkout does not count as part of it.
    """
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *arguments], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        if not git("ls-files", Path(__file__).name):
            return ""
        return git("rev-parse", "--short=10", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def provenance(device: torch.device) -> dict[str, str]:
    """The columns of a row that say where it comes from."""
    return {"device": device_name(device), "commit": commit(), "versions": versions()}


def scene_columns(scene: GaussianScene | MeshScene) -> dict[str, Any]:
    """The columns of a row that describe its scene."""
    drawn = isinstance(scene, GaussianScene)
    return {
        "scene": scene.name,
        "width": scene.width,
        "height": scene.height,
        "gaussians": len(scene.means if drawn else scene.quats),
        "faces": None if drawn else len(scene.faces),
        "seed": scene.seed,
    }
