"""`oasis gradcheck`: measure what the operators promise and say whether they keep it."""

import os
import time
from collections.abc import Iterator
from contextlib import nullcontext

import torch
from rich import box
from rich.console import Console
from rich.table import Table

from oasis_warp import __version__
from oasis_warp.certify.certification import (
    Tally,
    Verdict,
    as_table,
    by_condition,
    describe_machine,
    grid_scenes,
    run_grid,
    steps,
)
from oasis_warp.certify.compare import Measurement
from oasis_warp.certify.families import FAMILIES
from oasis_warp.cli.developer_options import Gradcheck
from oasis_warp.cli.progress import FAULT, Terminal, show_progress
from oasis_warp.cli.record import exact_command
from oasis_warp.cli.report import to_json
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import output_file

SHOWN = 20
"""Failures that are printed one by one."""


def run(options: Gradcheck) -> int:
    """Measure, print the table, write the file; the exit code."""
    check(options)
    names = (options.family,) if options.family else tuple(FAMILIES)
    device = torch.device(options.device)
    start, verdict = time.monotonic(), Verdict()
    # The file is opened first: what cannot be written is refused before a minute of work.
    with output_file(options.json) if options.json else nullcontext() as part:
        with show_progress(Terminal()) as progress:
            for stage, done, total, measured in measurements(options, names, device):
                verdict.add(measured)
                progress(stage, done, total)
        seconds = time.monotonic() - start
        if part is not None:
            part.write_text(report(options, verdict, device, seconds))
    print_verdict(Console(), verdict, options, seconds)
    return 0 if verdict.passed else FAULT


def check(options: Gradcheck) -> None:
    """Refuse what cannot be done, before anything is."""
    for name, value in (("scenes", options.scenes), ("jobs", options.jobs)):
        if value is not None and value < 1:
            raise InputError(f"--{name}: expected 1 or more, got {value}.")
    if options.seed < 0:
        raise InputError(f"--seed: expected 0 or more, got {options.seed}.")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device: no CUDA device found; leave it out to certify the CPU.")


def measurements(
    options: Gradcheck, names: tuple[str, ...], device: torch.device
) -> Iterator[tuple[str, int, int, list[Measurement]]]:
    """(stage, how much of it is done, of how much, what was measured)."""
    if options.scenes is None:
        for name in names:
            todo = list(steps(FAMILIES[name], device, options.seed))
            for i, step in enumerate(todo):
                yield name, i + 1, len(todo), step()
        return
    n_processes = options.jobs or (1 if device.type == "cuda" else os.cpu_count() or 1)
    done = 0
    for count, measured in run_grid(grid_scenes(names, options.scenes, options.seed), device, n_processes):
        done += count
        yield "scenes", done, options.scenes, measured


def report(options: Gradcheck, verdict: Verdict, device: torch.device, seconds: float) -> str:
    """Everything as JSON."""
    return to_json(
        {
            "creator": f"oasis_warp {__version__}",
            "command": exact_command(),
            "machine": describe_machine(device),
            "seed": options.seed,
            "scenes": options.scenes,
            "seconds": seconds,
            "passed": verdict.passed,
            "checks": as_table(verdict),
            "conditions": by_condition(verdict),
            "failures": [m._asdict() for m in verdict.failed],
        }
    )


def print_verdict(console: Console, verdict: Verdict, options: Gradcheck, seconds: float) -> None:
    """The table, the failures, and a sentence."""
    table = Table("check", "worst error", "bound", "cases", "", box=box.SIMPLE_HEAD, padding=(0, 1))
    for family in dict.fromkeys(family for family, _ in verdict.rows):
        table.add_row(f"[bold]{family}[/]")
        for (owner, name), row in verdict.rows.items():
            if owner == family:
                mark = "[green]ok[/]" if row.passed else f"[red]{row.failures} FAILED[/]"
                table.add_row(f"  {name}", *numbers(row), mark)
    console.print(table)
    for m in verdict.failed[:SHOWN]:
        line = f"{m.family}, {m.check}: {m.scene}: {m.error:.2e}, expected at most {m.bound:.0e}"
        console.print(line, style="red", highlight=False, soft_wrap=True)
    if len(verdict.failed) > SHOWN:
        console.print(f"... and {len(verdict.failed) - SHOWN} more", style="red")
    total = sum(row.cases for row in verdict.rows.values())
    what = f"{options.scenes} scenes, " if options.scenes else ""
    outcome = "all within bounds" if verdict.passed else f"{len(verdict.failed)} beyond their bounds"
    console.print(f"{what}{total} measurements on {options.device} in {seconds:.0f} s: {outcome}.", highlight=False)
    if verdict.failed and options.scenes:
        seed = verdict.failed[0].scene.split("seed ")[1].split(":")[0]
        again = f"oasis gradcheck --scenes 1 --family {verdict.failed[0].family} --seed {seed}"
        console.print(f"The first failure alone: {again}", highlight=False, soft_wrap=True)


def numbers(row: Tally) -> tuple[str, str, str]:
    """Worst error, its bound and the number of cases, as text."""
    if row.worst.bound == 0:
        return f"{row.worst.error:.0f}", "0", str(row.cases)
    return f"{row.worst.error:.1e}", f"{row.worst.bound:.0e}", str(row.cases)
