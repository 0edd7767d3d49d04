"""`oasis batch`: thousands of photos, on the cores of this machine or on a cluster of Dask, and the workers there."""

import contextlib
import json
import logging
import os
import re
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from oasis_warp.cli.batch_work import AVATARS, MAX_TRIES, ROWS, TRIES, Order, make_avatars, read_rows
from oasis_warp.cli.jobs import SUFFIXES
from oasis_warp.cli.loopback import LOOPBACK
from oasis_warp.cli.options import Batch
from oasis_warp.cli.progress import BAD_INPUT, INTERRUPTED, ManyPhotos, Terminal, plain_console, show_run
from oasis_warp.cli.record import exact_command
from oasis_warp.core.config import ReconstructConfig, check_config
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress
from oasis_warp.data.output_files import make_folders, output_file, remove_leftovers, write_file
from oasis_warp.ops import warm_up

PATIENCE = 60
"""Seconds for a scheduler to answer, and for the first worker to come."""
EVERY = 1.0
"""Seconds between two words of a worker on how far it is."""
TOPIC = "oasis batch"
MAX_PHOTOS, TASKS_A_WORKER = 256, 16
"""Photos of a task at most, and tasks of a worker at least: in the end workers wait for each other for half a task, so
a 32nd of the time, and a scheduler of Dask has 4,000 tasks for a million photos."""
MAX_REASONS = 8
"""Sentences in the table at the end."""
MALLOC = {"MALLOC_TRIM_THRESHOLD_": 64 << 20, "MALLOC_MMAP_THRESHOLD_": 32 << 20}
"""Bytes that glibc keeps, and from which it asks the system: those that it finds itself. Dask sets 64 KiB, with which
two fifths of a photo's time are page faults."""


@contextlib.contextmanager
def open_cluster(workers: int | None, scheduler: str | None, device: str) -> Iterator[tuple[Any, int]]:
    """A client of Dask and the number of its workers: new ones on this machine, or those of a scheduler.

    Raises:
        InputError: both or nonsense is asked for, Dask is missing, no scheduler answers, or it is lost.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other; give only one of them.")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more; leave it out for all cores.")
    try:
        import cryptography  # noqa: F401 - keys of `_local` are made with it
        import distributed
    except ImportError as error:
        raise InputError("oasis batch: needs Dask distributed; install it: pip install 'oasis-warp[batch]'.") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is raised
    if scheduler is None:
        check_device(device, "--")
        warm_up(device)  # kernels are compiled once, and not by all workers at the same time
        n = workers or len(os.sched_getaffinity(0))
        with _local(distributed, n) as client:
            yield client, n
        return
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: no scheduler answers there ({error}); start one with `dask scheduler`."
        ) from error
    with client:
        try:
            client.wait_for_workers(1, PATIENCE)
        except TimeoutError as error:
            raise InputError(
                f"--scheduler {scheduler}: has no worker; start some with `dask worker {scheduler} --nthreads 1`."
            ) from error
        yield client, len(client.nthreads())


@contextlib.contextmanager
def _local(distributed: Any, n: int) -> Iterator[Any]:
    """Workers on this machine that only it reaches, with keys, so that its other users cannot give them work."""
    import dask

    class IgnoreInterrupts(distributed.WorkerPlugin):
        """Ctrl-C goes to all processes of a terminal: the one that started the workers ends them."""

        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    keys = distributed.Security.temporary()
    with (
        dask.config.set({f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in MALLOC.items()}),
        distributed.LocalCluster(
            n_workers=n, threads_per_worker=1, host=LOOPBACK, protocol="tls", security=keys, memory_limit=0,
            silence_logs=logging.CRITICAL, scheduler_kwargs={"dashboard": False, "dashboard_address": f"{LOOPBACK}:0"},
        ) as cluster,
        distributed.Client(cluster, security=keys, set_as_default=False) as client,
    ):  # fmt: skip
        client.register_plugin(IgnoreInterrupts(), name="ignore-interrupts")
        yield client


def work(client: Any, tasks: Sequence[Sequence[str]], order: Order, report: Callable[[int, int], object]) -> int:
    """Run all tasks; the number of photos that were processed now, not found done.

    Args:
        client: Client of Dask.
        tasks: Names of photos.
        order: What to make of them.
        report: Called with the numbers of photos so far that were worked on, and that were found done.

    Raises:
        InputError: the scheduler is lost, or a worker can make no avatars.
    """
    from distributed import CancelledError, KilledWorker, as_completed

    counts: dict[int, Counter[str]] = {}
    ended, lock = set[int](), threading.Lock()  # events come on a thread of the client

    def count(task: int, counted: Mapping[str, int], *, end: bool) -> int:
        with lock:
            if task in ended:
                return 0
            if end:
                ended.add(task)
            counts[task] = Counter(counted)
            total = sum(counts.values(), Counter[str]())
            report(total.total() - total["kept"], total["kept"])
        return total.total() - total["kept"]

    client.subscribe_topic(TOPIC, lambda event: count(event[1]["task"], event[1]["counts"], end=False))
    futures = {client.submit(_task, k, names, order, pure=False): k for k, names in enumerate(tasks)}
    worked, killed, done = 0, Counter[int](), as_completed(futures, loop=client.loop)
    try:
        for future in done:
            try:
                worked = count(futures[future], future.result(), end=True)
            except KilledWorker:  # by its photos, whose tries are counted, or from outside
                killed[futures[future]] += 1
                if killed[futures[future]] > MAX_TRIES * len(tasks[futures[future]]):
                    raise
                future.retry()
                done.add(future)
    except (CancelledError, OSError) as error:
        raise InputError(
            "oasis batch: the scheduler is lost; restart it and its workers, and the same command continues."
        ) from error
    return worked


def _task(number: int, names: Sequence[str], order: Order) -> dict[str, int]:
    """`make_avatars` on a worker of Dask."""
    from distributed import get_worker

    worker = get_worker()
    if worker.state.nthreads != 1:
        raise InputError(f"{worker.address}: has {worker.state.nthreads} threads; start it with --nthreads 1.")
    last = 0.0

    def tell(counts: Mapping[str, int]) -> None:
        nonlocal last
        if time.monotonic() - last > EVERY:
            last = time.monotonic()
            worker.log_event(TOPIC, {"task": number, "counts": dict(counts)})

    return make_avatars(names, order, tell)


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
        run = ManyPhotos(len(names), config, n_workers, pictures=options.pictures)
        try:
            with show_run(Terminal(), run) as shown:
                worked = work(client, tasks, order, lambda made, kept: _count(run, shown.progress, made, kept))
        except KeyboardInterrupt:
            print(f"oasis: stopped; {run.what} are done, the same command continues.", file=sys.stderr)
            return INTERRUPTED
        seconds = time.monotonic() - start
    summary = finish(order, tasks)
    summary["this_run"] = {"photos": worked, "workers": n_workers, "seconds": round(seconds, 1)}
    summary["command"] = exact_command()
    write_file(order.out / "summary.json", (json.dumps(summary, indent=1) + "\n").encode())
    plain_console().print(_table(summary))
    print(f"written: {options.out}{os.sep}; manifest.jsonl there lists the folder of each photo.")
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
