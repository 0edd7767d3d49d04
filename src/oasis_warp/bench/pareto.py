"""Draw error against time, a panel for each scene and pass of an operator."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from oasis_warp.bench.rows import Row
from oasis_warp.bench.summary import Group, groups, non_dominated
from oasis_warp.data.output_files import output_file

WORDS = {"forward": "error of values", "forward + backward": "error of values and gradients"}
MISSING = "matplotlib is not installed, so no pictures are drawn; `pip install 'oasis-warp[bench]'` brings it."


def can_plot() -> bool:
    """Whether matplotlib is there."""
    return find_spec("matplotlib") is not None


def plot_operator(rows: Sequence[Row], op: str, path: Path, scenes: Sequence[str] | None = None) -> None:
    """Write a picture: time to the right, error upwards, both logarithmic; one colour a knob.

    The default is ringed, settings that no other beats in both are joined, and the dashed line is how far the exact
    results are known: smaller errors are drawn on it. Time is `Row.cost_ms`.

    Args:
        rows: Of `oasis bench error-time`.
        op: The operator to draw.
        path: The picture to write; its suffix says the format.
        scenes: Those to draw; all when None.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    shown = [g for g in groups(rows) if g.op == op and (scenes is None or g.scene in scenes)]
    names = list(dict.fromkeys(g.scene for g in shown))
    passes = list(dict.fromkeys(g.pass_ for g in shown))
    knobs = list(dict.fromkeys(row.knob for g in shown for row in g.rows if not row.is_default))
    colors = {knob: colormaps["tab20"](k) for k, knob in enumerate(knobs)}
    figure = Figure(figsize=(4.4 * len(passes) + 1.8, 3.2 * len(names) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(names), len(passes), squeeze=False)
    for group in shown:
        draw_panel(axes[names.index(group.scene)][passes.index(group.pass_)], group, colors)
    marks = [Line2D([], [], color=colors[knob], marker="o", linestyle="", label=knob) for knob in knobs]
    ring = Line2D([], [], color="black", marker="o", markersize=10, fillstyle="none", linestyle="", label="default")
    figure.legend(handles=[ring, *marks], loc="outside right upper", frameon=False)
    figure.suptitle(op)
    with output_file(path) as part:
        figure.savefig(part, dpi=110)


def draw_panel(axes: Any, group: Group, colors: dict[str, Any]) -> None:
    """One operator on one scene in one pass, on matplotlib's `axes`."""
    from matplotlib.ticker import LogLocator

    floor = max(group.default.floor_rel_l2, torch.finfo(torch.float64).eps)

    def place(row: Row) -> tuple[float, float]:
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
    axes.set_ylabel(WORDS[group.pass_], fontsize=8)
    axes.tick_params(which="both", labelsize=7)
