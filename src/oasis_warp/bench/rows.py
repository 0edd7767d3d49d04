"""One measurement as a row of a table, and tables as CSV and JSON files with the same keys."""

import csv
import importlib.metadata
import io
import json
import math
import platform
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

import torch

from oasis_warp import __version__
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file

Kind = TypeVar("Kind")


@dataclass(frozen=True, kw_only=True)
class Row:
    """An operator on a scene with one knob turned. Empty in CSV and null in JSON is what does not apply."""

    scene: str
    width: int
    height: int
    gaussians: int
    """In the scene."""
    faces: int | None
    """Of its mesh, where it has one."""
    op: str
    pass_: str
    """Called `pass` in files: "forward" or "forward + backward"."""
    knob: str
    value: str
    """Of the knob; "default" under the knob "default", where none is turned."""
    device: str
    threads: int
    median_ms: float
    iqr_ms: float
    fastest_ms: float
    repeats: int
    first_ms: float
    """The first call, with compiling or loading kernels."""
    cpu_ms: float | None
    """CPU time of all threads in the call with the least; None on CUDA."""
    yardstick_ms: float
    """The yardstick's CPU time in the same rounds: times over it can be compared between runs."""
    peak_mb: float | None
    """Memory beyond what was in use before the call [MiB]."""
    rel_l2: float
    """Largest relative error of any output, fragile pixels left out."""
    max_abs: float
    """Largest error of any element of any output, fragile pixels included."""
    psnr_db: float | None
    """Of the image, fragile pixels included; None where it is equal, or there is none."""
    gradient_rel_l2: float | None
    """Largest relative error of any gradient, of a loss without the fragile pixels."""
    floor_rel_l2: float
    """How far the exact results are known: what torch in float64, with the Gaussians or faces listed in another order,
    differs from them by in the first output. Smaller errors than this say nothing."""
    fragile_percent: float | None
    """Share of the pixels where a decision hangs on rounding."""
    bit_equal: bool
    """Whether results and gradients have the bits of those with the default setting."""
    seed: int
    commit: str
    versions: str

    @property
    def error(self) -> float:
        """The larger of the errors of values and gradients, as far as the pass has them."""
        return max(self.rel_l2, self.gradient_rel_l2 or 0.0)

    @property
    def cost_ms(self) -> float:
        """What settings are compared by: CPU time where one thread does the work, else the fastest call.

        Other work on the machine delays a call, but hardly adds to its CPU time.
        """
        return self.fastest_ms if self.cpu_ms is None or self.threads > 1 else self.cpu_ms

    @property
    def is_default(self) -> bool:
        """Whether no knob is turned."""
        return self.knob == "default"


KEYS = tuple(field.name.rstrip("_") for field in fields(Row))


def to_record(row: Any) -> dict[str, Any]:
    """A row's values by the keys of the files; numbers that are not finite become None."""

    def clean(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {name.rstrip("_"): clean(value) for name, value in asdict(row).items()}


def csv_text(rows: Sequence[Any]) -> str:
    """Rows, one or more of one kind, as CSV with a heading."""
    out = io.StringIO()
    writer = csv.DictWriter(out, [field.name.rstrip("_") for field in fields(rows[0])], lineterminator="\n")
    writer.writeheader()
    words = {True: "yes", False: "no"}
    for row in rows:
        record = to_record(row)
        writer.writerow({key: words[v] if isinstance(v, bool) else v for key, v in record.items()})
    return out.getvalue()


def json_text(rows: Sequence[Any]) -> str:
    """Rows as a JSON array of objects."""
    return json.dumps([to_record(row) for row in rows], indent=1, allow_nan=False) + "\n"


def write_rows(rows: Sequence[Any], csv_path: Path, json_path: Path) -> None:
    """Write both files, each whole or not at all.

    Raises:
        InputError: one cannot be written.
    """
    write_file(csv_path, csv_text(rows).encode())
    write_file(json_path, json_text(rows).encode())


def from_record(kind: type[Kind], record: dict[str, Any]) -> Kind:
    """The row that `to_record` made `record` from; a number that was not finite comes back as infinity."""
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


def read_csv(path: Path) -> list[Row]:
    """The rows of a file of `write_rows`.

    Raises:
        InputError: no such file, or other columns.
    """
    try:
        with path.open(newline="") as stream:
            records = list(csv.DictReader(stream))
    except OSError as error:
        raise InputError(f"{path}: expected the CSV of `oasis bench error-time`, got {error.strerror}.") from error
    if not records or tuple(records[0]) != KEYS:
        raise InputError(f"{path}: expected the CSV of `oasis bench error-time`, found other columns.")
    return [Row(**{f.name: _parse(record[f.name.rstrip("_")], f.type) for f in fields(Row)}) for record in records]


def _parse(text: str, kind: Any) -> Any:
    kinds = get_args(kind) or (kind,)
    if text == "" and type(None) in kinds:
        return None
    if kinds[0] is bool:
        return text == "yes"
    return kinds[0](text) if text else math.inf  # a number that was not finite


def device_name(device: torch.device) -> str:
    """The device as its maker calls it."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions() -> str:
    """Of what the numbers depend on."""
    return (
        f"oasis_warp {__version__}, warp {importlib.metadata.version('warp-lang')}, torch {torch.__version__}, "
        f"python {platform.python_version()}, {platform.system()} {platform.machine()}"
    )


def commit() -> str:
    """The commit of the checkout that this package is imported from, "+" behind it for changes; "" where there is none.

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
