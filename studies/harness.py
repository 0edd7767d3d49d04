"""What all studies share: their options, and cases that are measured side by side and kept as they come.

A study is a module of this package. The first line of its docstring describes it in `python -m studies list`. It has

- `Options`, a dataclass derived from `StudyOptions`: its fields are the flags of the command;
- `run(options)`, which measures and returns rows, dictionaries that JSON can hold;
- `SECTIONS`, what it fills in the pages of docs (see `tables`);
- where its rows do not come from `run`, `load(out)`, which reads them from the files that another command has left, and
  `FILES`, the names of these files;
- where it draws pictures from rows, `draw(rows, static)`, which writes them below docs/_static.

Results stand in the folder OUT/NAME. A study that is interrupted goes on where it stopped when it is run again.
`python -m studies render` copies them to studies/results and fills the pages from there; `age` says how old they are.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch

from oasis_warp.bench.rows import commit
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.processes import using_threads
from oasis_warp.data.output_files import open_resumable_folder, write_file

Row = dict[str, Any]
"""One line of results. Rows of `measured` also hold their "case" and the "commit" that they were measured at; a case
that raised an `InputError` has one row with its message under "refused"."""
ROWS, SETTINGS = "rows.jsonl", "settings.json"


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Options of every study."""

    selecting: ClassVar[frozenset[str]] = frozenset()
    """Fields that only select cases: results with others of them belong together."""

    out: Path = Path("out")
    """Folder for results."""
    workers: int = 0
    """Processes that measure cases side by side; 0 for none. Times mean little with several."""
    threads: int | None = None
    """Threads of each process; by default all cores together."""
    device: Literal["cpu", "cuda"] = "cpu"

    def settings(self) -> dict[str, Any]:
        """Options that results depend on, as JSON has them."""
        skipped = {"out", "workers", "threads", *self.selecting}
        found = {name: value for name, value in asdict(self).items() if name not in skipped}
        return json.loads(json.dumps(found, default=str))


@dataclass(frozen=True, kw_only=True)
class AvatarOptions(StudyOptions):
    """Options of studies that make avatars."""

    prior: str = "learned"
    """learned, none or a weights file."""
    steps: int | None = None
    """Steps of texture learning, those of `AdaptConfig` if None."""

    def config(self, **changes: Any) -> ReconstructConfig:
        """Options of `reconstruct`."""
        return ReconstructConfig(
            **{"prior": prior_choice(self.prior), "steps": self.steps, "device": self.device, **changes}
        )


def prior_choice(name: str) -> Any:
    """`name` as `choose_prior` takes it: a word, or the path of a weights file."""
    return name if name in ("learned", "none") else Path(name)


def report(stage: str, done: int, total: int) -> None:
    """Print progress, at most some ten lines of it."""
    if total and (done == total or done % max(1, total // 10) == 0):
        print(f"{stage}: {done} of {total}", file=sys.stderr, flush=True)


def measured(
    name: str, cases: Mapping[str, tuple], measure: Callable[..., Sequence[Row] | Row], options: StudyOptions
) -> list[Row]:
    """Measure the cases that have no rows yet, keep each as it comes, and return the rows of all.

    Args:
        name: Name of the study, and of the folder that rows are kept in.
        cases: Arguments of `measure` by the name of the case.
        measure: Returns the rows of one case; a function of a module, so that other processes find it.
        options: Options of the study.

    Raises:
        InputError: the folder cannot be used, or holds rows made with other settings.
    """
    folder = options.out / name
    options.out.mkdir(parents=True, exist_ok=True)
    open_resumable_folder(folder, SETTINGS, options.settings(), "results")
    done = {row["case"] for row in read_rows(folder / ROWS)}
    missing = {case: arguments for case, arguments in cases.items() if case not in done}
    with (folder / ROWS).open("a") as file:
        for case, rows, seconds in _each(missing, measure, options):
            made = {"case": case, "commit": commit()}
            file.writelines(json.dumps({**made, **row}) + "\n" for row in rows)
            file.flush()
            refused = f": {rows[0]['refused']}" if rows and "refused" in rows[0] else ""
            done.add(case)
            print(f"{name}: {case}, {seconds:.1f} s{refused}", file=sys.stderr, flush=True)
    return [row for row in read_rows(folder / ROWS) if row["case"] in cases]


def _each(
    cases: Mapping[str, tuple], measure: Callable[..., Sequence[Row] | Row], options: StudyOptions
) -> Iterable[tuple[str, Sequence[Row], float]]:
    threads = options.threads or max(1, (os.cpu_count() or 1) // max(1, options.workers))
    if not options.workers:
        with using_threads(threads):
            for case, arguments in cases.items():
                yield case, *_timed(measure, arguments)
        return
    with ProcessPoolExecutor(
        options.workers, get_context("spawn"), initializer=torch.set_num_threads, initargs=(threads,)
    ) as pool:
        waiting = {pool.submit(_timed, measure, arguments): case for case, arguments in cases.items()}
        for future in as_completed(waiting):
            yield waiting[future], *future.result()


def _timed(measure: Callable[..., Sequence[Row] | Row], arguments: tuple) -> tuple[Sequence[Row], float]:
    start = time.perf_counter()
    try:
        rows = measure(*arguments)
    except InputError as error:
        rows = {"refused": str(error)}
    return [rows] if isinstance(rows, dict) else list(rows), time.perf_counter() - start


def read_rows(path: Path) -> list[Row]:
    """Rows of a JSON-lines file; none where there is no file. A last line that was cut off is dropped."""
    lines = path.read_text().splitlines() if path.is_file() else []
    rows = []
    for number, line in enumerate(lines):
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            if number + 1 < len(lines):
                raise
            path.write_text("".join(f"{whole}\n" for whole in lines[:-1]))
    return rows


def write_rows(folder: Path, rows: Iterable[Row]) -> list[Row]:
    """Write and return all rows of a study that makes them in one go."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [{"commit": commit(), **row} for row in rows]
    write_file(folder / ROWS, "".join(json.dumps(row) + "\n" for row in made).encode())
    return made
