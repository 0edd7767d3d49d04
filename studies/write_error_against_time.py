"""Write docs/error_against_time.md and its pictures from what `oasis bench error-time` measured.

    oasis bench error-time -o out/error_time
    python studies/write_error_against_time.py out/error_time/error_time.csv docs/error_against_time.md

Needs matplotlib: `pip install -e ".[bench]"`.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from oasis_warp.bench.pareto import plot_operator
from oasis_warp.bench.rows import Row, read_csv
from oasis_warp.bench.summary import BUDGETS, Group, fastest, groups

TEMPLATE = """# Error against run time

What each threshold and option of the operators costs and buys, and why the defaults are what they are. Every knob is
turned alone. Errors are those against the float64 kernels with the default rules on the same float32 numbers; times are
CPU times, the least of {repeats} calls, taken in turns with those of all other settings. Written by a tool from

```sh
{commands}
```

on {device}, one thread ({versions}, commit {commit}). On another machine the times differ, the errors hardly.

*rel-L2*: largest relative error of any output; *gradient*: of any gradient of a loss with random signs. Pixels
where a decision of the rasterizer hangs on rounding (an alpha within 3e-4 of a threshold, a transmittance
within 2e-3 of the stop) are left out of both, {fragile:.2f} % of the hand's; *max* and *PSNR* are over all
pixels. *Same bits*: as with the default. Times are over that of the default, and uncertain by some 5 %. Threads
change no bit; what they gain is in [kernels](kernels.md).

## The rasterizer

The bundled hand: {gaussians:,} Gaussians at {width} x {height} pixels. By default {forward_ms:.2f} ms forward
and {backward_ms:.2f} ms forward and backward: {forward_yards:.2f} and {backward_yards:.2f} of the yardstick
(four 512 x 512 float32 matrix products and four copies of 4 MiB on one thread).

{hand}

![Error against time of the rasterizer](_static/error_against_time_rasterization.png)

A layered cloud of {layered_gaussians:,} small Gaussians at {layered_size} x {layered_size}, forty behind each
pixel, is where the thresholds matter most:

{layered}

Gradients suffer more than pictures: a layer that is left out has no gradient, and its neighbours get its share.

### Why these defaults

- **float32, not float64.** float64 takes {float64_forward:.1f} times as long forward and {float64_backward:.1f}
  times forward and backward. float32 is off by {default_rel} in the picture and {default_gradient} in
  gradients, a few roundings of float32; the exact picture is known to {floor}. Places in the image are computed
  in float64 in both.
- **exp by a polynomial of degree 5.** Degree 4 takes {exp4_time:.2f} of the time and its gradients are
  {exp4_worse:.0f} times worse; degree 3 takes {exp3_time:.2f} and they are {exp3_worse:.0f} times worse.
- **Stop at a transmittance of 1e-4.** Stopping at 1e-3 takes {stop3_time:.2f} of the time at {stop3_psnr:.0f}
  dB, at 1e-2 {stop2_time:.2f} at {stop2_psnr:.0f} dB: the Gaussian that would bring a pixel below the stop is
  not drawn, so the error is as large as the stop. Few pixels of a hand get there, so there is little to save.
- **Skip below 1/255.** A cut at 2/255 takes {cut2_time:.2f} of the time at {cut2_psnr:.0f} dB, 4/255
  {cut4_time:.2f} at {cut4_psnr:.0f} dB. Rounding a picture to 8 bits leaves 59 dB, so either costs more than that. Half
  the cut takes {cut05_time:.2f} and draws what 8 bits cannot show.
- **Extent up to where alpha falls below the cut** (at most 3.33 standard deviations): boxes that end earlier
  save time, {extent3_time:.2f} at 3 sigma, but leave edges where layers end at up to 1 % opacity:
  {extent3_psnr:.0f} dB, at 2.5 sigma {extent25_psnr:.0f} dB. The opacity-aware extent costs no error at all.
- **All three are those of gsplat**, so pictures can be compared digit by digit. `Rules` replaces them for
  measurements.
- **tile_size** changes no bit of the picture; gradients are added up in another order. 8 px take {tile8:.2f}, 32 px
  {tile32:.2f} of the time of 16 px.
- **validate** costs {validate:.0%} of a forward pass. A NaN would otherwise come out as a plausible picture: it
  stays on, and inner loops that know their inputs switch it off.
- **All Gaussians.** Dropping the least visible quarter takes {keep75:.2f} of the time at {keep75_psnr:.0f} dB;
  half the resolution, enlarged again, {half_time:.2f} at {half_psnr:.0f} dB. Both are worth it for previews
  only, and neither is a setting of the operator.

### Stiff scenes

The default on scenes that are hard to compute. *Floor*: how far the exact picture is known; torch in
float64, with the Gaussians in another order, differs from it by as much.

{stiff}

## Depth buffer and visibility

{visibility}

The resolution of the buffer decides everything: at half of it the visibility of the points is off by
{vis_half:.2f} (relative L2), because a point's pixel shows another part of the surface; float32 itself is off
by {vis_default}. So the buffer has the resolution of the photo's crop, which takes {vis_ms:.2f} ms here.

## Posing

{posing}

float64 costs {rot64:.1f} times the time in `face_rotations` and {pose64:.1f} times in `pose_on_mesh`, for
errors of {rot_default} and {pose_default} that no picture shows: float32 by default.

## For a given error

The fastest setting with one knob turned that keeps errors of values and gradients within a budget, and its time
over the default's; *exact* is no more than the default's error.

{budgets}

More of them in the table of the command itself, and every number in its CSV and JSON.
"""


def power(value: float | None) -> str:
    """An error in powers of ten."""
    return "" if value is None else f"{value:.0e}".replace("e-0", "e-").replace("e+00", "") if value else "0"


def table(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in [heading, ["---"] * len(heading), *lines])


class Measured:
    """The rows of a CSV, by what they measure."""

    def __init__(self, rows: list[Row]):
        self.groups = {(g.op, g.scene, g.pass_): g for g in groups(rows)}

    def group(self, op: str, scene: str = "hand", pass_: str = "forward") -> Group:
        """All settings of an operator on a scene."""
        return self.groups[op, scene, pass_]

    def row(self, knob: str, value: str, op: str = "rasterization", pass_: str = "forward") -> Row:
        """One setting on the hand."""
        return next(r for r in self.group(op, pass_=pass_).rows if (r.knob, r.value) == (knob, value))

    def time(self, knob: str, value: str, op: str = "rasterization", pass_: str = "forward") -> float:
        """Its time over the default's."""
        return self.row(knob, value, op, pass_).cost_ms / self.group(op, pass_=pass_).default.cost_ms

    def settings(self, op: str, scene: str) -> str:
        """Both passes of every setting of an operator on a scene, a line a setting."""
        forward, backward = self.group(op, scene), self.groups.get((op, scene, "forward + backward"))
        heading = ["knob", "value", "forward", "forward + backward", "rel-L2", "max", "PSNR", "gradient", "same bits"]
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
        return table(heading, lines)

    def stiff(self) -> str:
        """The default setting of the rasterizer on every scene."""
        heading = ["scene", "Gaussians", "size", "rel-L2", "max", "gradient", "floor", "fragile %"]
        lines = []
        for (op, scene, pass_), group in self.groups.items():
            if op == "rasterization" and pass_ != "forward":
                row = group.default
                lines.append([
                    scene, f"{row.gaussians:,}", f"{row.width} x {row.height}", power(row.rel_l2), power(row.max_abs),
                    power(row.gradient_rel_l2), power(row.floor_rel_l2), f"{row.fragile_percent:.2f}",
                ])  # fmt: skip
        return table(heading, lines)

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
        return table(["operator", "scene", "pass", *(name for name, _ in BUDGETS)], lines)


def words(m: Measured) -> dict[str, object]:
    """What the template asks for."""
    forward, backward = (m.group("rasterization", pass_=p).default for p in ("forward", "forward + backward"))
    layered = m.group("rasterization", "layered").default
    both = "forward + backward"
    exact_gradient = backward.gradient_rel_l2 or math.nan

    def worse(value: str) -> float:
        return (m.row("exp degree", value, pass_=both).gradient_rel_l2 or math.nan) / exact_gradient

    def psnr(knob: str, value: str) -> float:
        return m.row(knob, value).psnr_db or math.inf

    rotations, posed, seen = (m.group(op).default for op in ("face_rotations", "pose_on_mesh", "depth_visibility"))
    return {
        "repeats": forward.repeats, "device": forward.device, "versions": forward.versions, "commit": forward.commit,
        "fragile": forward.fragile_percent, "gaussians": forward.gaussians, "width": forward.width,
        "height": forward.height, "forward_ms": forward.cost_ms, "backward_ms": backward.cost_ms,
        "forward_yards": forward.cost_ms / forward.yardstick_ms,
        "backward_yards": backward.cost_ms / backward.yardstick_ms,
        "hand": m.settings("rasterization", "hand"), "layered": m.settings("rasterization", "layered"),
        "layered_gaussians": layered.gaussians, "layered_size": layered.width,
        "float64_forward": m.time("precision", "float64"),
        "float64_backward": m.time("precision", "float64", pass_=both),
        "default_rel": power(forward.rel_l2), "default_gradient": power(exact_gradient),
        "floor": power(forward.floor_rel_l2),
        "exp4_time": m.time("exp degree", "4", pass_=both), "exp4_worse": worse("4"),
        "exp3_time": m.time("exp degree", "3", pass_=both), "exp3_worse": worse("3"),
        "stop3_time": m.time("stop", "0.001", pass_=both), "stop3_psnr": psnr("stop", "0.001"),
        "stop2_time": m.time("stop", "0.01", pass_=both), "stop2_psnr": psnr("stop", "0.01"),
        "cut2_time": m.time("alpha cut", "2/255", pass_=both), "cut2_psnr": psnr("alpha cut", "2/255"),
        "cut4_time": m.time("alpha cut", "4/255", pass_=both), "cut4_psnr": psnr("alpha cut", "4/255"),
        "cut05_time": m.time("alpha cut", "0.5/255", pass_=both),
        "extent3_time": m.time("extent", "3 sigma", pass_=both), "extent3_psnr": psnr("extent", "3 sigma"),
        "extent25_psnr": psnr("extent", "2.5 sigma"),
        "tile8": m.time("tile", "8 px", pass_=both), "tile32": m.time("tile", "32 px", pass_=both),
        "validate": 1 - m.time("validate", "False"),
        "keep75": m.time("Gaussians", "75%", pass_=both), "keep75_psnr": psnr("Gaussians", "75%"),
        "half_time": m.time("resolution", "1/2"), "half_psnr": psnr("resolution", "1/2"),
        "stiff": m.stiff(),
        "visibility": m.settings("depth_visibility", "hand"),
        "vis_half": m.row("resolution", "1/2", "depth_visibility").rel_l2, "vis_default": power(seen.rel_l2),
        "vis_ms": seen.cost_ms,
        "posing": "\n\n".join(f"`{op}`\n\n{m.settings(op, 'hand')}" for op in ("face_rotations", "pose_on_mesh")),
        "rot64": m.time("precision", "float64", "face_rotations"),
        "pose64": m.time("precision", "float64", "pose_on_mesh"),
        "rot_default": power(rotations.rel_l2), "pose_default": power(posed.rel_l2),
        "budgets": m.budgets(),
    }  # fmt: skip


def main() -> None:
    """Read the table, write the page and its picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("csv", type=Path, help="error_time.csv of a full run")
    parser.add_argument("page", type=Path)
    options = parser.parse_args()
    rows = read_csv(options.csv)
    commands = [line.strip() for line in (__doc__ or "").splitlines() if line.startswith("    ")]
    options.page.write_text(TEMPLATE.format(commands="\n".join(commands), **words(Measured(rows))))
    picture = options.page.parent / "_static" / "error_against_time_rasterization.png"
    plot_operator([row for row in rows if row.knob != "threads"], "rasterization", picture, ["hand", "layered"])


if __name__ == "__main__":
    main()
