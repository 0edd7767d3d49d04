"""Run studies and render their results: `python -m studies list`, `NAME [options]`, `render [NAME ...]`."""

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

import tyro

from studies import tables
from studies.harness import ROWS, Row, read_rows

FOLDER = Path(__file__).parent
DOCS = FOLDER.parent / "docs"


def studies() -> dict[str, str]:
    """Name and first line of the docstring of every study; nothing is imported for it."""
    found = {}
    for path in sorted(FOLDER.glob("*.py")):
        tree = ast.parse(path.read_text())
        if any(isinstance(node, ast.FunctionDef) and node.name == "run" for node in tree.body):
            found[path.stem] = (ast.get_docstring(tree) or "").splitlines()[0]
    return found


def load(name: str, study: ModuleType, out: Path) -> list[Row]:
    """The rows of a study below `out`."""
    return study.load(out) if hasattr(study, "load") else read_rows(out / name / ROWS)


def render(names: list[str], out: Path, docs: Path) -> None:
    """Fill the sections of all studies that have results, and draw their pictures."""
    for name in names:
        study = importlib.import_module(f"studies.{name}")
        rows = load(name, study, out)
        if not rows:
            print(f"{name}: no results in {out}")
            continue
        for filled in tables.render(study.SECTIONS, rows, docs):
            print(f"{name}: filled {filled}")
        if hasattr(study, "draw"):
            study.draw(rows, docs / "_static")


def render_command(
    names: tyro.conf.Positional[tuple[str, ...]] = (), out: Path = Path("out"), docs: Path = DOCS
) -> None:
    """Fill tables and pictures of docs from results.

    Args:
        names: Studies; all by default.
        out: Folder of results.
        docs: Folder of pages.
    """
    known = studies()
    if unknown := set(names) - set(known):
        raise SystemExit(f"expected names of studies, got {', '.join(sorted(unknown))}; `list` names them.")
    render(list(names or known), out, docs)


def main(arguments: list[str]) -> int:
    """Do what the first argument names; the exit code."""
    known = studies()
    name, rest = (arguments[0], arguments[1:]) if arguments else ("list", [])
    if name == "list":
        print("\n".join(f"{study:{max(map(len, known))}}  {line}" for study, line in known.items()))
    elif name == "render":
        tyro.cli(render_command, prog="python -m studies render", args=rest)
    elif name in known:
        study = importlib.import_module(f"studies.{name}")
        options = tyro.cli(study.Options, prog=f"python -m studies {name}", description=study.__doc__, args=rest)
        rows = study.run(options)
        for section in study.SECTIONS:
            if text := section.text(rows):
                print(f"{section.marker}:\n\n{text}\n")
        return int(any(row.get("failed") for row in rows))
    else:
        raise SystemExit(f"expected list, render or the name of a study, got {name}; `list` names them.")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
