"""The workers of `oasis batch`: processes of Dask, on this machine or on others, and the photos they are given."""

import contextlib
import logging
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from oasis_warp.cli.batch_work import MAX_TRIES, Order, make_avatars
from oasis_warp.cli.console import check_device
from oasis_warp.cli.loopback import LOOPBACK
from oasis_warp.core.errors import InputError
from oasis_warp.ops import warm_up

PATIENCE = 60
"""Seconds for a scheduler to answer, and for the first worker to come."""
EVERY = 1.0
"""Seconds between two words of a worker on how far it is."""
TOPIC = "oasis batch"


@contextlib.contextmanager
def open_cluster(workers: int | None, scheduler: str | None, device: str) -> Iterator[tuple[Any, int]]:
    """A client of Dask and the number of its workers: new ones on this machine, or those of a scheduler.

    Raises:
        InputError: both or nonsense is asked for, Dask is missing, no scheduler answers, or it is lost.
    """
    if workers is not None and scheduler is not None:
        raise InputError("--workers: belongs to this machine, --scheduler to a cluster; give one of the two.")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more; leave it out for all cores.")
    try:
        import cryptography  # noqa: F401 - keys of `_local` are made with it
        import distributed
    except ImportError as error:
        raise InputError("oasis batch: needs Dask distributed; install it: pip install 'oasis-warp[batch]'.") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is raised
    if scheduler is None:
        check_device(device)
        warm_up(device)  # kernels are compiled once, and not by all workers at the same time
        n = workers or len(os.sched_getaffinity(0))
        with _local(distributed, n) as client:
            yield client, n
        return
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: none answers there ({error}); start one with `dask scheduler`."
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

    class IgnoreInterrupts(distributed.WorkerPlugin):
        """Ctrl-C goes to all processes of a terminal: the one that started the workers ends them."""

        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    keys = distributed.Security.temporary()
    with (
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
        client: Of Dask.
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
            "oasis batch: the scheduler is lost; start it and its workers again, and the same command goes on."
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
