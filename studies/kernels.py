"""How fast the kernels are: on the CPU beside torch, and on a GPU, how times grow and how near its limits they are.

Fills docs/kernels.md (speed) from OUT/speed.json, and OUT/speed_threads.json where several threads were measured, and
docs/gpu.md, its pictures included (which need matplotlib), from OUT/gpu. Running it measures, with `--device cpu` or
`cuda`; these commands do the same:

    oasis bench kernels --json out/speed.json               # --threads 2 --json out/speed_threads.json
    oasis bench kernels --device cuda --json out/gpu/kernels.json
    oasis bench scaling --device cuda --out out/gpu
    oasis bench roofline --device cuda --json out/gpu/roofline.json

On a machine with torch and Warp but without the packages of the command line,

    python -c "from studies import kernels; kernels.measure_gpu(kernels.Options(device='cuda'))"
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from oasis_warp.bench import gpu_cases, roofline, scaling, speed
from oasis_warp.bench.gpu_cases import OURS
from oasis_warp.bench.roofline import KernelRow
from oasis_warp.bench.rows import json_text, read_json
from oasis_warp.bench.scaling import ScalingRow, steepest
from oasis_warp.bench.speed import GpuRow
from oasis_warp.bench.tables import MISSING, can_plot, plot_roofline, plot_scaling, plot_speed
from oasis_warp.data.output_files import write_file
from studies.harness import Row, StudyOptions, report
from studies.tables import Column, Section, power, section_of, short, table, yes

GROUPS, SECONDS = 11, 2.0
"""Groups of calls of each case, and seconds for each point of the scaling: those of `oasis bench`."""
FILES = ("speed.json", "speed_threads.json", "gpu/kernels.json", "gpu/scaling.json", "gpu/roofline.json")


times = "{:.1f}x".format


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    parts: tuple[Literal["kernels", "scaling", "roofline"], ...] = ("kernels", "scaling", "roofline")
    """Parts of the GPU's measurements."""


def measure_part(part: str, options: Options) -> Sequence[Any]:
    """The rows of one part."""
    device = torch.device(options.device)
    if part == "kernels":
        return speed.measure_cases(gpu_cases.choose(""), device, groups=GROUPS, progress=report)
    if part == "scaling":
        return scaling.measure_scaling(scaling.points(quick=False), device, seconds=SECONDS, progress=report)
    return roofline.measure_roofline(device, progress=report)


def measure_gpu(options: Options) -> list[Row]:
    """Measure the parts, and write the files of `oasis bench`."""
    folder = options.out / "gpu"
    folder.mkdir(parents=True, exist_ok=True)
    for part in options.parts:
        rows = measure_part(part, options)
        if not rows:
            raise SystemExit(f"{part}: nothing was measured: no kernels are traced on this device.")
        write_file(folder / f"{part}.json", json_text(rows).encode())
        print(f"{part}: {len(rows)} rows, {rows[0].device}, {rows[0].versions}, {rows[0].commit}")
    return load(options.out)


def run(options: Options) -> list[Row]:
    """Measure on the device."""
    from oasis_warp.cli import main

    if options.device == "cuda":
        return measure_gpu(options)
    options.out.mkdir(parents=True, exist_ok=True)
    main(["bench", "kernels", "--json", str(options.out / "speed.json")])
    return load(options.out)


def load(out: Path) -> list[Row]:
    """What was measured, a row for each file."""
    speed = {name: out / f"{name}.json" for name in ("speed", "speed_threads")}
    found: list[Row] = [{"part": n, "rows": json.loads(p.read_text())} for n, p in speed.items() if p.is_file()]
    gpu = {name: out / "gpu" / f"{name}.json" for name in PARTS}
    return found + [{"part": n, "rows": read_json(PARTS[n].kind, p)} for n, p in gpu.items() if p.is_file()]


def draw(rows: list[Row], static: Path) -> None:
    """The pictures of the GPU's parts.

    Raises:
        SystemExit: matplotlib is missing.
    """
    for row in rows:
        if row["part"] in PARTS:
            if not can_plot():
                raise SystemExit(MISSING)
            PARTS[row["part"]].plot(row["rows"], static / f"gpu_{row['part']}.png")


# ---- the CPU

SPEED = (
    Column("operator", lambda row: f"`{row['op']}`"), Column("pass", "pass"),
    Column("ms", lambda row: row["cpu_ms"] or row["fastest_ms"], ".2f"),
    Column("/ yardstick", "over_yardstick", ".3f"), Column("generic kernels", "scalar", times),
    Column("torch", "torch", times), Column("rel-L2", "rel_l2", power), Column("gradient", "gradient_rel_l2", power),
)  # fmt: skip


def speed_text(rows: list[Row]) -> str | None:
    """A line for each operator and pass of the CPU's measurements, one thread beside several."""
    parts = {row["part"]: row["rows"] for row in rows}
    one, several = parts.get("speed"), parts.get("speed_threads", [])
    if one is None:
        return None
    over = {(r["op"], r["pass"], r["way"]): r.get("over_warp") for r in one}
    threaded = {(r["op"], r["pass"]): r["fastest_ms"] for r in several if r["way"] == "warp"}
    lines = [
        row | {way: over.get((row["op"], row["pass"], way)) for way in ("scalar", "torch")}
        | {"threaded": threaded.get((row["op"], row["pass"]))}
        for row in one if row["way"] == "warp"
    ]  # fmt: skip
    more = (Column(f"ms, {several[0]['threads']} threads", "threaded", ".2f"),) if several else ()
    first = one[0]
    about = (
        f"{first['device']}, {first['versions']}, commit {first['commit']}; {first['gaussians']:,} Gaussians drawn at "
        f"{first['width']} x {first['height']}, the best of {first['repeats']} calls."
    )
    return f"{table((*SPEED, *more))(lines)}\n\n{about}"


# ---- the GPU

CASES = (
    Column("case", "case"), Column("pass", "pass_"), Column("wall ms", "wall_ms", short),
    Column("GPU ms", "busy_ms", short), Column("launched ms", "launch_ms", short),
    Column("views a second", lambda row: 1e3 * row["views"] / row["wall_ms"], short),
    Column("kernels", "kernels", short), Column("MiB", "peak_mb", short), Column("max error", "max_abs", power),
    Column("of 99.99 %", "most_abs", power), Column("rel-L2", "rel_l2", power),
    Column("gradient", "gradient_rel_l2", power), Column("same bits", "bit_equal", yes),
)  # fmt: skip
GROWTH = (
    Column("axis", "axis"), Column("of", "series"), Column("pass", "pass_"), Column("time over work", "ratio", ".2f"),
    Column("between", lambda row: f"{row['before']:,} and {row['after']:,}"),
)  # fmt: skip
POINTS = (
    Column("scene", "scene"), Column("size", lambda row: f"{row['width']} x {row['height']}"), Column("views", "views"),
    Column("pairs", "pairs", ","), Column("longest list", "longest", ","), Column("wall ms", "wall_ms", short),
    Column("GPU ms", "busy_ms", short), Column("with backward: wall ms", "both_wall_ms", short),
    Column("GPU ms", "both_busy_ms", short), Column("MiB", "peak_mb", short),
    Column("with backward", "both_peak_mb", short), Column("finite", "finite", yes),
    Column("overflow", "overflow", yes), Column("compared", "checked"), Column("max error", "max_abs", power),
    Column("of 99.99 %", "most_abs", power),
)  # fmt: skip
ROOFLINE = (
    Column("case", "case"), Column("kernel", "kernel"), Column("launches", "launches", short),
    Column("us", "us", short), Column("MB", "bytes", lambda n: short(1e-6 * n)), Column("GB/s", "gb_s", short),
    Column("MFLOP", "flops", lambda n: short(1e-6 * n)), Column("GFLOP/s", "gflop_s", short),
    Column("floor us", "floor_us", short), Column("share", "share"),
)  # fmt: skip


def provenance(row: GpuRow | ScalingRow | KernelRow) -> str:
    """What a table was measured with."""
    made = f", commit {row.commit}" if row.commit else ""
    return f"{row.device}; {row.versions}{made}."


def case_text(rows: Sequence[GpuRow]) -> str:
    """A line for each case and pass of ours."""
    ours = [row for row in rows if row.way == OURS]
    missing = [f"No graph holds {row.case}, {row.pass_}: {row.not_captured}" for row in ours if row.not_captured]
    about = f"{provenance(rows[0])} Medians of {rows[0].groups} groups of calls."
    return "\n\n".join([table(CASES)(list(map(asdict, ours))) or "", about, *missing])


PEERS = (
    Column("case", "case"), Column("pass", "pass_"), Column("wall ms", "wall_ms", short),
    Column("theirs", "their_ms", short), Column("ratio", lambda row: row["wall_ms"] / row["their_ms"], ".2f"),
    Column("max error", "max_abs", power), Column("theirs", "their_max_abs", power),
    Column("gradient", "gradient_rel_l2", power), Column("theirs", "their_gradient", power),
)  # fmt: skip


def peer_text(rows: Sequence[GpuRow]) -> str:
    """Eager calls of ours beside a peer's, of the cases that both have."""
    theirs = {(row.case, row.pass_): row for row in rows if row.way != OURS}
    lines = []
    for row in rows:
        peer = theirs.get((row.case, row.pass_))
        if row.way == OURS and peer is not None:
            their = {"their_ms": peer.wall_ms, "their_max_abs": peer.max_abs, "their_gradient": peer.gradient_rel_l2}
            lines.append({**asdict(row), **their})
    if not lines:
        return "No peer was installed."
    return f"{table(PEERS)(lines)}\n\n{provenance(rows[0])}"


def growth_text(rows: Sequence[ScalingRow]) -> str:
    """The steepest step of every line."""
    steps = steepest(rows)
    cliffs = "; ".join(f"{step.series}, {step.pass_}" for step in steps if step.cliff)
    verdict = f"Cliffs: {cliffs}." if cliffs else "No step is a cliff."
    return f"{table(GROWTH)([vars(step) for step in steps])}\n\n{verdict} {provenance(rows[0])}"


def point_text(rows: Sequence[ScalingRow]) -> str:
    """Every point, both passes on one line."""

    def key(row: ScalingRow) -> tuple:
        return row.axis, row.scene, row.width, row.height, row.views

    backward, lines = {key(row): row for row in rows if row.pass_ != "forward"}, []
    for row in rows:
        if row.pass_ == "forward":
            both = backward[key(row)]
            more = {f"both_{name}": getattr(both, name) for name in ("wall_ms", "busy_ms", "peak_mb")}
            overflow = None if row.overflow is None else row.overflow or both.overflow
            lines.append({**asdict(row), **more, "finite": row.finite and both.finite, "overflow": overflow})
    return table(POINTS)(lines) or ""


def roofline_text(rows: Sequence[KernelRow]) -> str:
    """Every kernel that takes a hundredth of its case, or has a formula."""
    lines = []
    for case in dict.fromkeys(row.case for row in rows):
        kernels = [row for row in rows if row.case == case]
        total = sum(row.us for row in kernels)
        floors = [row.floor_us for row in kernels if row.floor_us is not None]
        for row in kernels:
            if row.bytes is not None or row.us >= total / 100:
                share = None if row.share is None else f"{row.share:.0%} of {row.bound}"
                lines.append({**asdict(row), "kernel": f"`{row.kernel}`", "share": share})
        floor = {"floor_us": sum(floors), "share": f"{sum(floors) / total:.0%}"} if floors else {}
        lines.append({"case": case, "kernel": "all", "us": total, **floor})
    ceilings = f"{rows[0].ceiling_gb_s:,.0f} GB/s and {rows[0].ceiling_gflop_s:,.0f} GFLOP/s"
    return f"{table(ROOFLINE)(lines)}\n\nCeilings, measured in the same run: {ceilings}. {provenance(rows[0])}"


class Part(NamedTuple):
    """One file of measurements of the GPU, and what the page makes of it."""

    kind: type
    texts: dict[str, Callable[..., str]]
    """By their markers."""
    plot: Callable[..., None]


PARTS = {
    "kernels": Part(GpuRow, {"kernels": case_text, "peers": peer_text}, plot_speed),
    "scaling": Part(ScalingRow, {"growth": growth_text, "points": point_text}, plot_scaling),
    "roofline": Part(KernelRow, {"roofline": roofline_text}, plot_roofline),
}
SECTIONS = (
    Section("kernels.md", "speed", speed_text, "speed.json"),
    *(
        section_of("gpu.md", marker, lambda row, text=text: text(row["rows"]), f"gpu/{name}.json", part=name)
        for name, part in PARTS.items() for marker, text in part.texts.items()
    ),
)  # fmt: skip
