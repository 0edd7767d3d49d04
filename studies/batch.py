"""What a photo costs in `oasis batch`, and what a million of them take.

Fills docs/batch.md (cost, scaling, plan). Each case runs the command twice: the second run finds all results, and so
costs what starting and finding cost. Times are CPU seconds of all processes where other work may go on beside it.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from studies.harness import Row, StudyOptions, measured
from studies.inputs import PHOTOS, photos_below
from studies.tables import Column, Section, complete, markdown, table

SETTINGS = {
    "as it ships": (), "`--pictures`": ("--pictures",),
    "`--size 256`": ("--size", "256"),
    "`--size 256 --prior none --unseen plain`": ("--size", "256", "--prior", "none", "--unseen", "plain"),
}  # fmt: skip
MILLION, CORES, MACHINES = 1_000_000, 16, (1, 10, 100)
"""Photos, cores of a machine, and machines of the plan."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"processes", "only"})
    photos: int = 16
    """Number of the tests' photos, taken evenly from all."""
    processes: tuple[int, ...] = (1, 2)
    """Workers that share the photos as it ships."""
    only: tuple[str, ...] = tuple(SETTINGS)
    """Settings to measure."""


def batch(listed: Path, out: Path, workers: int, flags: tuple[str, ...]) -> tuple[float, float, float]:
    """Run the command: seconds, CPU seconds of all its processes, and the most memory that one of them took [GiB]."""
    command = [sys.executable, "-m", "oasis_warp", "batch", str(listed), "-o", str(out), "--workers", str(workers)]
    start = time.perf_counter()
    process = subprocess.Popen(
        [*command, *flags], stdout=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, f"ended with {process.returncode}"
    return time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20


def measure_setting(setting: str, workers: int, n: int, device: str) -> Row:
    """One setting with so many workers."""
    every = photos_below(PHOTOS)
    with tempfile.TemporaryDirectory() as name:
        listed, out = Path(name, "photos.txt"), Path(name, "out")
        listed.write_text("".join(f"{every[k * len(every) // n].absolute()}\n" for k in range(n)))
        flags = (*SETTINGS[setting], "--device", device)
        wall, cpu, peak = batch(listed, out, workers, flags)
        again, start, _ = batch(listed, out, workers, flags)
        statuses = [json.loads(line)["status"] for line in (out / "manifest.jsonl").read_text().splitlines()]
        stages = Counter[str]()
        for report in out.glob("avatars/*/*/report.json"):
            stages.update(json.loads(report.read_text())["seconds"])
        size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    made, total = statuses.count("made"), stages.pop("total")
    return {
        "setting": setting, "workers": workers, "photos": n, "made": made, "declined": statuses.count("refused"),
        "cpu_s": (cpu - start) / n, "wall_s": wall - again, "start_s": start, "start_wall_s": again, "peak_gib": peak,
        "megabytes": size / made / 1e6, "stages": {stage: value / total for stage, value in stages.most_common()},
    }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure every setting with one worker, and as it ships with several."""
    first = next(iter(SETTINGS))
    cases = {f"{setting}, 1": (setting, 1) for setting in options.only}
    cases |= {f"{first}, {n}": (first, n) for n in options.processes}
    return measured(
        "batch",
        {case: (*about, options.photos, options.device) for case, about in cases.items()},
        measure_setting,
        options,
    )


# ---- tables


def cost_rows(rows: list[Row]) -> list[Row]:
    """A row for each setting, with one worker."""
    return [row for row in complete(rows) if row["workers"] == 1]


def scaling_text(rows: list[Row]) -> str | None:
    """CPU time a photo with several workers over that with one."""
    shipped = [row for row in complete(rows) if row["setting"] == next(iter(SETTINGS))]
    one = next((row for row in shipped if row["workers"] == 1), None)
    if one is None:
        return None
    lines = []
    for row in sorted(shipped, key=lambda row: row["workers"]):
        by_cpu = row["workers"] * one["cpu_s"] / row["cpu_s"]
        numbers = (row["cpu_s"], by_cpu, row["wall_s"], one["wall_s"] / row["wall_s"])
        lines.append([str(row["workers"]), *(format(number, ".2f") for number in numbers)])
    return markdown(
        ["workers", "CPU s a photo", "times one worker, by CPU time", "s for all", "times, by the clock"], lines
    )


def plan_text(rows: list[Row]) -> str | None:
    """What a million photos take, from what was measured as it ships."""
    shipped = [row for row in complete(rows) if row["setting"] == next(iter(SETTINGS))]
    if not shipped:
        return None
    row = max(shipped, key=lambda row: row["workers"])
    lines = []
    for machines in MACHINES:
        workers = machines * CORES
        hours = MILLION * row["cpu_s"] / workers / 3600
        tasks = min(256, MILLION // (16 * workers))
        lines.append([
            str(machines), str(workers), f"{hours / 24:.1f} days" if hours > 48 else f"{hours:.1f} hours",
            f"{CORES * row['peak_gib']:.0f} GB", f"{workers / row['cpu_s']:.1f}",
            f"{workers / row['cpu_s'] * row['megabytes']:.0f} MB/s", f"{math.ceil(MILLION / tasks):,} of {tasks}",
        ])  # fmt: skip
    headings = ["machines", "workers", "time", "memory of a machine", "photos a second", "written", "tasks of photos"]
    total = MILLION * row["megabytes"] * row["made"] / row["photos"] / 1e6
    return f"{markdown(headings, lines)}\n\nOn the disk: {total:.1f} TB."


COST = (
    Column("setting", "setting"), Column("CPU s a photo", "cpu_s", ".1f"),
    Column("photos an hour and core", lambda row: 3600 / row["cpu_s"], ".0f"),
    Column("most memory of a worker, GiB", "peak_gib", ".2f"), Column("MB an avatar", "megabytes", ".1f"),
    Column("CPU s to start", "start_s", ".0f"),
    Column("stages that take most", lambda row: ", ".join(
        f"{stage} {100 * share:.0f} %" for stage, share in list(row["stages"].items())[:4])),
)  # fmt: skip
SECTIONS = (
    Section("batch.md", "cost", table(COST, cost_rows)),
    Section("batch.md", "scaling", scaling_text),
    Section("batch.md", "plan", plan_text),
)
