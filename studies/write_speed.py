"""Put the table of `oasis bench kernels` into docs/kernels.md, between its two markers.

    oasis bench kernels --json out/speed_1.json
    python studies/write_speed.py docs/kernels.md out/speed_1.json

A second file, of `oasis bench kernels --threads 2`, adds a column. Measure it on a machine with nothing else to do:
what waits for a thread counts there.
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
    """A line an operator and pass; `several` is of more threads, or empty."""
    heading = ["operator", "pass", "ms", "/ yardstick", "generic kernels", "torch", "rel-L2", "gradient"]
    if several:
        heading.append(f"ms, {several[0]['threads']} threads")
    lines = ["| " + " | ".join(heading) + " |", "|" + "---|" * len(heading)]
    for ours in (r for r in one if r["way"] == "warp"):
        op, pass_ = ours["op"], ours["pass"]
        peers = (find(one, op, pass_, way) for way in ("scalar", "torch"))
        ratios = ["" if peer is None else f"{peer['over_warp']:.1f}x" for peer in peers]
        cells = [
            f"`{op}`", pass_, f"{ours['cpu_ms'] or ours['fastest_ms']:.2f}", f"{ours['over_yardstick']:.3f}", *ratios,
            number(ours["rel_l2"]), number(ours["gradient_rel_l2"]),
        ]  # fmt: skip
        threaded = find(several, op, pass_, "warp")
        if threaded is not None:
            cells.append(f"{threaded['fastest_ms']:.2f}")
        lines.append("| " + " | ".join(cells) + " |")
    first = one[0]
    about = (
        f"{first['device']}, {first['versions']}, commit {first['commit']}; {first['gaussians']:,} Gaussians drawn at "
        f"{first['width']} x {first['height']}, the best of {first['repeats']} calls."
    )
    return "\n".join([*lines, "", about])


def main() -> None:
    """Read the numbers, rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("one", type=Path, help="of one thread")
    parser.add_argument("several", type=Path, nargs="?", help="of several")
    options = parser.parse_args()
    one = json.loads(options.one.read_text())
    several = json.loads(options.several.read_text()) if options.several else []
    head, rest = options.page.read_text().split(BEGIN)
    _, tail = rest.split(END)
    options.page.write_text(f"{head}{BEGIN}\n{table(one, several)}\n{END}{tail}")


if __name__ == "__main__":
    main()
