"""How fast the kernels are: on the CPU beside torch, and on a GPU, how times grow and how near its limits they are.

Fills docs/kernels.md (speed) from OUT/speed.json, and OUT/speed_threads.json where several threads were measured, and
docs/gpu.md, its pictures included (which need matplotlib), from OUT/gpu. Running it measures, with `--device cpu` or
`cuda`; these commands do the same:

    oasis bench kernels --json out/speed.json               # --threads 2 --json out/speed_threads.json
    oasis bench kernels --device cuda --json out/gpu/kernels.json            # --peer gsplat
    oasis bench scaling --device cuda --out out/gpu
    oasis bench roofline --device cuda --json out/gpu/roofline.json

On a machine with torch and Warp but without the packages of the command line,

    python -c "from studies import kernels; kernels.measure_gpu(kernels.Options(device='cuda'))"
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from oasis_warp.bench import gpu_cases, gpu_speed, roofline, scaling
from oasis_warp.bench.gpu_cases import OURS
from oasis_warp.bench.gpu_speed import GpuRow
from oasis_warp.bench.plots import MISSING, can_plot, plot_roofline, plot_scaling, plot_speed
from oasis_warp.bench.roofline import RECORD, KernelRow
from oasis_warp.bench.rows import json_text, read_json
from oasis_warp.bench.scaling import ScalingRow, steepest
from oasis_warp.data.output_files import write_file
from studies.harness import Row, StudyOptions, report
from studies.tables import Section, markdown, power, section_of, short

GROUPS, SECONDS = 11, 2.0
"""Groups of calls of each case, and seconds for each point of the scaling: those of `oasis bench`."""


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    parts: tuple[Literal["kernels", "scaling", "roofline"], ...] = ("kernels", "scaling", "roofline")
    """Of the GPU's."""
    peer: Literal["none", "gsplat"] = "none"
    """Another rasterizer to time beside the kernels."""


class Part(NamedTuple):
    """One file of measurements of the GPU, and what the page makes of it."""

    kind: type
    tables: dict[str, Callable[..., str]]
    """By their markers."""
    plot: Callable[..., None]
    caption: str


def measure_part(part: str, options: Options) -> Sequence[Any]:
    """The rows of one part."""
    device = torch.device(options.device)
    if part == "kernels":
        peers = {"gsplat": gpu_speed.gsplat_draw()} if options.peer == "gsplat" else {}
        return gpu_speed.measure_cases(gpu_cases.choose(""), device, groups=GROUPS, peers=peers, progress=report)
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


def speed_text(rows: list[Row]) -> str | None:
    """A line for each operator and pass."""
    parts = {row["part"]: row["rows"] for row in rows}
    one, several = parts.get("speed"), parts.get("speed_threads", [])
    if one is None:
        return None

    def find(records: list[dict[str, Any]], like: dict[str, Any], way: str) -> dict[str, Any] | None:
        return next((r for r in records if (r["op"], r["pass"], r["way"]) == (like["op"], like["pass"], way)), None)

    lines = []
    for ours in (record for record in one if record["way"] == "warp"):
        peers = (find(one, ours, way) for way in ("scalar", "torch"))
        threaded = find(several, ours, "warp")
        lines.append([
            f"`{ours['op']}`", ours["pass"], f"{ours['cpu_ms'] or ours['fastest_ms']:.2f}",
            f"{ours['over_yardstick']:.3f}", *("" if peer is None else f"{peer['over_warp']:.1f}x" for peer in peers),
            power(ours["rel_l2"]), power(ours["gradient_rel_l2"]),
            *([f"{threaded['fastest_ms']:.2f}"] if threaded else []),
        ])  # fmt: skip
    headings = ["operator", "pass", "ms", "/ yardstick", "generic kernels", "torch", "rel-L2", "gradient"]
    headings += [f"ms, {several[0]['threads']} threads"] if several else []
    first = one[0]
    about = (
        f"{first['device']}, {first['versions']}, commit {first['commit']}; {first['gaussians']:,} Gaussians drawn at "
        f"{first['width']} x {first['height']}, the best of {first['repeats']} calls."
    )
    return f"{markdown(headings, lines)}\n\n{about}"


# ---- the GPU


def provenance(row: GpuRow | ScalingRow | KernelRow) -> str:
    """What a table was measured with."""
    made = f", commit {row.commit}" if row.commit else ""
    return f"{row.device}; {row.versions}{made}."


def speed_lines(rows: Sequence[GpuRow]) -> str:
    """A line a case and pass, ours."""
    lines = [
        (
            row.case, row.pass_, short(row.wall_ms), short(row.busy_ms), short(row.launch_ms),
            short(1e3 * row.views / row.wall_ms), short(row.kernels), short(row.peak_mb), power(row.max_abs),
            power(row.most_abs), power(row.rel_l2), power(row.gradient_rel_l2), "yes" if row.bit_equal else "no",
        )
        for row in rows
        if row.way == OURS
    ]  # fmt: skip
    heading = (
        "case", "pass", "wall ms", "GPU ms", "launched ms", "views a second", "kernels", "MiB", "max error",
        "of 99.99 %", "rel-L2", "gradient", "same bits",
    )  # fmt: skip
    first = rows[0]
    about = f"{provenance(first)} Medians of {first.groups} groups of calls."
    missing = [f"No graph holds {row.case}, {row.pass_}: {row.not_captured}" for row in rows if lacks_graph(row)]
    return "\n\n".join([markdown(heading, lines), about, *missing])


def lacks_graph(row: GpuRow) -> bool:
    """Whether a graph of ours was tried in vain."""
    return row.way == OURS and bool(row.not_captured)


def peer_lines(rows: Sequence[GpuRow]) -> str:
    """Ours over each peer, on the host's clock and in kernels."""
    ours = {(row.case, row.pass_): row for row in rows if row.way == OURS}
    lines = []
    for peer in rows:
        if peer.way == OURS:
            continue
        own = ours[peer.case, peer.pass_]
        kernels = None
        if own.kernels_ms is not None and peer.kernels_ms is not None:
            kernels = peer.kernels_ms / own.kernels_ms
        lines.append(
            (
                peer.case, peer.pass_, peer.way, short(own.wall_ms), short(peer.wall_ms),
                f"{peer.wall_ms / own.wall_ms:.1f}x", short(own.kernels_ms), short(peer.kernels_ms),
                "" if kernels is None else f"{kernels:.1f}x", power(peer.most_abs), power(peer.gradient_rel_l2),
            )
        )  # fmt: skip
    if not lines:
        return "No other rasterizer was installed where this was measured."
    heading = (
        "case", "pass", "peer", "wall ms", "peer's", "ratio", "kernels ms", "peer's", "ratio",
        "peer's error of 99.99 %", "peer's gradient",
    )  # fmt: skip
    return markdown(heading, lines)


def growth_lines(rows: Sequence[ScalingRow]) -> str:
    """The steepest step of every line."""
    lines = [
        (step.axis, step.series, step.pass_, f"{step.ratio:.2f}", f"{step.before:,} and {step.after:,}")
        for step in steepest(rows)
    ]
    found = [f"{step.series}, {step.pass_}" for step in steepest(rows) if step.cliff]
    verdict = f"Cliffs: {'; '.join(found)}." if found else "No step is a cliff."
    return f"{markdown(('axis', 'of', 'pass', 'time over work', 'between'), lines)}\n\n{verdict} {provenance(rows[0])}"


def point_lines(rows: Sequence[ScalingRow]) -> str:
    """Every point, both passes on one line."""
    backward = {key(row): row for row in rows if row.pass_ != "forward"}
    lines = []
    for row in rows:
        if row.pass_ != "forward":
            continue
        both = backward[key(row)]
        right = "yes" if row.finite and both.finite else "no"
        overflow = "" if row.overflow is None else "yes" if row.overflow or both.overflow else "no"
        lines.append(
            (
                row.scene, f"{row.width} x {row.height}", str(row.views), f"{row.pairs:,}", f"{row.longest:,}",
                short(row.wall_ms), short(row.busy_ms), short(both.wall_ms), short(both.busy_ms), short(row.peak_mb),
                short(both.peak_mb), right, overflow, row.checked, power(row.max_abs), power(row.most_abs),
            )
        )  # fmt: skip
    heading = (
        "scene", "size", "views", "pairs", "longest list", "wall ms", "GPU ms", "with backward: wall ms", "GPU ms",
        "MiB", "with backward", "finite", "overflow", "compared", "max error", "of 99.99 %",
    )  # fmt: skip
    return markdown(heading, lines)


def key(row: ScalingRow) -> tuple[str, str, int, int, int]:
    """What a point's two rows share."""
    return row.axis, row.scene, row.width, row.height, row.views


def roofline_lines(rows: Sequence[KernelRow]) -> str:
    """Every kernel that takes a hundredth of its case, or has a formula."""
    lines = []
    for case in dict.fromkeys(row.case for row in rows):
        kernels = [row for row in rows if row.case == case]
        total = sum(row.us for row in kernels)
        floors = [row.floor_us for row in kernels if row.floor_us is not None]
        for row in kernels:
            if row.bytes is None and row.us < total / 100:
                continue
            lines.append(
                (
                    case, f"`{row.kernel}`", short(row.launches), short(row.us),
                    "" if row.bytes is None else short(1e-6 * row.bytes), short(row.gb_s),
                    "" if row.flops is None else short(1e-6 * row.flops), short(row.gflop_s), short(row.floor_us),
                    "" if row.share is None else f"{row.share:.0%} of {row.bound}",
                )
            )  # fmt: skip
        share = f"{sum(floors) / total:.0%}" if floors else ""
        lines.append((case, "all", "", short(total), "", "", "", "", short(sum(floors)) if floors else "", share))
    first = rows[0]
    about = (
        f"Ceilings, measured in the same run: {first.ceiling_gb_s:,.0f} GB/s and {first.ceiling_gflop_s:,.0f} GFLOP/s. "
        f"{provenance(first)}"
    )
    heading = ("case", "kernel", "launches", "us", "MB", "GB/s", "MFLOP", "GFLOP/s", "floor us", "share")
    return f"{markdown(heading, lines)}\n\n{about}"


def determinism_lines(rows: Sequence[KernelRow]) -> str:
    """What adding up in a fixed order takes in each case that does it."""
    sentences = []
    for case in dict.fromkeys(row.case for row in rows):
        kernels = [row for row in rows if row.case == case]
        gathers = [row for row in kernels if row.kernel.startswith("gather_")]
        writer = next((row for row in kernels if row.kernel.startswith("blend_tiles_backward")), None)
        if not gathers or writer is None:
            continue
        total, taken = sum(row.us for row in kernels), sum(row.us for row in gathers)
        names = " and ".join(f"`{row.kernel}`" for row in gathers)
        sentences.append(
            f"{case}: {names} {'take' if len(gathers) > 1 else 'takes'} {short(taken)} of the {short(total)} us that "
            f"all kernels take ({taken / total:.0%}); a record has {RECORD} bytes."
        )
    return "\n".join(f"- {sentence}" for sentence in sentences) or "Not measured."


PARTS = {
    "kernels": Part(GpuRow, {"kernels": speed_lines, "peers": peer_lines}, plot_speed, "Times of every case"),
    "scaling": Part(
        ScalingRow, {"growth": growth_lines, "points": point_lines}, plot_scaling,
        "Time for a Gaussian, a pixel and a view, and memory, against their number",
    ),
    "roofline": Part(
        KernelRow, {"roofline": roofline_lines, "determinism": determinism_lines}, plot_roofline,
        "Operations a second of every kernel below the ceilings",
    ),
}  # fmt: skip


def picture_link(row: Row) -> str:
    """The picture of a part."""
    return f"![{PARTS[row['part']].caption}](_static/gpu_{row['part']}.png)"


SECTIONS = (
    Section("kernels.md", "speed", speed_text),
    *(
        section_of("gpu.md", marker, lambda row, text=text: text(row["rows"]), part=name)
        for name, part in PARTS.items() for marker, text in part.tables.items()
    ),
    *(
        section_of("gpu.md", f"picture of {name}", picture_link, part=name)
        for name in PARTS
    ),
)
