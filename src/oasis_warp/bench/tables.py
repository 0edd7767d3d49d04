"""Measurements for people: tables of all, and error against time, speed, scaling and roofline as pictures.

matplotlib is imported when the first picture is drawn.
"""

import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from oasis_warp.bench.error_time import BUDGETS, Group, SettingRow, fastest, groups, non_dominated
from oasis_warp.bench.roofline import KernelRow
from oasis_warp.bench.scaling import ScalingRow, steepest
from oasis_warp.bench.speed import GpuRow, SpeedRow
from oasis_warp.data.output_files import output_file


def number(value: float | None, digits: int = 1) -> str:
    """An error in powers of ten."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}e}" if value else "0"


def new_table(
    left: Sequence[str], right: Sequence[str] = (), title: str | None = None, wrap: bool = False
) -> Table:
    """An empty table with columns of words, aligned left, which may `wrap`, and of numbers, aligned right."""
    table = Table(title=title, title_justify="left")
    for heading in left:
        table.add_column(heading, no_wrap=bool(right) and not wrap)
    for heading in right:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def ends_section(rows: Sequence[Any], k: int, *names: str) -> bool:
    """Whether row k is the last of those with the same values of `names`."""
    return k + 1 == len(rows) or any(getattr(rows[k], name) != getattr(rows[k + 1], name) for name in names)


def setting_table(group: Group) -> Table:
    """All settings of an operator on a scene in one pass."""
    table = new_table(
        ("knob", "value"),
        ("ms", "quartiles", "fastest", "CPU", "MiB", "rel-L2", "max", "PSNR", "gradient", "same bits"),
        f"{group.op} on {group.scene}, {group.pass_}",
    )
    for row in group.rows:
        psnr = "" if row.psnr_db is None or not math.isfinite(row.psnr_db) else f"{row.psnr_db:.1f}"
        table.add_row(
            row.knob, row.value if not row.is_default else "", f"{row.median_ms:.2f}", f"{row.iqr_ms:.2f}",
            f"{row.fastest_ms:.2f}", "" if row.cpu_ms is None else f"{row.cpu_ms:.2f}",
            "" if row.peak_mb is None else f"{row.peak_mb:.1f}", number(row.rel_l2),
            number(row.max_abs), psnr, number(row.gradient_rel_l2), "yes" if row.bit_equal else "no",
        )  # fmt: skip
    return table


def budget_table(rows: Sequence[SettingRow]) -> Table:
    """The fastest setting of each operator for each error budget, and its time over the default's."""
    headings = ("operator", "scene", "pass", *(name for name, _ in BUDGETS))
    table = new_table(headings, title="Fastest single knob within an error budget")
    for group in groups(rows):
        cells = []
        for _, budget in BUDGETS:
            best = fastest(group, budget)
            ratio = best.cost_ms / group.default.cost_ms
            cells.append("default" if best.is_default else f"{best.knob} {best.value}, {ratio:.2f}x")
        table.add_row(group.op, group.scene, group.pass_, *cells)
    return table


def speed_table(rows: Sequence[SpeedRow]) -> Table:
    """Times, ratios and errors of every backend of every operator."""
    table = new_table(
        ("operator", "pass", "way"),
        ("ms", "quartiles", "fastest", "CPU", "/ yardstick", "/ warp", "MiB", "rel-L2", "gradient"),
    )
    for k, row in enumerate(rows):
        table.add_row(
            row.op, row.pass_, row.way, f"{row.median_ms:.2f}", f"{row.iqr_ms:.2f}", f"{row.fastest_ms:.2f}",
            "" if row.cpu_ms is None else f"{row.cpu_ms:.2f}", f"{row.over_yardstick:.3f}", f"{row.over_warp:.1f}",
            "" if row.peak_mb is None else f"{row.peak_mb:.1f}",
            number(row.rel_l2), number(row.gradient_rel_l2), end_section=ends_section(rows, k, "op"),
        )  # fmt: skip
    return table


def cell(value: float | None, form: str = ".3g") -> str:
    """A number, or nothing where there is none."""
    return "" if value is None else format(value, form)


def gpu_table(rows: Sequence[GpuRow]) -> Table:
    """Times on both clocks and errors of every implementation of every case."""
    right = (
        "wall ms", "quartiles", "a second", "GPU ms", "quartiles", "launched", "kernels ms", "kernels", "MiB", "max",
        "99.99 %", "rel-L2", "gradient", "same bits",
    )  # fmt: skip
    table = new_table(("case", "pass", "way"), right, wrap=True)
    for k, row in enumerate(rows):
        table.add_row(
            row.case, row.pass_, row.way, cell(row.wall_ms), cell(row.wall_iqr_ms, ".2g"),
            f"{1e3 * row.views / row.wall_ms:,.0f}", cell(row.busy_ms), cell(row.busy_iqr_ms, ".2g"),
            cell(row.launch_ms), cell(row.kernels_ms), cell(row.kernels, ".0f"), cell(row.peak_mb, ".1f"),
            number(row.max_abs), number(row.most_abs), number(row.rel_l2), number(row.gradient_rel_l2),
            "yes" if row.bit_equal else "no", end_section=ends_section(rows, k, "case"),
        )  # fmt: skip
    return table


def scaling_table(rows: Sequence[ScalingRow]) -> Table:
    """Every point of the study."""
    table = new_table(
        ("axis", "scene", "size", "views", "pass"),
        ("pairs", "longest", "wall ms", "GPU ms", "MiB", "finite", "overflow", "compared", "max", "99.99 %"),
    )
    for k, row in enumerate(rows):
        table.add_row(
            row.axis, row.scene, f"{row.width} x {row.height}", str(row.views), row.pass_, f"{row.pairs:,}",
            f"{row.longest:,}", cell(row.wall_ms), cell(row.busy_ms), cell(row.peak_mb, ".1f"),
            "yes" if row.finite else "NO", "" if row.overflow is None else "YES" if row.overflow else "no",
            row.checked, number(row.max_abs), number(row.most_abs), end_section=ends_section(rows, k, "axis", "series"),
        )  # fmt: skip
    return table


def growth_table(rows: Sequence[ScalingRow]) -> Table:
    """The steepest step along every line of the study."""
    headings = ("axis", "of", "pass", "ratio", "between")
    table = new_table(headings, title="Largest growth of time over growth of work")
    for step in steepest(rows):
        table.add_row(
            step.axis, step.series, step.pass_, f"{step.ratio:.2f}{' (cliff)' if step.cliff else ''}",
            f"{step.before:,} and {step.after:,}",
        )  # fmt: skip
    return table


def roofline_table(rows: Sequence[KernelRow]) -> Table:
    """Every kernel's time, what it moved and did, and its share of the nearer ceiling."""
    ceilings = f"{rows[0].ceiling_gb_s:,.0f} GB/s, {rows[0].ceiling_gflop_s:,.0f} GFLOP/s"
    right = ("launches", "us", "MB", "GB/s", "MFLOP", "GFLOP/s", "floor us", "share", "of")
    table = new_table(("case", "kernel"), right, f"Ceilings measured: {ceilings}", wrap=True)
    for k, row in enumerate(rows):
        table.add_row(
            row.case, row.kernel, f"{row.launches:g}", f"{row.us:.2f}",
            "" if row.bytes is None else f"{1e-6 * row.bytes:.2f}", cell(row.gb_s, ",.0f"),
            "" if row.flops is None else f"{1e-6 * row.flops:.1f}", cell(row.gflop_s, ",.0f"),
            cell(row.floor_us, ".2f"), cell(row.share, ".0%"), row.bound, end_section=ends_section(rows, k, "case"),
        )  # fmt: skip
    return table


UNITS = {"gaussians": ("Gaussian", 1e6, "ns"), "pixels": ("pixel", 1e6, "ns"), "views": ("view", 1e3, "us")}
"""What each axis counts, and how milliseconds for one of them are written."""
MARKS = {"forward": "o", "forward + backward": "s"}
DPI = 110
ERROR_LABELS = {"forward": "error of values", "forward + backward": "error of values and gradients"}
MISSING = "matplotlib is not installed, so no pictures are drawn; `pip install 'oasis-warp[bench]'` brings it."


def can_plot() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def new_figure(width: float, height: float) -> Any:
    """An empty picture of so many inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, path: Path) -> None:
    """Write a picture, whole or not at all; the suffix says the format."""
    with output_file(path) as part:
        figure.savefig(part, dpi=DPI)


def plot_operator(rows: Sequence[SettingRow], op: str, path: Path, scenes: Sequence[str] | None = None) -> None:
    """Write a picture: time to the right, error upwards, both logarithmic; one colour a knob.

    The default is ringed, settings that no other beats in both are joined, and the dashed line is how far the exact
    results are known: smaller errors are drawn on it. Time is `SettingRow.cost_ms`.

    Args:
        rows: Rows of `oasis bench error-time`.
        op: The operator to draw.
        path: The picture to write; its suffix says the format.
        scenes: Those to draw; all when None.
    """
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    shown = [g for g in groups(rows) if g.op == op and (scenes is None or g.scene in scenes)]
    names = list(dict.fromkeys(g.scene for g in shown))
    passes = list(dict.fromkeys(g.pass_ for g in shown))
    knobs = list(dict.fromkeys(row.knob for g in shown for row in g.rows if not row.is_default))
    colors = {knob: colormaps["tab20"](k) for k, knob in enumerate(knobs)}
    figure = new_figure(4.4 * len(passes) + 1.8, 3.2 * len(names) + 0.4)
    axes = figure.subplots(len(names), len(passes), squeeze=False)
    for group in shown:
        draw_panel(axes[names.index(group.scene)][passes.index(group.pass_)], group, colors)
    marks = [Line2D([], [], color=colors[knob], marker="o", linestyle="", label=knob) for knob in knobs]
    ring = Line2D([], [], color="black", marker="o", markersize=10, fillstyle="none", linestyle="", label="default")
    figure.legend(handles=[ring, *marks], loc="outside right upper", frameon=False)
    figure.suptitle(op)
    save(figure, path)


def draw_panel(axes: Any, group: Group, colors: dict[str, Any]) -> None:
    """One operator on one scene in one pass, on matplotlib's `axes`."""
    from matplotlib.ticker import LogLocator

    floor = max(group.default.floor_rel_l2, torch.finfo(torch.float64).eps)

    def place(row: SettingRow) -> tuple[float, float]:
        return row.cost_ms, max(row.error, floor)

    compared = [row for row in group.rows if group.pass_ == "forward" or row.gradient_rel_l2 is not None]
    for row in compared:
        if row.is_default:
            axes.plot(*place(row), "o", color="black", markersize=4)
            axes.plot(*place(row), "o", color="black", markersize=11, fillstyle="none")
            continue
        axes.plot(*place(row), "o", color=colors[row.knob], markersize=5)
        if row.error != group.default.error:  # those that change nothing but time crowd round the default
            axes.annotate(
                row.value, place(row), xytext=(4, 3), textcoords="offset points", fontsize=6, color=colors[row.knob]
            )
    best = [place(row) for row in non_dominated(compared)]
    axes.plot(*zip(*best, strict=True), color="0.6", linewidth=1, zorder=0)
    axes.axhline(floor, color="0.4", linestyle="--", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set_title(f"{group.scene}, {group.pass_}", fontsize=9)
    axes.set_xlabel("time [ms]", fontsize=8)
    axes.set_ylabel(ERROR_LABELS[group.pass_], fontsize=8)
    axes.tick_params(which="both", labelsize=7)


def plot_speed(rows: Sequence[GpuRow] | Sequence[SpeedRow], path: Path) -> None:
    """Bars of milliseconds, a group for each case and a bar for each way and clock."""
    bars: dict[str, dict[str, float]] = {}
    for row in rows:
        if isinstance(row, GpuRow):
            label = f"{row.case}\n{row.pass_}"
            busy = row.kernels_ms if row.busy_ms is None else row.busy_ms
            found = {f"{row.way}, wall": row.wall_ms} | ({} if busy is None else {f"{row.way}, GPU": busy})
        else:
            label, found = f"{row.op}\n{row.pass_}", {row.way: row.median_ms}
        bars.setdefault(label, {}).update(found)
    series = list(dict.fromkeys(name for group in bars.values() for name in group))
    figure = new_figure(9.0, 0.6 + 0.22 * len(bars) * (len(series) + 1))
    axes = figure.subplots()
    thick = 1 / (len(series) + 1)
    for k, name in enumerate(series):
        places = [(g + (k - (len(series) - 1) / 2) * thick, v[name]) for g, v in enumerate(bars.values()) if name in v]
        drawn = axes.barh([y for y, _ in places], [ms for _, ms in places], thick, label=name, color=f"C{k}")
        axes.bar_label(drawn, [f" {ms:.3g}" for _, ms in places], fontsize=6)
    axes.set_yticks(range(len(bars)), list(bars), fontsize=7)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("time of a call [ms]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=len(series), fontsize=8, frameon=False)
    save(figure, path)


def plot_scaling(rows: Sequence[ScalingRow], path: Path) -> None:
    """A column an axis: the time for one Gaussian, pixel or view above, memory below; lines that rise are cliffs."""
    from matplotlib.ticker import LogLocator

    axes_shown = [axis for axis in UNITS if any(row.axis == axis for row in rows)]
    figure = new_figure(4.6 * len(axes_shown), 7.0)
    panels = figure.subplots(2, len(axes_shown), squeeze=False)
    for column, axis in enumerate(axes_shown):
        noun, scale, unit = UNITS[axis]
        above, below = panels[0][column], panels[1][column]
        lines: dict[tuple[str, str], list[ScalingRow]] = {}
        for row in rows:
            if row.axis == axis:
                lines.setdefault((row.series, row.pass_), []).append(row)
        for k, ((series, pass_), line) in enumerate(lines.items()):
            line = sorted(line, key=lambda row: row.amount)
            amounts, label = [row.amount for row in line], f"{series}, {pass_}"
            style = {"color": f"C{k}", "marker": MARKS[pass_], "markersize": 4}
            above.plot(amounts, [scale * row.wall_ms / row.amount for row in line], label=f"{label}, wall", **style)
            busy = [(row.amount, scale * row.busy_ms / row.amount) for row in line if row.busy_ms is not None]
            if busy:
                above.plot(*zip(*busy, strict=True), linestyle="--", label=f"{label}, GPU", **style)
            held = [(row.amount, row.peak_mb) for row in line if row.peak_mb]
            if held:
                below.plot(*zip(*held, strict=True), label=label, **style)
        above.set_ylabel(f"time [{unit} a {noun}]")
        below.set_ylabel("memory of a call [MiB]")
        below.set_xlabel(f"{noun}s")
        amounts = sorted({row.amount for row in rows if row.axis == axis})
        for panel in (above, below):
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_xticks(amounts, [amount_name(axis, amount) for amount in amounts])
            panel.set_xticks([], minor=True)
            panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter("")
            panel.grid(True, which="major", color="0.9")
            panel.tick_params(labelsize=7)
        above.legend(fontsize=6, frameon=False)
    save(figure, path)


def amount_name(axis: str, amount: int) -> str:
    """What stands at an amount on an axis."""
    if axis == "pixels":
        return f"{amount**0.5:.0f}²"
    for suffix, size in (("M", 10**6), ("k", 10**3)):
        if amount >= size:
            return f"{amount / size:.3g}{suffix}"
    return str(amount)


def plot_roofline(rows: Sequence[KernelRow], path: Path) -> None:
    """Operations a second against operations a byte, below the ceilings; a colour a case."""
    known = [row for row in rows if row.flops and row.bytes and row.gflop_s]
    figure = new_figure(8.0, 5.0)
    axes = figure.subplots()
    gb_s, gflop_s = rows[0].ceiling_gb_s, rows[0].ceiling_gflop_s
    intensities = [row.flops / row.bytes for row in known if row.flops and row.bytes]
    ends = [min([0.1, *intensities]) / 2, max([2 * gflop_s / gb_s, *intensities]) * 2]
    corners = [ends[0], gflop_s / gb_s, ends[1]]
    axes.plot(corners, [min(gflop_s, x * gb_s) for x in corners], color="0.3", linewidth=1.5)
    foot = corners[0], corners[0] * gb_s
    axes.annotate(f"{gb_s:,.0f} GB/s", foot, xytext=(0, 14), textcoords="offset points", fontsize=8)
    axes.annotate(f"{gflop_s:,.0f} GFLOP/s", (corners[1], gflop_s), fontsize=8, ha="left", va="bottom")
    for k, case in enumerate(dict.fromkeys(row.case for row in known)):
        for row in known:
            if row.case == case and row.flops and row.bytes and row.gflop_s:
                place = row.flops / row.bytes, row.gflop_s
                axes.plot(*place, "o", color=f"C{k}", markersize=3 + row.us**0.5 / 2)
                axes.annotate(row.kernel, place, xytext=(5, 3), textcoords="offset points", fontsize=7, color=f"C{k}")
        axes.plot([], [], "o", color=f"C{k}", label=case)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("operations a byte")
    axes.set_ylabel("GFLOP/s")
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    save(figure, path)
