"""Measurements as tables for people."""

import math
from collections.abc import Sequence

from rich.table import Table

from oasis_warp.bench.rows import Row
from oasis_warp.bench.speed import SpeedRow
from oasis_warp.bench.summary import BUDGETS, Group, fastest, groups


def number(value: float | None, digits: int = 1) -> str:
    """An error in powers of ten."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}e}" if value else "0"


def setting_table(group: Group) -> Table:
    """All settings of an operator on a scene in one pass."""
    table = Table(title=f"{group.op} on {group.scene}, {group.pass_}", title_justify="left")
    for heading in ("knob", "value"):
        table.add_column(heading, no_wrap=True)
    for heading in ("ms", "quartiles", "fastest", "CPU", "MiB", "rel-L2", "max", "PSNR", "gradient", "same bits"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in group.rows:
        psnr = "" if row.psnr_db is None or not math.isfinite(row.psnr_db) else f"{row.psnr_db:.1f}"
        table.add_row(
            row.knob, row.value if not row.is_default else "", f"{row.median_ms:.2f}", f"{row.iqr_ms:.2f}",
            f"{row.fastest_ms:.2f}", "" if row.cpu_ms is None else f"{row.cpu_ms:.2f}",
            "" if row.peak_mb is None else f"{row.peak_mb:.1f}", number(row.rel_l2),
            number(row.max_abs), psnr, number(row.gradient_rel_l2), "yes" if row.bit_equal else "no",
        )  # fmt: skip
    return table


def budget_table(rows: Sequence[Row]) -> Table:
    """The fastest setting of each operator for each error budget, and its time over the default's."""
    table = Table(title="Fastest single knob within an error budget", title_justify="left")
    for heading in ("operator", "scene", "pass", *(name for name, _ in BUDGETS)):
        table.add_column(heading)
    for group in groups(rows):
        cells = []
        for _, budget in BUDGETS:
            best = fastest(group, budget)
            ratio = best.cost_ms / group.default.cost_ms
            cells.append("default" if best.is_default else f"{best.knob} {best.value}, {ratio:.2f}x")
        table.add_row(group.op, group.scene, group.pass_, *cells)
    return table


def speed_table(rows: Sequence[SpeedRow]) -> Table:
    """Times, ratios and errors of every way to compute every operator."""
    table = Table(title_justify="left")
    for heading in ("operator", "pass", "way"):
        table.add_column(heading, no_wrap=True)
    for heading in ("ms", "quartiles", "fastest", "CPU", "/ yardstick", "/ warp", "MiB", "rel-L2", "gradient"):
        table.add_column(heading, justify="right", no_wrap=True)
    for k, row in enumerate(rows):
        last = k + 1 == len(rows) or rows[k + 1].op != row.op
        table.add_row(
            row.op, row.pass_, row.way, f"{row.median_ms:.2f}", f"{row.iqr_ms:.2f}", f"{row.fastest_ms:.2f}",
            "" if row.cpu_ms is None else f"{row.cpu_ms:.2f}", f"{row.over_yardstick:.3f}", f"{row.over_warp:.1f}",
            "" if row.peak_mb is None else f"{row.peak_mb:.1f}",
            number(row.rel_l2), number(row.gradient_rel_l2), end_section=last,
        )  # fmt: skip
    return table
