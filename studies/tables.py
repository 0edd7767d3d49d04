"""Tables and pictures of the documentation: rows as Markdown, put between the markers of a page.

A section stands between `<!-- MARKER -->` and `<!-- end of MARKER -->`; the first may also name the commit that it was
measured at: `<!-- MARKER (8bec49421b) -->`.
"""

import re
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from oasis_warp.data.output_files import write_file
from studies.harness import Row

Text = Callable[[list[Row]], str | None]


class Column(NamedTuple):
    """A column of a table."""

    heading: str
    value: str | Callable[[Row], Any]
    """A key of the rows, or a function of one."""
    form: str | Callable[[Any], str] = ""
    """Format of its numbers: as `format` takes it, or a function such as `short`."""

    def cell(self, row: Row) -> str:
        """The text of one row; empty where it has no value."""
        value = self.value(row) if callable(self.value) else row.get(self.value)
        return value if isinstance(value, str) else self.text(value)

    def text(self, value: Any) -> str:
        """A number in the column's form; empty for None."""
        return "" if value is None else self.form(value) if callable(self.form) else format(value, self.form)


class Section(NamedTuple):
    """A part of a page that a study fills."""

    page: str | None
    """File name below docs; None for what is only printed."""
    marker: str
    text: Text
    """What stands there, made of the study's rows; None leaves the page as it is."""
    file: str | None = None
    """The file of results that it is made of; None for a study whose files belong together."""


def section_of(
    page: str | None, marker: str, text: Callable[[Row], str], file: str | None = None, **values: object
) -> Section:
    """A section made of the one row of a study that has these `values`; left as it is where there is none."""

    def filled(rows: list[Row]) -> str | None:
        found = next((row for row in rows if values.items() <= row.items()), None)
        return None if found is None else text(found)

    return Section(page, marker, filled, file)


def complete(rows: Iterable[Row]) -> list[Row]:
    """The rows of cases that were not refused."""
    return [row for row in rows if "refused" not in row]


def table(
    columns: Sequence[Column],
    rows: Callable[[list[Row]], list[Row]] = complete,
    foot: Callable[[list[Row], Sequence[Column]], list[Sequence[str]]] | None = None,
    after: Text | None = None,
) -> Text:
    """A function that makes a table of a study's rows.

    Args:
        columns: What a line shows.
        rows: Selects or aggregates the rows of the study to those of the table; no table is made of none.
        foot: Further lines, of the table's rows and columns.
        after: Text below the table, of the study's rows.
    """

    def text(found: list[Row]) -> str | None:
        shown = rows(found)
        if not shown:
            return None
        lines = [[column.cell(row) for column in columns] for row in shown]
        made = markdown([column.heading for column in columns], [*lines, *(foot(shown, columns) if foot else [])])
        below = after(found) if after else None
        return f"{made}\n\n{below}" if below else made

    return text


def medians(rows: list[Row], columns: Sequence[Column]) -> list[Sequence[str]]:
    """A foot with the median of every column but the first."""
    values = {column: statistics.median(row[str(column.value)] for row in rows) for column in columns[1:]}
    return [["**median**", *(column.text(value) for column, value in values.items())]]


def markdown(headings: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, ["---"] * len(headings), *lines))


def percent(share: float) -> str:
    """A share as "12 %"."""
    return f"{100 * share:.0f} %"


def yes(value: bool) -> str:
    """Yes or no."""
    return "yes" if value else "no"


def power(value: float | None, digits: int = 0) -> str:
    """A positive number as a power of ten, with so many digits after the first; "" for None."""
    if not value:
        return "" if value is None else "0"
    return f"{value:.{digits}e}".replace("e-0", "e-").replace("e+00", "")


def short(value: float | None, digits: int = 3) -> str:
    """A number of so many digits, with separators where it is large; "" for None."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 10 ** (digits - 1) else f"{float(f'{value:.{digits}g}'):g}"


def mean(values: Iterable[float | None]) -> float | None:
    """Of the numbers among `values`; None where there are none."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def percentiles(values: Iterable[float | None], shares: Sequence[float] = (10, 50, 90)) -> list[float]:
    """Of the numbers among `values`."""
    return [float(x) for x in np.percentile([value for value in values if value is not None], shares)]


def distribution(
    rows: list[Row], measures: Sequence[Column], title: str = "", by: str | None = None, extremes: bool = False
) -> str | None:
    """A table of percentiles, a line for each measure, and for each value of the key `by`; None of no rows."""
    parts = groups(rows, by) if by else {(): rows}
    lines = []
    for measure in measures:
        for name, own in parts.items():
            values = [row[measure.value] for row in own if row.get(measure.value) is not None]
            if values:
                numbers = percentiles(values) + ([min(values), max(values)] if extremes else [])
                lines.append([measure.heading, *name, *map(measure.text, numbers)])
    headings = [title, *([by] if by else []), "10 %", "median", "90 %", *(["least", "most"] if extremes else [])]
    return markdown(headings, lines) if lines else None


def groups(rows: Iterable[Row], *keys: str) -> dict[tuple, list[Row]]:
    """Rows by the values of some of their columns, in the order of their first appearance."""
    found: dict[tuple, list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def fill(page: str, marker: str, text: str, commit: str = "") -> str:
    """`page` with `text` between the markers of a section.

    Raises:
        SystemExit: the page has no such section.
    """
    name = re.escape(marker)
    parts = re.compile(rf"<!-- {name}(?: \([^)]*\))? -->\n.*?<!-- end of {name} -->", re.DOTALL)
    begin = f"<!-- {marker} ({commit}) -->" if commit else f"<!-- {marker} -->"
    if not parts.search(page):
        raise SystemExit(f"expected <!-- {marker} --> and <!-- end of {marker} --> in the page; put them there.")
    return parts.sub(lambda _: f"{begin}\n{text}\n<!-- end of {marker} -->", page)


def commits_of(rows: Iterable[Row]) -> str:
    """The commits that rows were measured at."""
    commits = list(dict.fromkeys(str(row["commit"]) for row in rows if row.get("commit")))
    if len(commits) > 2:  # a run that went on while work was committed
        commits = [f"{commits[0]} to {commits[-1]}"]
    return ", ".join(commits)


def render(sections: Sequence[Section], rows: list[Row], docs: Path) -> list[str]:
    """Fill the sections of a study into the pages below `docs`, and return what was filled."""
    filled = []
    for page, marker, text, _ in sections:
        made = text(rows) if page else None
        if page is None or made is None:
            continue
        path = docs / page
        write_file(path, fill(path.read_text(), marker, made, commits_of(rows)).encode())
        filled.append(f"{page}: {marker}")
    return filled


def write_jpeg(path: Path, pixels: np.ndarray, quality: int = 90) -> None:
    """Write an RGB picture."""
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), (cv2.IMWRITE_JPEG_QUALITY, quality))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, np.asarray(data).tobytes())
