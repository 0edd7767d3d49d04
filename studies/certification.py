"""What `oasis gradcheck` certifies on this machine: values, gradients, bits and refusals of the operators.

Fills docs/certification.md (checks, grid) from OUT/certification.json and OUT/grid.json. Running it is these commands:

    oasis gradcheck --json out/certification.json
    oasis gradcheck --scenes 5000 --json out/grid.json
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from studies.harness import Row, StudyOptions
from studies.tables import markdown, section_of

REPORTS = ("certification", "grid")
FILES = tuple(f"{name}.json" for name in REPORTS)


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    scenes: int = 5000
    """Scenes of the grid."""


def run(options: Options) -> list[Row]:
    """Run both commands."""
    from oasis_warp.cli import main

    options.out.mkdir(parents=True, exist_ok=True)
    main(["gradcheck", "--device", options.device, "--json", str(options.out / "certification.json")])
    grid = ["--scenes", str(options.scenes), "--json", str(options.out / "grid.json")]
    main(["gradcheck", "--device", options.device, *grid])
    return load(options.out)


def load(out: Path) -> list[Row]:
    """What the commands left, a row for each report."""
    paths = {name: out / f"{name}.json" for name in REPORTS}
    return [{"report": name, **json.loads(path.read_text())} for name, path in paths.items() if path.is_file()]


def number(value: float | None) -> str:
    """An error in two digits; None is one that was not finite."""
    return "not finite" if value is None else f"{value:.1e}" if value else "0"


def verdict(report: dict[str, Any]) -> str:
    """How many measurements there were and how many failed."""
    total, failures = (sum(row[key] for row in report["checks"]) for key in ("cases", "failures"))
    return f"{total} measurements in {report['seconds']:.0f} s, {failures} beyond their bounds."


def checks(report: dict[str, Any]) -> str:
    """The machine, and a line for each check of an operator."""
    found = report["machine"]
    about = f"{report['creator']}, torch {found['torch']}, warp {found['warp']}, {found['device']}, {found['system']}"
    lines = [
        [row["family"], row["check"], number(row["error"]), number(row["bound"]), str(row["cases"])]
        for row in report["checks"]
    ]
    made = markdown(["operator", "check", "worst error", "bound", "cases"], lines)
    return f"{about}. {verdict(report)}\n\n{made}"


def conditions(report: dict[str, Any]) -> str:
    """A line for each kind of scene of an operator: worst values and gradients."""
    kinds: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in report["conditions"]:
        kinds.setdefault((row["family"], row["condition"]), {})[row["check"]] = row
    lines = []
    for (family, condition), found in sorted(kinds.items()):
        cells = [
            number(found[check][key]) if check in found else ""
            for check in ("float32 values", "float32 gradients") for key in ("error", "bound")
        ]  # fmt: skip
        lines.append([family, condition, *cells, str(found["float32 not finite"]["cases"])])
    headings = ["operator", "scene", "values", "bound", "gradients", "bound", "scenes"]
    about = f"{report['scenes']} scenes. {verdict(report)} Worst over bound for each kind of scene:"
    return f"{about}\n\n{markdown(headings, lines)}"


SECTIONS = (
    section_of("certification.md", "checks", checks, report="certification"),
    section_of("certification.md", "grid", conditions, report="grid"),
)
