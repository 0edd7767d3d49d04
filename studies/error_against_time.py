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
from oasis_warp.bench.plots import plot_operator
from oasis_warp.bench.rows import read_json
from studies.harness import Row, StudyOptions
from studies.tables import Section, markdown, power

FORWARD, BOTH = "forward", "forward + backward"


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


class Measured:
    """Rows by what they measure."""

    def __init__(self, rows: list[SettingRow]):
        self.groups = {(g.op, g.scene, g.pass_): g for g in groups(rows)}

    def group(self, op: str, scene: str = "hand", pass_: str = FORWARD) -> Group:
        """All settings of an operator on a scene."""
        return self.groups[op, scene, pass_]

    def row(self, knob: str, value: str, op: str = "rasterization", pass_: str = FORWARD) -> SettingRow:
        """One setting on the hand."""
        return next(r for r in self.group(op, pass_=pass_).rows if (r.knob, r.value) == (knob, value))

    def time(self, knob: str, value: str, op: str = "rasterization", pass_: str = FORWARD) -> float:
        """Its time over the default's."""
        return self.row(knob, value, op, pass_).cost_ms / self.group(op, pass_=pass_).default.cost_ms

    def settings(self, op: str, scene: str) -> str:
        """Both passes of every setting of an operator on a scene, a line a setting."""
        forward, backward = self.group(op, scene), self.groups.get((op, scene, BOTH))
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

    def stiff(self) -> str:
        """The default setting of the rasterizer on every scene."""
        heading = ["scene", "Gaussians", "size", "rel-L2", "max", "gradient", "floor", "fragile %"]
        lines = []
        for (op, scene, pass_), group in self.groups.items():
            if op == "rasterization" and pass_ != FORWARD:
                row = group.default
                lines.append([
                    scene, f"{row.gaussians:,}", f"{row.width} x {row.height}", power(row.rel_l2), power(row.max_abs),
                    power(row.gradient_rel_l2), power(row.floor_rel_l2), f"{row.fragile_percent:.2f}",
                ])  # fmt: skip
        return markdown(heading, lines)

    def budgets(self) -> str:
        """The fastest setting within each budget."""
        lines = []
        for (op, scene, pass_), group in self.groups.items():
            cells = []
            for _, budget in BUDGETS:
                best = fastest(group, budget)
                ratio = f"{best.cost_ms / group.default.cost_ms:.2f}"
                cells.append("default" if best.is_default else f"{best.knob} {best.value}: {ratio}")
            lines.append([op, scene, pass_, *cells])
        return markdown(["operator", "scene", "pass", *(name for name, _ in BUDGETS)], lines)


def about(m: Measured) -> str:
    """Where it was measured."""
    row = m.group("rasterization").default
    return (
        f"Times are CPU times, the least of {row.repeats} calls, taken in turns with those of all other settings, on "
        f"{row.device}, one thread\n({row.versions}, commit {row.commit}); {row.fragile_percent:.2f} % of the hand's "
        "pixels are left out of *rel-L2* and *gradient*."
    )


def hand(m: Measured) -> str:
    """The rasterizer on the hand."""
    forward, both = (m.group("rasterization", pass_=name).default for name in (FORWARD, BOTH))
    yards = [row.cost_ms / row.yardstick_ms for row in (forward, both)]
    return (
        f"The bundled hand: {forward.gaussians:,} Gaussians at {forward.width} x {forward.height} pixels. By default "
        f"{forward.cost_ms:.2f} ms forward\nand {both.cost_ms:.2f} ms forward and backward: {yards[0]:.2f} and "
        f"{yards[1]:.2f} of the yardstick\n(four 512 x 512 float32 matrix products and four copies of 4 MiB on one "
        f"thread).\n\n{m.settings('rasterization', 'hand')}"
    )


def layered(m: Measured) -> str:
    """The rasterizer on layers."""
    row = m.group("rasterization", "layered").default
    return (
        f"A layered cloud of {row.gaussians:,} small Gaussians at {row.width} x {row.width}, forty behind each\npixel, "
        f"is where the thresholds matter most:\n\n{m.settings('rasterization', 'layered')}"
    )


def defaults(m: Measured) -> str:
    """Why the defaults are what they are."""
    forward, both = (m.group("rasterization", pass_=name).default for name in (FORWARD, BOTH))
    gradient = both.gradient_rel_l2 or math.nan

    def time(knob: str, value: str, pass_: str = BOTH) -> str:
        return f"{m.time(knob, value, pass_=pass_):.2f}"

    def psnr(knob: str, value: str) -> str:
        return f"{m.row(knob, value).psnr_db or math.inf:.0f}"

    def worse(degree: str) -> str:
        return f"{(m.row('exp degree', degree, pass_=BOTH).gradient_rel_l2 or math.nan) / gradient:.0f}"

    f64 = [m.time("precision", "float64", pass_=name) for name in (FORWARD, BOTH)]
    return f"""- **float32, not float64.** float64 takes {f64[0]:.1f} times as long forward and {f64[1]:.1f}
  times forward and backward. float32 is off by {power(forward.rel_l2)} in the picture and {power(gradient)} in
  gradients, a few roundings of float32; the exact picture is known to {power(forward.floor_rel_l2)}. Places in the image are computed
  in float64 in both.
- **exp by a polynomial of degree 5.** Degree 4 takes {time("exp degree", "4")} of the time and its gradients are
  {worse("4")} times worse; degree 3 takes {time("exp degree", "3")} and they are {worse("3")} times worse.
- **Stop at a transmittance of 1e-4.** Stopping at 1e-3 takes {time("stop", "0.001")} of the time at {psnr("stop", "0.001")}
  dB, at 1e-2 {time("stop", "0.01")} at {psnr("stop", "0.01")} dB: the Gaussian that would bring a pixel below the stop is
  not drawn, so the error is as large as the stop. Few pixels of a hand get there, so there is little to save.
- **Skip below 1/255.** A cut at 2/255 takes {time("alpha cut", "2/255")} of the time at {psnr("alpha cut", "2/255")} dB, 4/255
  {time("alpha cut", "4/255")} at {psnr("alpha cut", "4/255")} dB. Rounding a picture to 8 bits leaves 59 dB, so either costs more than that. Half
  the cut takes {time("alpha cut", "0.5/255")} and draws what 8 bits cannot show.
- **Extent up to where alpha falls below the cut** (at most 3.33 standard deviations): boxes that end earlier
  save time, {time("extent", "3 sigma")} at 3 sigma, but leave edges where layers end at up to 1 % opacity:
  {psnr("extent", "3 sigma")} dB, at 2.5 sigma {psnr("extent", "2.5 sigma")} dB. The opacity-aware extent costs no error at all.
- **All three are those of gsplat**, so pictures can be compared digit by digit. `Rules` replaces them for
  measurements.
- **tile_size** changes no bit of the picture; gradients are added up in another order. 8 px take {time("tile", "8 px")}, 32 px
  {time("tile", "32 px")} of the time of 16 px.
- **validate** costs {1 - m.time("validate", "False"):.0%} of a forward pass. A NaN would otherwise come out as a plausible picture: it
  stays on, and inner loops that know their inputs switch it off.
- **All Gaussians.** Dropping the least visible quarter takes {time("Gaussians", "75%")} of the time at {psnr("Gaussians", "75%")} dB;
  half the resolution, enlarged again, {time("resolution", "1/2", FORWARD)} at {psnr("resolution", "1/2")} dB. Both are worth it for previews
  only, and neither is a setting of the operator."""  # noqa: E501


def visibility(m: Measured) -> str:
    """The depth buffer."""
    default, half = m.group("depth_visibility").default, m.row("resolution", "1/2", "depth_visibility")
    return (
        f"{m.settings('depth_visibility', 'hand')}\n\nThe resolution of the buffer decides everything: at half of it "
        f"the visibility of the points is off by\n{half.rel_l2:.2f} (relative L2), because a point's pixel shows "
        f"another part of the surface; float32 itself is off\nby {power(default.rel_l2)}. So the buffer has the "
        f"resolution of the photo's crop, which takes {default.cost_ms:.2f} ms here."
    )


def posing(m: Measured) -> str:
    """Rotations of faces, and Gaussians on the mesh."""
    operators = ("face_rotations", "pose_on_mesh")
    tables = [f"`{op}`\n\n{m.settings(op, 'hand')}" for op in operators]
    times = [f"{m.time('precision', 'float64', op):.1f}" for op in operators]
    errors = [power(m.group(op).default.rel_l2) for op in operators]
    words = (
        f"float64 costs {times[0]} times the time in `face_rotations` and {times[1]} times in `pose_on_mesh`, for\n"
        f"errors of {errors[0]} and {errors[1]} that no picture shows: float32 by default."
    )
    return "\n\n".join([*tables, words])


def _section(marker: str, text: Callable[[Measured], str]) -> Section:
    return Section("error_against_time.md", marker, lambda rows: text(Measured(rows[0]["measurements"])))


SECTIONS = (
    _section("about", about), _section("hand", hand), _section("layered", layered), _section("defaults", defaults),
    _section("stiff", Measured.stiff), _section("visibility", visibility), _section("posing", posing),
    _section("budgets", Measured.budgets),
)  # fmt: skip
