"""Measure everything for docs/gpu.md on a machine that has torch and Warp, but not the packages of the command line.

    python studies/measure_gpu.py out/gpu                            # all of it, in some minutes
    python studies/measure_gpu.py out/gpu kernels --only 512 --peer gsplat
    python studies/measure_gpu.py out/gpu scaling roofline

Writes kernels.json, scaling.json and roofline.json, those of `oasis bench`, and prints one line a row; then, where
matplotlib is,

    python studies/write_gpu_numbers.py docs/gpu.md out/gpu
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from oasis_warp.bench import gpu_cases, gpu_speed, roofline, scaling
from oasis_warp.bench.rows import json_text, to_record
from oasis_warp.data.output_files import write_file

PARTS = "kernels", "scaling", "roofline"
SILENT = (
    "device", "commit", "versions", "seed", "series", "faces", "groups", "calls", "wall_iqr_ms", "busy_iqr_ms",
    "ceiling_gb_s", "ceiling_gflop_s",
)  # fmt: skip
"""Columns that say little about a row, and are not printed."""


def line(row: Any) -> str:
    """A row as `name=value` pairs, numbers short."""
    cells = {key: value for key, value in to_record(row).items() if key not in SILENT and value not in (None, "")}
    return " ".join(f"{key}={f'{value:.4g}' if isinstance(value, float) else value}" for key, value in cells.items())


def report(stage: str, done: int, total: int) -> None:
    """Progress, a line each time."""
    print(f"{stage}: {done} of {total}", file=sys.stderr)


def measure(part: str, device: torch.device, options: argparse.Namespace) -> Sequence[Any]:
    """The rows of one part."""
    if part == "kernels":
        peers = {"gsplat": gpu_speed.gsplat_draw()} if options.peer else {}
        cases = gpu_cases.choose(options.only)
        return gpu_speed.measure(cases, device, groups=options.groups, peers=peers, progress=report)
    if part == "scaling":
        points = scaling.points(options.quick)
        return scaling.measure(points, device, seconds=options.seconds, progress=report)
    return roofline.measure(device, progress=report)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder, made if it is not there")
    parser.add_argument("parts", nargs="*", metavar="part", help=f"of {', '.join(PARTS)}; all when none is given")
    parser.add_argument("--only", default="", help="kernels: cases whose name or pass holds this")
    parser.add_argument("--peer", choices=["gsplat"], help="kernels: time it too")
    parser.add_argument("--groups", type=int, default=11, help="kernels: of calls")
    parser.add_argument("--quick", action="store_true", help="scaling: small scenes only")
    parser.add_argument("--seconds", type=float, default=2.0, help="scaling: for timing each point")
    parser.add_argument("--device", default="cuda")
    options = parser.parse_args()
    wrong = [part for part in options.parts if part not in PARTS]
    if wrong:
        parser.error(f"part: expected {', '.join(PARTS)}, got {wrong[0]}")
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch finds no CUDA device")
    options.out.mkdir(parents=True, exist_ok=True)
    for part in options.parts or PARTS:
        start = time.perf_counter()
        rows = measure(part, torch.device(options.device), options)
        if not rows:
            parser.error(f"{part}: nothing to measure; no case holds --only, or the profiler traces no kernels here")
        write_file(options.out / f"{part}.json", json_text(rows).encode())
        print(f"{part}: {time.perf_counter() - start:.1f} s, {rows[0].device}, {rows[0].versions}, {rows[0].commit}")
        for row in rows:
            print(" ", line(row))


if __name__ == "__main__":
    main()
