"""Which tables of the documentation are older than the code that they are of.

Results that pages were filled from are kept in studies/results, and beside them, for each file, a digest of the code
that measured it. The digest covers every file that the study imports, directly or not, the C++ beside imported
kernels, and the assets where those are read; comments on lines of their own and docstrings do not count.
"""

import ast
import contextlib
import functools
import hashlib
import json
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from oasis_warp.bench.rows import commit
from oasis_warp.data.output_files import write_file

TOP = Path(__file__).parents[1]
RESULTS = TOP / "studies" / "results"
PACKAGES = {
    "studies": TOP / "studies", "tests": TOP / "tests", "oasis_warp": TOP / "src" / "oasis_warp",
    "oasis_kernels": TOP / "kernels" / "oasis_kernels", "asset_build": TOP / "asset_build",
}  # fmt: skip
ASSETS = PACKAGES["oasis_warp"] / "assets"


class MeasuredCode(NamedTuple):
    """What measured a file of results."""

    code: tuple[str, ...]
    """Digests; several where the code changed while a run was continued."""
    commit: str


NOT_NOTED = MeasuredCode(("unknown",), "")
"""What nobody noted the code of."""


def module_file(name: str) -> Path | None:
    """The file of a module of this repository."""
    package, *rest = name.split(".")
    if package not in PACKAGES:
        return None
    base = PACKAGES[package].joinpath(*rest)
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


@functools.cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text())


def files_of(module: str, name: str) -> list[Path]:
    """Where `from module import name` finds the name: its own file where a package only passes it on."""
    if found := module_file(f"{module}.{name}"):
        return [found]
    path = module_file(module)
    if path is None:
        return []
    for node in parsed(path).body if path.name == "__init__.py" else ():
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if name == (alias.asname or alias.name):
                    return files_of(node.module, alias.name)
    return [] if name.startswith("__") else [path]


@functools.cache
def imported(path: Path) -> tuple[Path, ...]:
    """Files of this repository that a file imports, at its top or in a function."""
    found: list[Path] = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found += [file for alias in node.names if (file := module_file(alias.name))]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [file for alias in node.names for file in files_of(node.module, alias.name)]
    return tuple(found)


def needed(start: Path) -> list[Path]:
    """All files that the numbers of a study depend on."""
    found, waiting = set(), [start]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += imported(path)
    kernels = {path.parent for path in found if PACKAGES["oasis_kernels"] in path.parents}
    found |= {path for folder in kernels for ending in ("cpp", "cu", "h", "inc") for path in folder.glob(f"*.{ending}")}
    if ASSETS / "__init__.py" in found:
        found |= {path for path in ASSETS.rglob("*") if path.is_file() and path.suffix not in (".pyc", ".png")}
    return sorted(found)


def counted_lines(path: Path) -> Iterator[str]:
    """Lines of a Python file without docstrings, blank lines and lines that are comments."""
    owners = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    skipped: set[int] = set()
    for node in ast.walk(parsed(path)):
        first = node.body[0] if isinstance(node, owners) and node.body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            skipped.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if number not in skipped and line.strip() and not line.lstrip().startswith("#"):
            yield line.rstrip()


@functools.cache
def file_digest(path: Path) -> str:
    """SHA-256 of what counts in a file."""
    content = "\n".join(counted_lines(path)).encode() if path.suffix == ".py" else path.read_bytes()
    return hashlib.sha256(content).hexdigest()


@functools.cache
def code_digest(study: str) -> str:
    """Digest of all files that a study depends on."""
    lines = (f"{path.relative_to(TOP)} {file_digest(path)}\n" for path in needed(TOP / "studies" / f"{study}.py"))
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:16]


def read_measured(folder: Path, study: str) -> dict[str, MeasuredCode]:
    """What measured each of a study's files of results in a folder."""
    path = folder / f"{study}.code.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    return {name: MeasuredCode(tuple(one["code"]), one["commit"]) for name, one in found.items()}


def write_measured(folder: Path, study: str, measured: dict[str, MeasuredCode]) -> None:
    """The inverse of `read_measured`."""
    text = json.dumps({name: one._asdict() for name, one in sorted(measured.items())}, indent=1) + "\n"
    write_file(folder / f"{study}.code.json", text.encode())


def times(folder: Path, files: Sequence[str]) -> dict[str, int]:
    """When each of the files that exist was written."""
    return {name: (folder / name).stat().st_mtime_ns for name in files if (folder / name).is_file()}


@contextlib.contextmanager
def noting_code(folder: Path, study: str, files: Sequence[str]) -> Iterator[None]:
    """Note which code has written, or continued, files of results while the context lasted."""
    before, digest = times(folder, files), code_digest(study)
    try:
        yield
    finally:
        measured = read_measured(folder, study)
        for name, time in times(folder, files).items():
            if before.get(name) != time:
                earlier = measured.get(name, NOT_NOTED).code
                measured[name] = MeasuredCode(tuple(sorted({digest, *(earlier if name in before else ())})), commit())
        if measured:
            write_measured(folder, study, measured)


def keep(study: str, files: Sequence[str], out: Path, results: Path) -> None:
    """Copy the files that a study has left in `out` to the kept results, and what measured them."""
    measured, noted = read_measured(results, study), read_measured(out, study)
    if not (measured_at := times(out, files)):
        return
    for name in measured_at:
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / name, results / name)
        measured[name] = noted.get(name, NOT_NOTED)
    write_measured(results, study, measured)


def age_note(measured: dict[str, MeasuredCode], digest: str, commits: str) -> str:
    """What stands below the tables of a study: nothing where this code has measured them."""
    if not measured:
        return "*Measured with an older version, whose results were not kept.*"
    if all(one.code == (digest,) for one in measured.values()):
        return ""
    return f"*Measured at {commits}; the code has changed since.*" if commits else "*Measured with older code.*"


def noted_page(page: str, marker: str, note: str) -> str:
    """A page with `note` as the last line of a section, instead of the note that stood there; an empty one is left."""
    name, last = re.escape(marker), f"\n{note}\n" if note else ""
    old = r"(?:\n\*Measured [^\n]*\*\n)?"
    parts = re.compile(rf"(<!-- {name}(?: \([^)]*\))? -->\n)(.*?){old}(<!-- end of {name} -->)", re.DOTALL)
    return parts.sub(lambda found: f"{found[1]}{found[2]}{last if found[2].strip() else ''}{found[3]}", page)
