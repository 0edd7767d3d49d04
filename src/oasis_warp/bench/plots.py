"""Error against time, speed, scaling and roofline as pictures. matplotlib is imported when the first is drawn."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from oasis_warp.bench.error_time import Group, SettingRow, groups, non_dominated
from oasis_warp.bench.gpu_speed import GpuRow
from oasis_warp.bench.roofline import KernelRow
from oasis_warp.bench.scaling import ScalingRow
from oasis_warp.bench.speed import SpeedRow
from oasis_warp.data.output_files import output_file

UNITS = {"gaussians": ("Gaussian", 1e6, "ns"), "pixels": ("pixel", 1e6, "ns"), "views": ("view", 1e3, "us")}
"""Of an axis: what it counts, and how milliseconds for one of them are written."""
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
        rows: Of `oasis bench error-time`.
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
