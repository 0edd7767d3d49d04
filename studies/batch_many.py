"""Thousands of small photos end to end under plain processes, without Dask, and one photo beside busy processes.

Fills docs/batch.md (many, busy). Photos are those of the tests, 256 pixels wide, each time cut at another place, so
that no two have the same bytes. Measure on a machine that has nothing else to do; a row says how busy it was before.
"""

import json
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2

from oasis_warp.cli.batch import finish, split_tasks
from oasis_warp.cli.batch_work import ROW, Order, make_avatars
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.processes import worker_pool
from oasis_warp.data.photo import read_photo
from oasis_warp.ops import warm_up
from studies.harness import Row, StudyOptions, measured
from studies.inputs import PHOTOS, photos_below
from studies.tables import Column, Section, table

SIDE = 256
"""Side of the photos [px]."""
SMALLEST = ReconstructConfig(size=64, prior="none", unseen="plain", light="keep", steps=0)
"""What takes least and still goes the whole way."""
BUSY_PHOTO = "palm_open_left_02.png"


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"photos", "processes", "others"})
    photos: int = 100
    """How many; 2,000 on a machine of 16 cores."""
    processes: tuple[int, ...] = (2,)
    """Numbers of processes that share them."""
    others: tuple[int, ...] = (8,)
    """Numbers of busy processes beside one photo."""


def write_photos(folder: Path, count: int) -> None:
    """Small photos of other bytes each."""
    every = photos_below(PHOTOS)
    for k in range(count):
        pixels = read_photo(every[k % len(every)]).rgb.numpy()[..., ::-1]
        size, cut = (SIDE, round(SIDE * pixels.shape[0] / pixels.shape[1])), k // len(every)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        pixels = pixels[cut // 8 :, cut % 8 :]
        pixels[0, 0] = k % 256, k // 256, 0  # some of the tests' photos are there twice
        cv2.imwrite(str(folder / f"{k:05d}.png"), pixels)


def cpu_seconds() -> float:
    """CPU seconds of the processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measure_many(photos: int, processes: int) -> Row:
    """All photos from files to the manifest; what is lost, double or half is counted."""
    with tempfile.TemporaryDirectory() as name:
        source, out = Path(name, "photos"), Path(name, "out")
        source.mkdir()
        write_photos(source, photos)
        warm_up("cpu")
        order, load = Order(source=source, out=out, config=SMALLEST), os.getloadavg()[0]
        out.mkdir()
        tasks = split_tasks(sorted(path.name for path in source.iterdir()), processes)
        counts, start, before = Counter[str](), time.perf_counter(), cpu_seconds()
        with worker_pool(processes) as pool:
            for done in as_completed([pool.submit(make_avatars, task, order) for task in tasks]):
                counts.update(done.result())
        seconds, cpu = time.perf_counter() - start, cpu_seconds() - before
        finish(order, tasks)
        rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
        folders = [path.parent for path in out.glob(f"avatars/*/*/{ROW}")]
        missing = counts["made"] - sum((folder / "avatar.safetensors").is_file() for folder in folders)
        missing += sum(row["status"] in ("made", "refused") for row in rows) - len(folders)
    return {
        "kind": "many", "photos": photos, "workers": processes, "wall_s": seconds, "cpu_s": cpu / photos, "load": load,
        **{key: counts[key] for key in ("made", "refused", "failed")}, "lost": photos - len(rows),
        "double": len(rows) - len({row["photo"] for row in rows}), "half": missing,
    }  # fmt: skip


def spin(until: float) -> None:
    """Be busy."""
    while time.time() < until:
        sum(range(1000))


def reconstruct_once(out: Path) -> tuple[float, float]:
    """Wall and CPU seconds of `oasis reconstruct` with default threads."""
    command = [sys.executable, "-m", "oasis_warp", "reconstruct", str(PHOTOS / BUSY_PHOTO), "-o", str(out), "--quiet"]
    start, before = time.perf_counter(), cpu_seconds()
    subprocess.run([*command, "--size", "256"], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start, cpu_seconds() - before


def measure_busy(others: int) -> Row:
    """One photo alone, then beside busy processes, as a multiple of its fair share of the cores."""
    with tempfile.TemporaryDirectory() as name:
        reconstruct_once(Path(name, "first"))  # compiles kernels
        load = os.getloadavg()[0]
        alone, cpu = reconstruct_once(Path(name, "alone"))
        spinning = [multiprocessing.Process(target=spin, args=(time.time() + 600,)) for _ in range(others)]
        for process in spinning:
            process.start()
        try:
            wall, busy_cpu = reconstruct_once(Path(name, "busy"))
        finally:
            for process in spinning:
                process.kill()
    cores = len(os.sched_getaffinity(0))
    fair = max(alone, cpu * max(1.0, (others + 1) / cores))
    return {
        "kind": "busy", "others": others, "cores": cores, "alone_s": alone, "cpu_s": cpu, "wall_s": wall, "load": load,
        "busy_cpu_s": busy_cpu, "fair_s": fair, "ratio": wall / fair,
    }  # fmt: skip


def measure_load(kind: str, *about: int) -> Row:
    """A case."""
    return measure_many(*about) if kind == "many" else measure_busy(*about)


def run(options: Options) -> list[Row]:
    """All numbers of processes, then all numbers of busy ones."""
    cases: dict[str, tuple] = {f"{options.photos} photos, {n}": ("many", options.photos, n) for n in options.processes}
    cases |= {f"{n} others": ("busy", n) for n in options.others}
    return measured("batch_many", cases, measure_load, options)


MANY = (
    Column("photos", "photos", ",d"), Column("processes", "workers"), Column("s for all", "wall_s", ".0f"),
    Column("photos an hour", lambda row: 3600 * row["photos"] / row["wall_s"], ",.0f"),
    Column("CPU s a photo", "cpu_s", ".2f"), Column("made", "made"), Column("refused", "refused"),
    Column("failed", "failed"),
    Column("lost, double or half", lambda row: row["lost"] + row["double"] + row["half"], "d"),
    Column("load before", "load", ".1f"),
)  # fmt: skip
BUSY = (
    Column("busy processes", "others"), Column("cores", "cores"), Column("s alone", "alone_s", ".1f"),
    Column("CPU s", "cpu_s", ".1f"), Column("s beside them", "wall_s", ".1f"),
    Column("CPU s then", "busy_cpu_s", ".1f"),
    Column("its fair share, s", "fair_s", ".1f"), Column("times that", "ratio", ".2f"),
    Column("load before", "load", ".1f"),
)  # fmt: skip
SECTIONS = (
    Section("batch.md", "many", table(MANY, lambda rows: [row for row in rows if row.get("kind") == "many"])),
    Section("batch.md", "busy", table(BUSY, lambda rows: [row for row in rows if row.get("kind") == "busy"])),
)
