"""Put what was measured on a GPU into docs/gpu.md, each table between its two markers, and its pictures beside it.

    oasis bench kernels --device cuda --json out/gpu/kernels.json            # --peer gsplat
    oasis bench scaling --device cuda --out out/gpu
    oasis bench roofline --device cuda --json out/gpu/roofline.json
    python studies/write_gpu_numbers.py docs/gpu.md out/gpu

or studies/measure_gpu.py for the first three. What has no file in the folder stays as it is on the page. Pictures need
matplotlib.
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from oasis_warp.bench.gpu_cases import OURS
from oasis_warp.bench.gpu_speed import GpuRow
from oasis_warp.bench.pareto import MISSING, can_plot
from oasis_warp.bench.plots import plot_roofline, plot_scaling, plot_speed
from oasis_warp.bench.roofline import RECORD, KernelRow
from oasis_warp.bench.rows import read_json
from oasis_warp.bench.scaling import ScalingRow, steepest
from oasis_warp.data.output_files import write_file


def table(heading: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (heading, ["---"] * len(heading), *lines))


def power(value: float | None) -> str:
    """An error in powers of ten."""
    return "" if value is None else f"{value:.0e}".replace("e-0", "e-") if value else "0"


def short(value: float | None, digits: int = 3) -> str:
    """A number of so many digits, never as a power of ten."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 10 ** (digits - 1) else f"{float(f'{value:.{digits}g}'):g}"


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
    return "\n\n".join([table(heading, lines), about, *missing])


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
    return table(heading, lines)


def growth_lines(rows: Sequence[ScalingRow]) -> str:
    """The steepest step of every line."""
    lines = [
        (step.axis, step.series, step.pass_, f"{step.ratio:.2f}", f"{step.before:,} and {step.after:,}")
        for step in steepest(rows)
    ]
    found = [f"{step.series}, {step.pass_}" for step in steepest(rows) if step.cliff]
    verdict = f"Cliffs: {'; '.join(found)}." if found else "No step is a cliff."
    return f"{table(('axis', 'of', 'pass', 'time over work', 'between'), lines)}\n\n{verdict} {provenance(rows[0])}"


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
    return table(heading, lines)


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
    return f"{table(heading, lines)}\n\n{about}"


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


def replaced(page: str, name: str, text: str) -> str:
    """The page with what stands between the markers of `name` replaced."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    head, rest = page.split(begin)
    _, tail = rest.split(end)
    return f"{head}{begin}\n{text}\n{end}{tail}"


class Part(NamedTuple):
    """One file of measurements and what the page makes of it."""

    name: str
    kind: type
    tables: dict[str, Callable[..., str]]
    """By their markers."""
    plot: Callable[..., None]
    caption: str


PARTS = (
    Part("kernels", GpuRow, {"kernels": speed_lines, "peers": peer_lines}, plot_speed, "Times of every case"),
    Part(
        "scaling", ScalingRow, {"growth": growth_lines, "points": point_lines}, plot_scaling,
        "Time for a Gaussian, a pixel and a view, and memory, against their number",
    ),
    Part(
        "roofline", KernelRow, {"roofline": roofline_lines, "determinism": determinism_lines}, plot_roofline,
        "Operations a second of every kernel below the ceilings",
    ),
)  # fmt: skip


def main() -> None:
    """Read the numbers, rewrite the page, draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("folder", type=Path, help="with kernels.json, scaling.json and roofline.json, or some of them")
    options = parser.parse_args()
    page = options.page.read_text()
    if not can_plot():
        parser.error(MISSING)
    for part in PARTS:
        file = options.folder / f"{part.name}.json"
        if not file.exists():
            continue
        rows = read_json(part.kind, file)
        for marker, text in part.tables.items():
            page = replaced(page, marker, text(rows))
        picture = f"_static/gpu_{part.name}.png"
        part.plot(rows, options.page.parent / picture)
        page = replaced(page, f"picture of {part.name}", f"![{part.caption}]({picture})")
    write_file(options.page, page.encode())


if __name__ == "__main__":
    main()
