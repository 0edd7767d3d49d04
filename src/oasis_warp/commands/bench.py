"""`oasis bench`: measure the operators on this machine."""

import os
from contextlib import nullcontext

import torch
from rich.console import Console

from oasis_warp.bench import error_time, pareto, speed
from oasis_warp.bench.rows import json_text, write_rows
from oasis_warp.bench.scenes import HAND_GAUSSIANS
from oasis_warp.bench.summary import groups
from oasis_warp.bench.tables import budget_table, setting_table, speed_table
from oasis_warp.bench.timing import using_threads
from oasis_warp.commands.look import check_device
from oasis_warp.commands.options import Bench, ErrorTime, Kernels
from oasis_warp.commands.progress import show_progress
from oasis_warp.core.errors import InputError
from oasis_warp.data.atomic import output_file, output_folder

TABLE_WIDTH = 160
"""Columns that the widest table takes."""


def run(options: Bench) -> int:
    """Measure, print tables, write files.

    Raises:
        InputError: a wrong option or output.
    """
    chosen = options.what
    check_device(chosen.device)
    check_numbers(chosen)
    if isinstance(chosen, ErrorTime):
        measure_error_time(chosen)
    else:
        measure_kernels(chosen)
    return 0


def check_numbers(options: ErrorTime | Kernels) -> None:
    """Refuse numbers that nothing can be measured with.

    Raises:
        InputError: names the option.
    """
    if options.repeats is not None and options.repeats < 2:
        raise InputError(f"--repeats: expected 2 or more, got {options.repeats}; quartiles need some.")
    cores = os.cpu_count() or 1
    if not 1 <= options.threads <= cores:
        raise InputError(f"--threads: expected 1 to {cores}, the cores of this machine, got {options.threads}.")
    multiple = 4 if isinstance(options, ErrorTime) else 1
    if isinstance(options, Kernels) and not 1 <= options.gaussians <= HAND_GAUSSIANS:
        raise InputError(
            f"--gaussians: expected 1 to {HAND_GAUSSIANS}, as many as the hand has, got {options.gaussians}."
        )
    if not 16 <= options.size <= 4096 or options.size % multiple:
        wanted = "a multiple of 4 from 16 to 4096" if multiple == 4 else "16 to 4096"
        raise InputError(f"--size: expected {wanted} pixels, got {options.size}.")


def measure_error_time(options: ErrorTime) -> None:
    """`oasis bench error-time`."""
    notes = Console(stderr=True)
    with_plots = pareto.can_plot()
    if not with_plots:
        notes.print(f"oasis: {pareto.MISSING}", highlight=False, soft_wrap=True, markup=False)
    device = torch.device(options.device)
    with output_folder(options.out) as folder:
        with show_progress(notes) as progress, using_threads(options.threads):
            rows = error_time.measure(
                error_time.Sweep(
                    plan=error_time.standard_plan(options.size, options.seed, options.quick),
                    device=device,
                    threads=options.threads,
                    max_threads=os.cpu_count() or 1,
                    repeats=options.repeats or (5 if options.quick else 20),
                ),
                progress,
            )
        write_rows(rows, folder / "error_time.csv", folder / "error_time.json")
        if with_plots:
            for op in dict.fromkeys(row.op for row in rows):
                pareto.plot_operator(rows, op, folder / f"{op}.png")
    console = table_console()
    for group in groups(rows):
        console.print(setting_table(group))
    console.print(budget_table(rows))


def measure_kernels(options: Kernels) -> None:
    """`oasis bench kernels`."""
    device = torch.device(options.device)
    peers = {"gsplat": speed.gsplat_way(device)} if options.peer else {}
    with nullcontext() if options.json is None else output_file(options.json) as part:
        with show_progress(Console(stderr=True)) as progress, using_threads(options.threads):
            rows = speed.measure(
                device=device, gaussians=options.gaussians, size=options.size, threads=options.threads,
                repeats=options.repeats, peers=peers, progress=progress,
            )  # fmt: skip
        if part is not None:
            part.write_text(json_text(rows))
    table_console().print(speed_table(rows))


def table_console() -> Console:
    """The console, wide enough for our tables: a file has no width, and cut numbers say nothing."""
    console = Console()
    return console if console.width >= TABLE_WIDTH else Console(width=TABLE_WIDTH)
