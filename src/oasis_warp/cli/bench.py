"""`oasis bench`: measure the operators on this machine."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from oasis_warp.bench import error_time, gpu_cases, roofline, scaling, speed, tables
from oasis_warp.bench.operators import OPERATORS
from oasis_warp.bench.rows import csv_text, json_text, write_rows
from oasis_warp.bench.scenes import HAND_GAUSSIANS
from oasis_warp.bench.tables import (
    budget_table,
    gpu_table,
    growth_table,
    roofline_table,
    scaling_table,
    setting_table,
    speed_table,
)
from oasis_warp.cli.developer_options import Bench, ErrorTime, Kernels, Roofline, Scaling
from oasis_warp.cli.progress import Terminal, print_tables, show_progress
from oasis_warp.cli.record import exact_command
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.processes import using_threads
from oasis_warp.data.output_files import output_file, output_folder

TABLE_WIDTH = 200
"""Columns that the widest table takes."""
REPEATS, GPU_GROUPS = 30, 11
SIZE, GAUSSIANS = 256, 20_000


def run(options: Bench) -> int:
    """Measure, print tables, write files.

    Raises:
        InputError: a wrong option or output.
    """
    chosen = options.what
    check_device(chosen.device, "--")
    match chosen:
        case ErrorTime():
            run_error_time(chosen)
        case Kernels(device="cuda"):
            run_gpu(chosen)
        case Kernels():
            run_kernels(chosen)
        case Scaling():
            run_scaling(chosen)
        case Roofline():
            run_roofline(chosen)
    return 0


def check_repeats(repeats: int | None) -> None:
    """Refuse fewer than two."""
    if repeats is not None and repeats < 2:
        raise InputError(f"--repeats: expected 2 or more, got {repeats}; quartiles need some.")


def check_threads(threads: int) -> None:
    """Refuse more threads than cores."""
    cores = os.cpu_count() or 1
    if not 1 <= threads <= cores:
        raise InputError(f"--threads: expected 1 to {cores}, the cores of this machine, got {threads}.")


def check_size(size: int, multiple: int = 1) -> None:
    """Refuse an image size that cannot be drawn."""
    if not 16 <= size <= 4096 or size % multiple:
        wanted = f"a multiple of {multiple} from 16 to 4096" if multiple > 1 else "16 to 4096"
        raise InputError(f"--size: expected {wanted} pixels, got {size}.")


def check_plot(plot: Path | None) -> None:
    """Refuse a plot that cannot be made, before anything is measured."""
    if plot is None:
        return
    if plot.suffix not in (".png", ".svg"):
        raise InputError(f"--plot {plot}: expected a name that ends in .png or .svg.")
    if not tables.can_plot():
        raise InputError(f"--plot: {tables.MISSING}")


def run_error_time(options: ErrorTime) -> None:
    """`oasis bench error-time`."""
    check_repeats(options.repeats)
    check_threads(options.threads)
    check_size(options.size, 4)
    notes = Terminal()
    with_plots = can_plot(notes)
    device = torch.device(options.device)
    with output_folder(options.out) as folder:
        with show_progress(notes) as progress, using_threads(options.threads):
            rows = error_time.measure_settings(
                error_time.Sweep(
                    plan=error_time.standard_plan(options.size, options.seed, options.quick),
                    device=device,
                    threads=options.threads,
                    max_threads=os.cpu_count() or 1,
                    repeats=options.repeats or (5 if options.quick else 20),
                ),
                progress,
            )
        write_rows(rows, folder / "error_time.csv", folder / "error_time.json", exact_command())
        if with_plots:
            for op in dict.fromkeys(row.op for row in rows):
                tables.plot_operator(rows, op, folder / f"{op}.png")
    print_tables([*(setting_table(group) for group in error_time.groups(rows)), budget_table(rows)], TABLE_WIDTH)


def run_kernels(options: Kernels) -> None:
    """`oasis bench kernels` on the CPU."""
    check_repeats(options.repeats)
    check_threads(options.threads)
    size, gaussians = options.size or SIZE, options.gaussians or GAUSSIANS
    check_size(size)
    if not 1 <= gaussians <= HAND_GAUSSIANS:
        raise InputError(f"--gaussians: expected 1 to {HAND_GAUSSIANS}, as many as the hand has, got {gaussians}.")
    if options.peer:
        raise InputError(f"--peer {options.peer}: it draws on CUDA devices only; add --device cuda.")
    operators = [operator for name, operator in OPERATORS.items() if options.only in name]
    if not operators:
        raise InputError(f"--only {options.only}: expected part of one of {', '.join(OPERATORS)}.")
    with results(options, tables.plot_speed) as write:
        with show_progress(Terminal()) as progress, using_threads(options.threads):
            repeats = options.repeats or REPEATS
            run_options = speed.RunOptions(device=torch.device("cpu"), threads=options.threads, repeats=repeats)
            rows = speed.measure_operators(operators, run_options, gaussians=gaussians, size=size, progress=progress)
        write(rows)
    print_tables([speed_table(rows)], TABLE_WIDTH)


def run_gpu(options: Kernels) -> None:
    """`oasis bench kernels --device cuda`."""
    check_repeats(options.repeats)
    for name, value in (("size", options.size), ("gaussians", options.gaussians)):
        if value is not None:
            raise InputError(f"--{name}: with --device cuda every case has its own; leave it out, or see --only.")
    cases = gpu_cases.choose(options.only)
    if not cases:
        names = ", ".join(dict.fromkeys(case.name for case in gpu_cases.CASES))
        raise InputError(f"--only {options.only}: expected part of one of {names}.")
    peers = {"gsplat": speed.gsplat_draw()} if options.peer else {}
    notes = Terminal()
    with results(options, tables.plot_speed) as write:
        with show_progress(notes) as progress, using_threads(options.threads):
            rows = speed.measure_cases(
                cases, torch.device("cuda"), groups=options.repeats or GPU_GROUPS, peers=peers, progress=progress
            )
        write(rows)
    print_tables([gpu_table(rows)], TABLE_WIDTH)
    for row in rows:
        if row.not_captured and row.way == gpu_cases.OURS:
            notes.print(f"oasis: {row.case}, {row.pass_}: no graph could hold it: {row.not_captured}", soft_wrap=True)


def run_scaling(options: Scaling) -> None:
    """`oasis bench scaling`."""
    check_threads(options.threads)
    seconds = options.seconds if options.seconds is not None else 1.0 if options.quick else 2.0
    if not seconds > 0:
        raise InputError(f"--seconds: expected more than 0, got {seconds:g}.")
    notes = Terminal()
    with_plot = can_plot(notes)
    with output_folder(options.out) as folder:
        with show_progress(notes) as progress, using_threads(options.threads):
            rows = scaling.measure_scaling(
                scaling.points(options.quick), torch.device(options.device), seconds=seconds, seed=options.seed,
                progress=progress,
            )  # fmt: skip
        write_rows(rows, folder / "scaling.csv", folder / "scaling.json", exact_command())
        if with_plot:
            tables.plot_scaling(rows, folder / "scaling.png")
    print_tables([scaling_table(rows), growth_table(rows)], TABLE_WIDTH)


def run_roofline(options: Roofline) -> None:
    """`oasis bench roofline`."""
    with results(options, tables.plot_roofline) as write:
        with show_progress(Terminal()) as progress:
            rows = roofline.measure_roofline(torch.device(options.device), options.seed, progress)
        if not rows:
            raise InputError("--device cuda: torch's profiler traces no kernels here; check the driver's permissions.")
        write(rows)
    print_tables([roofline_table(rows)], TABLE_WIDTH)


@contextmanager
def results(
    options: Kernels | Roofline, plot: Callable[[Sequence[Any], Path], None]
) -> Iterator[Callable[[Sequence[Any]], None]]:
    """The files that `options` name, opened first: what cannot be written is refused before minutes of work.

    Raises:
        InputError: one of them cannot be written.
    """
    check_plot(options.plot)
    with ExitStack() as files:
        parts = {
            path: files.enter_context(output_file(path))
            for path in (options.json, options.csv, options.plot)
            if path is not None
        }

        def write(rows: Sequence[Any]) -> None:
            if options.json is not None:
                parts[options.json].write_text(json_text(rows, exact_command()))
            if options.csv is not None:
                parts[options.csv].write_text(csv_text(rows))
            if options.plot is not None:
                plot(rows, parts[options.plot])

        yield write


def can_plot(notes: Console) -> bool:
    """Whether plots can be drawn; a note says if they cannot."""
    if not tables.can_plot():
        notes.print(f"oasis: {tables.MISSING}", highlight=False, soft_wrap=True, markup=False)
        return False
    return True
