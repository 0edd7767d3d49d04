"""Put the table of `oasis bench kernels` into docs/kernels.md, between its two markers.

Three commands, the first two measure:

    oasis bench kernels --json out/speed_1.json
    oasis bench kernels --threads 2 --json out/speed_2.json
    python tools/write_speed.py out/speed_1.json out/speed_2.json docs/kernels.md
"""

import argparse
import json
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- speed -->", "<!-- end of speed -->"


def number(value: float | None) -> str:
    """An error in powers of ten."""
    return "" if value is None else f"{value:.0e}".replace("e-0", "e-")


def find(records: list[dict[str, Any]], op: str, pass_: str, way: str) -> dict[str, Any] | None:
    """One measurement, if there is one."""
    return next((r for r in records if (r["op"], r["pass"], r["way"]) == (op, pass_, way)), None)


def table(one: list[dict[str, Any]], several: list[dict[str, Any]]) -> str:
    """A line an operator and pass."""
    threads = several[0]["threads"]
    lines = [
        f"| operator | pass | ms | / yardstick | ms, {threads} threads | generic kernels | torch | rel-L2 | gradient |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for ours in (r for r in one if r["way"] == "warp"):
        op, pass_ = ours["op"], ours["pass"]
        threaded = find(several, op, pass_, "warp")
        peers = (find(one, op, pass_, way) for way in ("scalar", "torch"))
        ratios = ["" if peer is None else f"{peer['over_warp']:.1f}x" for peer in peers]
        cells = [
            f"`{op}`", pass_, f"{ours['cpu_ms'] or ours['fastest_ms']:.2f}", f"{ours['over_yardstick']:.3f}",
            "" if threaded is None else f"{threaded['fastest_ms']:.2f}", *ratios, number(ours["rel_l2"]),
            number(ours["gradient_rel_l2"]),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    first = one[0]
    about = (
        f"{first['device']}, {first['versions']}, commit {first['commit']}; {first['gaussians']:,} Gaussians drawn at "
        f"{first['width']} x {first['height']}, the best of {first['repeats']} calls: CPU time of one "
        f"thread, wall time of {threads}."
    )
    return "\n".join([*lines, "", about])


def main() -> None:
    """Read the numbers, rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("one", type=Path, help="of one thread")
    parser.add_argument("several", type=Path, help="of several")
    parser.add_argument("page", type=Path)
    options = parser.parse_args()
    one, several = (json.loads(path.read_text()) for path in (options.one, options.several))
    head, rest = options.page.read_text().split(BEGIN)
    _, tail = rest.split(END)
    options.page.write_text(f"{head}{BEGIN}\n{table(one, several)}\n{END}{tail}")


if __name__ == "__main__":
    main()
