"""What a table of errors and times says: the best trade-offs, and the fastest setting for a given error.

Settings are ranked by `Row.cost_ms`.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from oasis_warp.bench.rows import Row

BUDGETS: tuple[tuple[str, float | None], ...] = (("1e-2", 1e-2), ("1e-3", 1e-3), ("1e-4", 1e-4), ("exact", None))
"""Largest error allowed; None: no more than that of the default, whose arithmetic is exact up to rounding."""

WORTHWHILE = 0.05
"""Least share of the time that a setting has to save: less is within what such times differ by."""


class Group(NamedTuple):
    """Rows that can be compared: one operator on one scene in one pass."""

    op: str
    scene: str
    pass_: str
    rows: tuple[Row, ...]

    @property
    def default(self) -> Row:
        """The row in which no knob is turned."""
        return next(row for row in self.rows if row.is_default)


def groups(rows: Iterable[Row]) -> list[Group]:
    """Comparable rows, in the order of their first."""
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.op, row.scene, row.pass_), []).append(row)
    return [Group(*key, tuple(members)) for key, members in found.items()]


def fits(row: Row, budget: float | None, default: Row) -> bool:
    """Whether a row keeps an error budget; one whose gradients cannot be compared keeps none of its pass."""
    if row.pass_ != "forward" and row.gradient_rel_l2 is None:
        return False
    return row.bit_equal or row.error <= (default.error if budget is None else budget)


def fastest(group: Group, budget: float | None) -> Row:
    """The fastest setting that keeps an error budget; the default where none gains more than `WORTHWHILE`.

    More threads are no setting of their own here: they trade no error, and every setting can have them.
    """
    within = [row for row in group.rows if row.knob != "threads" and fits(row, budget, group.default)]
    best = min(within, key=lambda row: row.cost_ms)
    return best if best.cost_ms < (1 - WORTHWHILE) * group.default.cost_ms else group.default


def non_dominated(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both time and error, fastest first."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.cost_ms, row.error)):
        if not best or row.error < best[-1].error:
            best.append(row)
    return best
