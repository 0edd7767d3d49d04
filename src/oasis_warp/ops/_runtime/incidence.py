"""Transposes of index tables, such as the faces around each vertex; computed once for each tensor."""

import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from oasis_kernels.posing import incidence as kernels
from oasis_warp.ops._runtime.launch import launch_ranges
from oasis_warp.ops.checks import check_index


class Incidence(NamedTuple):
    """An index table and its transpose, in compressed rows."""

    table: Tensor
    """int32, shape [N, K] or [N]: each entry is the index of one of `size` items."""
    offsets: Tensor
    """int32, shape [size + 1]: the entries of item i are `entries[offsets[i] : offsets[i + 1]]`."""
    entries: Tensor
    """int32, shape [N K]: flat places of the table, ascending for each item."""


_known: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Tensor -> (its state, size, incidence)."""
_known_indices: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Tensor -> (its state, size, its indices as int32)."""


def _state(table: Tensor) -> tuple[Any, ...]:
    """What changes when torch changes a tensor, in place or its memory."""
    return table._version, table.data_ptr(), table.shape, table.stride()


def _remembered(known: WeakIdKeyDictionary, table: Tensor, size: int) -> Any:
    """What is known of `table` and `size`, or None.

    Tensors of torch.inference_mode do not count their versions. Memory that NumPy shares, which torch then cannot
    resize, changes without torch: it is compared with the copy.
    """
    if table.is_inference() or table not in known:
        return None
    state, known_size, found = known[table]
    if state != _state(table) or known_size != size:
        return None
    copy = found.table if isinstance(found, Incidence) else found
    if table.is_cpu and not table.untyped_storage().resizable() and not bool((copy == table).all()):
        return None
    return found


def incidence(name: str, table: Tensor, size: int, what: str) -> Incidence:
    """The transpose of `table`, shape [N, K] or [N], over `size` items, cached while the tensor lives.

    Raises:
        ValueError: `table` (called `name`) is not an integer tensor or has an index outside [0, size).
    """
    found = _remembered(_known, table, size)
    if found is None:
        check_index(name, table, size, what)
        found = _transposed(table, size)
        if not table.is_inference():
            _known[table] = (_state(table), size, found)
    return found


def checked_indices(name: str, table: Tensor, size: int, what: str, least: int = 0) -> Tensor:
    """`table` as int32, contiguous, with every index in [least, size); looked at once while the tensor lives.

    Raises:
        ValueError: `table` (called `name`) is not an integer tensor or has another index.
    """
    found = _remembered(_known_indices, table, size)
    if found is None:
        check_index(name, table, size, what, least)
        found = _as_int32(table)
        if not table.is_inference():
            _known_indices[table] = (_state(table), size, found)
    return found


def _as_int32(table: Tensor) -> Tensor:
    # A copy: a cached value that held its own key would never be freed.
    return table.detach().to(torch.int32, copy=True).contiguous()


def _transposed(table: Tensor, size: int) -> Incidence:
    flat = table.reshape(-1)
    order = torch.argsort(flat, stable=True)
    bounds = torch.arange(size + 1, dtype=flat.dtype, device=flat.device)
    offsets = torch.searchsorted(flat[order], bounds)
    return Incidence(_as_int32(table), offsets.to(torch.int32), order.to(torch.int32))


_known_gaussians: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Table of faces by Gaussian -> (the other two tables, weakly; incidence)."""


def gaussians_at_vertices(corners: Incidence, on_faces: Incidence, on_vertices: Incidence | None) -> Incidence:
    """The Gaussians, bound to vertices and to faces, that depend on each vertex; cached while the tables live.

    The table has P + 3 Q entries: the vertices of the first P, then the corners of the faces of the others.

    Args:
        corners: Corners of the faces, by vertex.
        on_faces: The face of each of Q Gaussians.
        on_vertices: The vertex of each of P Gaussians; None for P = 0.
    """
    others = corners.table, None if on_vertices is None else on_vertices.table
    if on_faces.table in _known_gaussians:
        known_others, known = _known_gaussians[on_faces.table]
        if all(known_other() is other for known_other, other in zip(known_others, others, strict=True)):
            return known
    indices = corners.table[on_faces.table.long()].reshape(-1)
    found = _transposed(
        indices if on_vertices is None else torch.cat([on_vertices.table, indices]), len(corners.offsets) - 1
    )
    weak = tuple((lambda: None) if other is None else weakref.ref(other) for other in others)
    _known_gaussians[on_faces.table] = (weak, found)
    return found


def sum_at_items(rows: Tensor, index: Incidence) -> Tensor:
    """Sums [size, D] of the rows [N K, D], one for each entry of the table, of each item; in a fixed order."""
    n_items, n_columns = len(index.offsets) - 1, rows.shape[1]
    out = rows.new_empty((n_items, n_columns))
    launch_ranges(kernels.sum_rows, n_items, [rows, index.offsets, index.entries, out], like=rows)
    return out
