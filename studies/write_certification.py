"""Write docs/certification.md from what `oasis gradcheck` measured.

Four commands make the page; the first three measure:

    oasis gradcheck --json out/certification.json
    oasis gradcheck --scenes 5000 --json out/grid.json
    python studies/seed_bugs.py > out/bugs.txt
    python studies/write_certification.py out docs/certification.md
"""

import argparse
import json
from pathlib import Path
from typing import Any

TEMPLATE = """# Certification

```sh
{commands}
```

The first command takes about a minute on two cores and tells whether the operators keep their promises on this machine
and device: its exit code is 0 if they do. The second draws thousands of scenes from consecutive seeds; a failure names
the operator, the kind of scene and the seed, and `--scenes 1 --family NAME --seed N` draws it alone. The kernels that a
machine has not built yet are built first, which takes a minute or two more.

## What is compared

Every float argument holds numbers that float32 can hold, so that both precisions compute with the same. The twins
(`oasis_warp.reference`) are dense float64 torch, a formula a line, and share no code with the kernels.

- **Finite differences**: gradients of the float64 operator against four-point differences of itself along random
  directions of each input, to {fd_bound}.
- **float64**: the float64 operator against the twin.
- **float32**: values and gradients against the twin, relative L2 for each tensor; `single elements` is the largest
  difference of one element over the largest element. Ordinary scenes have the tight bounds, stiff ones their own.
- **float32 to float64**: one operator against itself on scenes too large for a twin; the share of values that differ
  by more than 2e-5.
- **Bits**: repeats on one, two and three threads, forwards and backwards. **Refusals**: NaN, infinities, wrong shapes
  and indices in every argument end in a ValueError that begins with the argument's name.

Where a decision hangs on rounding (an alpha at 1/255 or at the cap, a transmittance at the stop, a ray along an edge,
two surfaces at one depth) pixels carry no weight in values and gradients; of the rasterizer's they are bounded apart,
by one layer of 1/255.

## Measured

{machine}. {verdict}

{checks}

## {n_scenes} scenes of the grid

{grid_verdict} Worst over bound for each kind of scene:

{conditions}
"""

BUGS = """
## Seeded bugs

`python studies/seed_bugs.py` plants one mistake at a time in a copy of the tree: {bugs}
"""


def number(value: float | None) -> str:
    """An error in two digits; None is one that was not finite."""
    return "not finite" if value is None else f"{value:.1e}" if value else "0"


def machine(report: dict[str, Any]) -> str:
    """Device and versions in a line."""
    found = report["machine"]
    return f"{report['creator']}, torch {found['torch']}, warp {found['warp']}, {found['device']}, {found['system']}"


def verdict(report: dict[str, Any]) -> str:
    """How many measurements there were and how many failed."""
    total = sum(row["cases"] for row in report["checks"])
    failures = sum(row["failures"] for row in report["checks"])
    return f"{total} measurements in {report['seconds']:.0f} s, {failures} beyond their bounds."


def check_table(report: dict[str, Any]) -> str:
    """A row a check of an operator."""
    lines = ["| operator | check | worst error | bound | cases |", "|---|---|---|---|---|"]
    for row in report["checks"]:
        error = number(row["error"])
        lines.append(f"| {row['family']} | {row['check']} | {error} | {number(row['bound'])} | {row['cases']} |")
    return "\n".join(lines)


def condition_table(report: dict[str, Any]) -> str:
    """A row a kind of scene of an operator: worst values and gradients."""
    kinds: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in report["conditions"]:
        kinds.setdefault((row["family"], row["condition"]), {})[row["check"]] = row
    lines = ["| operator | scene | values | bound | gradients | bound | scenes |", "|---|---|---|---|---|---|---|"]
    for (family, condition), checks in sorted(kinds.items()):
        cells = []
        for check in ("float32 values", "float32 gradients"):
            row = checks.get(check)
            cells += [number(row["error"]), number(row["bound"])] if row else ["", ""]
        n = checks["float32 not finite"]["cases"]
        lines.append(f"| {family} | {condition} | " + " | ".join(cells) + f" | {n} |")
    return "\n".join(lines)


def main() -> None:
    """Read the folder, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="holds certification.json, grid.json, perhaps bugs.txt")
    parser.add_argument("page", type=Path)
    options = parser.parse_args()
    small = json.loads((options.folder / "certification.json").read_text())
    grid = json.loads((options.folder / "grid.json").read_text())
    commands = [line.strip() for line in (__doc__ or "").splitlines() if line.startswith("    oasis")]
    bound = next(row["bound"] for row in small["checks"] if row["check"] == "finite differences")
    page = TEMPLATE.format(
        commands="\n".join(commands),
        fd_bound=number(bound),
        machine=machine(small),
        verdict=verdict(small),
        checks=check_table(small),
        n_scenes=grid["scenes"],
        grid_verdict=verdict(grid),
        conditions=condition_table(grid),
    )
    bugs = options.folder / "bugs.txt"
    if bugs.exists():
        page += BUGS.format(bugs=bugs.read_text().strip().splitlines()[-1])
    options.page.write_text(page)


if __name__ == "__main__":
    main()
