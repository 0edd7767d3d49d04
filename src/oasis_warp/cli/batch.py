"""`oasis batch`: thousands of photos, on the cores of this machine or on a cluster of Dask."""

import contextlib
import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from oasis_warp.cli.batch_cluster import open_cluster, work
from oasis_warp.cli.batch_work import AVATARS, ROWS, TRIES, Order, read_rows
from oasis_warp.cli.console import BAD_INPUT, INTERRUPTED, plain_console, show_run
from oasis_warp.cli.jobs import SUFFIXES
from oasis_warp.cli.options import Batch
from oasis_warp.cli.progress import ManyPhotos
from oasis_warp.cli.record import exact_command
from oasis_warp.core.config import ReconstructConfig, check_config
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress
from oasis_warp.data.output_files import make_folders, output_file, remove_leftovers, write_file

MAX_PHOTOS, TASKS_A_WORKER = 256, 16
"""Photos of a task at most, and tasks of a worker at least: in the end workers wait for each other for half a task, so
a 32nd of the time, and a scheduler of Dask has 4,000 tasks for a million photos."""
MAX_REASONS = 8
"""Sentences in the table at the end."""


def run(options: Batch) -> int:
    """Make avatars of all photos that have none yet, then the manifest; the exit code.

    Raises:
        InputError: an option is wrong, Dask is missing or its scheduler is, or nothing can be written.
    """
    config = ReconstructConfig(**{field.name: getattr(options, field.name) for field in fields(ReconstructConfig)})
    check_config(config, "--")
    names = find_photos(options.source, options.out)
    source = options.source if options.source.is_dir() else options.source.parent
    order = Order(
        source=source.absolute(), out=options.out.absolute(), config=_absolute(config), pictures=options.pictures
    )
    order.settings  # noqa: B018 - a wrong prior is refused before any work
    make_folders(options.out, order.out)
    with open_cluster(options.workers, options.scheduler, config.device) as (client, n_workers):
        tasks, start = split_tasks(names, n_workers), time.monotonic()
        run = ManyPhotos(len(names), config, n_workers)
        try:
            with show_run(Console(stderr=True), run) as shown:
                worked = work(client, tasks, order, lambda made, kept: _count(run, shown.progress, made, kept))
        except KeyboardInterrupt:
            print(f"oasis: stopped; {run.what} are done, the same command goes on.", file=sys.stderr)
            return INTERRUPTED
        seconds = time.monotonic() - start
    summary = finish(order, tasks)
    summary["this_run"] = {"photos": worked, "workers": n_workers, "seconds": round(seconds, 1)}
    summary["command"] = exact_command()
    write_file(order.out / "summary.json", (json.dumps(summary, indent=1) + "\n").encode())
    plain_console().print(_table(summary))
    print(f"written: {options.out}{os.sep}; manifest.jsonl there says which photo is where.")
    return BAD_INPUT if summary["photos"]["failed"] else 0


def _absolute(config: ReconstructConfig) -> ReconstructConfig:
    """With paths that other processes understand."""
    paths = {name: getattr(config, name) for name in ("prior", "backbone_weights", "mano_dir")}
    return replace(config, **{name: path.absolute() for name, path in paths.items() if isinstance(path, Path)})


def _count(run: ManyPhotos, progress: Progress, made: int, kept: int) -> None:
    run.count(made, kept)
    progress("photos", *run.done)


def find_photos(source: Path, out: Path) -> list[str]:
    """Names of the photos of a folder, relative to it, or of a list, in a fixed order.

    Raises:
        InputError: there is no such folder or list, or no photo in it.
    """
    if source.is_dir():
        names, own = [], out.absolute()
        for folder, inner, files in os.walk(source):
            inner[:] = sorted(name for name in inner if name[0] != "." and Path(folder, name).absolute() != own)
            photos = sorted(name for name in files if name[0] != "." and name.lower().endswith(SUFFIXES))
            names += [os.path.relpath(os.path.join(folder, name), source) for name in photos]
        if not names:
            raise InputError(f"{source}: expected photos, {', '.join(SUFFIXES)}, found none; name another folder.")
        return names
    if source.suffix.lower() != ".txt" or not source.is_file():
        raise InputError(
            f"{source}: expected a folder or a .txt file with a name on each line; `oasis reconstruct` takes photos."
        )
    try:
        names = list(dict.fromkeys(line.strip() for line in source.read_text("utf-8").splitlines() if line.strip()))
    except (OSError, ValueError) as error:
        raise InputError(f"{source}: expected text with a name on each line ({error}); save it as UTF-8.") from error
    if not names:
        raise InputError(f"{source}: expected the names of photos, found an empty file; write one on each line.")
    return names


def split_tasks(names: Sequence[str], n_workers: int) -> list[list[str]]:
    """The photos of each task, so many that all workers have some until the end."""
    n = min(MAX_PHOTOS, max(1, len(names) // (n_workers * TASKS_A_WORKER)))
    return [list(names[k : k + n]) for k in range(0, len(names), n)]


def finish(order: Order, tasks: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Write the manifest, a line for each photo, and remove what killed processes left; what came out, in numbers."""
    photos, reasons = Counter[str](dict.fromkeys(("made", "refused", "failed"), 0)), Counter[str]()
    keys, seconds = set[str](), 0.0
    with output_file(order.out / "manifest.jsonl") as part, part.open("w") as manifest:
        for names in tasks:
            for row in read_rows(order.rows_file(names)):
                manifest.write(json.dumps(row) + "\n")
                photos[row["status"]] += 1
                if "said" in row:  # without the photo's name and its numbers
                    reasons[re.sub(r"\d+(\.\d+)?", "N", row["said"].split(": ", 1)[-1])] += 1
                if row.get("key", "") not in keys:
                    seconds += row.get("seconds", 0.0)
                    keys.add(row.get("key", ""))
    for folder in [order.out / ROWS, *(order.out / AVATARS).glob("??")]:
        remove_leftovers(folder)
    with contextlib.suppress(OSError):
        (order.out / TRIES).rmdir()
    return {
        "photos": dict(photos), "avatars": len(keys - {""}), "seconds": round(seconds, 1),
        "reasons": dict(reasons.most_common(MAX_REASONS)), "settings": order.settings,
    }  # fmt: skip


def _table(summary: dict[str, Any]) -> Table:
    photos, this_run = summary["photos"], summary["this_run"]
    pace = 3600 * this_run["photos"] / max(this_run["seconds"], 1e-3)
    of_now = f"{this_run['photos']} in this run, {this_run['seconds']:.0f} s, {pace:.0f} an hour"
    table = Table(title=f"{sum(photos.values())} photos, {of_now}", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for status, count in photos.items():
        table.add_row(status, str(count), end_section=status == "failed")
    for reason, count in summary["reasons"].items():
        table.add_row(reason, str(count))
    return table
