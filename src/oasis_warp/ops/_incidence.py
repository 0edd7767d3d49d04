"""Which rows of an index table name each item: faces round a vertex, Gaussians on a face. Computed once a tensor."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from oasis_kernels import incidence as kernels
from oasis_warp.core.checks import check_index
from oasis_warp.ops._launch import even_cuts, launch_ranges, view


class Incidence(NamedTuple):
    """An index table and its transpose, in compressed rows."""

    table: Tensor
    """int32, shape [N, K] or [N]: each entry names one of `size` items."""
    offsets: Tensor
    """int32, shape [size + 1]: item i is named by `entries[offsets[i] : offsets[i + 1]]`."""
    entries: Tensor
    """int32, shape [N K]: flat places of the table, ascending for each item."""


_known: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Tensor -> (its version, size, incidence). A tensor changed in place has a new version."""


def incidence(name: str, table: Tensor, size: int, what: str) -> Incidence:
    """The transpose of `table`, shape [N, K] or [N], over `size` items, remembered for as long as the tensor lives.

    Raises:
        ValueError: `table` (called `name`) is no integer tensor or names an item outside [0, size).
    """
    remember = not table.is_inference()  # such tensors do not count their versions
    if remember and table in _known:
        version, known_size, known = _known[table]
        if version == table._version and known_size == size:
            return known
    check_index(name, table, size, what)
    flat = table.reshape(-1)
    order = torch.argsort(flat, stable=True)
    bounds = torch.arange(size + 1, dtype=flat.dtype, device=flat.device)
    offsets = torch.searchsorted(flat[order], bounds)
    # Detached, because a value that held its own key would never be forgotten.
    found = Incidence(table.detach().to(torch.int32).contiguous(), offsets.to(torch.int32), order.to(torch.int32))
    if remember:
        _known[table] = (table._version, size, found)
    return found


def sum_at_items(rows: Tensor, index: Incidence) -> Tensor:
    """Sum of the rows [N K, D], one an entry of the table, that name each item, shape [size, D]; in a fixed order."""
    n_items, n_columns = len(index.offsets) - 1, rows.shape[1]
    out = rows.new_empty((n_items, n_columns))
    launch_ranges(
        kernels.sum_rows,
        even_cuts(n_items),
        [view(rows), view(index.offsets), view(index.entries), view(out)],
        like=rows,
    )
    return out
