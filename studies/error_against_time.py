"""What the thresholds and options of the operators cost and buy: error against run time.

Fills docs/error_against_time.md, its picture included (which needs matplotlib: `pip install -e ".[bench]"`), from
OUT/error_time/error_time.json. Running it is this command:

    oasis bench error-time -o out/error_time
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from oasis_warp.bench.error_time import BUDGETS, Group, SettingRow, fastest, groups
from oasis_warp.bench.rows import read_json
from oasis_warp.bench.tables import plot_operator
from studies.harness import Row, StudyOptions
from studies.tables import Section, markdown, power

FORWARD, BOTH = "forward", "forward + backward"
Groups = dict[tuple[str, str, str], Group]
"""By operator, scene and pass."""
FILES = ("error_time/error_time.json",)


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""


def run(options: Options) -> list[Row]:
    """Run the command."""
    from oasis_warp.cli import main

    main(["bench", "error-time", "-o", str(options.out / "error_time")])
    return load(options.out)


def load(out: Path) -> list[Row]:
    """The measurements of the command, in one row."""
    path = out / "error_time" / "error_time.json"
    return [{"measurements": read_json(SettingRow, path)}] if path.is_file() else []


def draw(rows: list[Row], static: Path) -> None:
    """The picture of the rasterizer."""
    found = [row for row in rows[0]["measurements"] if row.knob != "threads"]
    plot_operator(found, "rasterization", static / "error_against_time_rasterization.png", ["hand", "layered"])


def about(found: Groups) -> str:
    """Where it was measured, and times of the default settings on the hand."""
    both = {op: group.default for (op, scene, pass_), group in found.items() if (scene, pass_) == ("hand", BOTH)}
    one = {op: found[op, "hand", FORWARD].default for op in both}
    times = "; ".join(f"`{op}` {one[op].cost_ms:.2f} ms forward, {both[op].cost_ms:.2f} ms in all" for op in both)
    row = next(iter(both.values()))
    return (
        f"Times are CPU times, the least of {row.repeats} calls, taken in turns with those of all other settings, on "
        f"{row.device}, one thread\n({row.versions}, commit {row.commit}). Defaults on the hand ({row.gaussians:,} "
        f"Gaussians, {row.width} x {row.height} pixels): {times}."
    )


def settings(op: str, scene: str) -> Callable[[Groups], str]:
    """Both passes of every setting of an operator on a scene, a line a setting."""

    def text(found: Groups) -> str:
        forward, backward = found[op, scene, FORWARD], found.get((op, scene, BOTH))
        heading = ["knob", "value", FORWARD, BOTH, "rel-L2", "max", "PSNR", "gradient", "same bits"]
        lines = []
        for k, row in enumerate(forward.rows):
            if row.knob == "threads":  # they change nothing but the time to wait
                continue
            both = backward.rows[k] if backward else None
            psnr = "" if row.psnr_db is None or math.isinf(row.psnr_db) else f"{row.psnr_db:.1f}"
            lines.append([
                row.knob, "" if row.is_default else row.value, f"{row.cost_ms / forward.default.cost_ms:.2f}",
                f"{both.cost_ms / backward.default.cost_ms:.2f}" if both and backward else "",
                power(row.rel_l2), power(row.max_abs), psnr, power(both.gradient_rel_l2) if both else "",
                "yes" if (both or row).bit_equal else "no",
            ])  # fmt: skip
        return markdown(heading, lines)

    return text


def stiff(found: Groups) -> str:
    """The default setting of the rasterizer on every scene."""
    rows = {scene: g.default for (op, scene, pass_), g in found.items() if (op, pass_) == ("rasterization", BOTH)}
    heading = ["scene", "Gaussians", "size", "rel-L2", "max", "gradient", "floor", "fragile %"]
    lines = [
        [scene, f"{row.gaussians:,}", f"{row.width} x {row.height}", power(row.rel_l2), power(row.max_abs),
         power(row.gradient_rel_l2), power(row.floor_rel_l2), f"{row.fragile_percent:.2f}"]
        for scene, row in rows.items()
    ]  # fmt: skip
    return markdown(heading, lines)


def budgets(found: Groups) -> str:
    """The fastest setting within each budget."""
    lines = []
    for key, group in found.items():
        best = [fastest(group, budget) for _, budget in BUDGETS]
        cells = [
            "default" if row.is_default else f"{row.knob} {row.value}: {row.cost_ms / group.default.cost_ms:.2f}"
            for row in best
        ]
        lines.append([*key, *cells])
    return markdown(["operator", "scene", "pass", *(name for name, _ in BUDGETS)], lines)


TEXTS = {
    "about": about, "hand": settings("rasterization", "hand"), "layered": settings("rasterization", "layered"),
    "stiff": stiff, "visibility": settings("depth_visibility", "hand"),
    "face rotations": settings("face_rotations", "hand"), "mesh posing": settings("pose_on_mesh", "hand"),
    "budgets": budgets,
}  # fmt: skip


def by_group(rows: list[Row]) -> Groups:
    """The measurements by what they measure."""
    return {(group.op, group.scene, group.pass_): group for group in groups(rows[0]["measurements"])}


SECTIONS = tuple(
    Section("error_against_time.md", marker, lambda rows, text=text: text(by_group(rows)))
    for marker, text in TEXTS.items()
)
