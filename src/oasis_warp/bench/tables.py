"""Measurements as tables for people."""

import math
from collections.abc import Sequence
from typing import Any

from rich.table import Table

from oasis_warp.bench.error_time import BUDGETS, Group, SettingRow, fastest, groups
from oasis_warp.bench.gpu_speed import GpuRow
from oasis_warp.bench.roofline import KernelRow
from oasis_warp.bench.scaling import ScalingRow, steepest
from oasis_warp.bench.speed import SpeedRow


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
