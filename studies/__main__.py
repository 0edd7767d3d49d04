"""Run studies and render results: `python -m studies list`, `NAME [options]`, `render [NAME ...]`, `age [--check]`."""

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

import tyro

from oasis_warp.data.output_files import write_file
from studies import age, tables
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


def files_of(name: str, study: ModuleType) -> tuple[str, ...]:
    """The files of results of a study, below the folder of results."""
    return getattr(study, "FILES", (f"{name}/{ROWS}",))


def load(name: str, study: ModuleType, out: Path) -> list[Row]:
    """The rows of a study below `out`."""
    return study.load(out) if hasattr(study, "load") else read_rows(out / name / ROWS)


def render(names: list[str], out: Path, docs: Path, results: Path) -> None:
    """Keep what studies have left in `out`, fill pages from what is kept, and draw their pictures."""
    for name in names:
        study = importlib.import_module(f"studies.{name}")
        age.keep(name, files_of(name, study), out, results)
        rows = load(name, study, results)
        for filled in tables.render(study.SECTIONS, rows, docs) if rows else ():
            print(f"{name}: filled {filled}")
        if hasattr(study, "draw") and (drawn := load(name, study, out) or rows):
            study.draw(drawn, docs / "_static")
    note_ages(names, docs, results, write=True)


def note_ages(names: list[str], docs: Path, results: Path, write: bool) -> list[str]:
    """Say below every table that is older than its code that it is, and return those where that is missing."""
    missing = []
    for name in names:
        study = importlib.import_module(f"studies.{name}")
        files, rows = files_of(name, study), load(name, study, results)
        measured = dict.fromkeys(age.times(results, files), age.NOT_NOTED) | age.read_measured(results, name)
        for page, marker, text, file in study.SECTIONS:
            if page and (docs / page).is_file():
                own = {file: measured[file]} if file in measured else measured if rows and text(rows) else {}
                commits = tables.commits_of(rows) or tables.commits_of(one._asdict() for one in own.values())
                note = age.age_note(own, age.code_digest(name), commits)
                old = (docs / page).read_text()
                new = age.noted_page(old, marker, note)
                missing += [f"{page}: {marker}"] if new != old and age.noted_page(old, marker, "") == old else []
                if write and new != old:
                    write_file(docs / page, new.encode())
    return missing


def render_command(
    names: tyro.conf.Positional[tuple[str, ...]] = (),
    out: Path = Path("out"),
    docs: Path = DOCS,
    results: Path = age.RESULTS,
) -> None:
    """Keep results, and fill tables and pictures of docs from what is kept.

    Args:
        names: Studies; all by default.
        out: Folder of new results.
        docs: Folder of pages.
        results: Folder of the results that are kept.
    """
    known = studies()
    if unknown := set(names) - set(known):
        raise SystemExit(f"expected names of studies, got {', '.join(sorted(unknown))}; `list` names them.")
    render(list(names or known), out, docs, results)


def age_command(check: bool = False) -> None:
    """Say below every table of docs that is older than its code that it is.

    Args:
        check: Change nothing, and fail where a table does not say so.
    """
    missing = note_ages(list(studies()), DOCS, age.RESULTS, write=not check)
    if check and missing:
        raise SystemExit(
            f"These tables do not say that their code has changed: {'; '.join(missing)}. Measure them again, or run "
            "`python -m studies age`, which says so below them."
        )


def main(arguments: list[str]) -> int:
    """Do what the first argument names; the exit code."""
    known = studies()
    name, rest = (arguments[0], arguments[1:]) if arguments else ("list", [])
    if name == "list":
        print("\n".join(f"{study:{max(map(len, known))}}  {line}" for study, line in known.items()))
    elif name == "render":
        tyro.cli(render_command, prog="python -m studies render", args=rest)
    elif name == "age":
        tyro.cli(age_command, prog="python -m studies age", args=rest)
    elif name in known:
        study = importlib.import_module(f"studies.{name}")
        options = tyro.cli(study.Options, prog=f"python -m studies {name}", description=study.__doc__, args=rest)
        with age.noting_code(options.out, name, files_of(name, study)):
            rows = study.run(options)
        for section in study.SECTIONS:
            if text := section.text(rows):
                print(f"{section.marker}:\n\n{text}\n")
        return int(any(row.get("failed") for row in rows))
    else:
        raise SystemExit(f"expected list, render, age or the name of a study, got {name}; `list` names them.")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
