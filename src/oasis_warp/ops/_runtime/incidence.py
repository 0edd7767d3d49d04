"""Transposes of index tables, such as the faces around each vertex; computed once for each tensor."""

import weakref
from typing import NamedTuple

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
"""Tensor -> (its version, size, incidence). A tensor changed in place has a new version."""


def incidence(name: str, table: Tensor, size: int, what: str) -> Incidence:
    """The transpose of `table`, shape [N, K] or [N], over `size` items, cached while the tensor lives.

    Raises:
        ValueError: `table` (called `name`) is not an integer tensor or has an index outside [0, size).
    """
    cached = not table.is_inference()  # such tensors do not count their versions
    if cached and table in _known:
        version, known_size, known = _known[table]
        if version == table._version and known_size == size:
            return known
    check_index(name, table, size, what)
    found = _transposed(table, size)
    if cached:
        _known[table] = (table._version, size, found)
    return found


def _transposed(table: Tensor, size: int) -> Incidence:
    flat = table.reshape(-1)
    order = torch.argsort(flat, stable=True)
    bounds = torch.arange(size + 1, dtype=flat.dtype, device=flat.device)
    offsets = torch.searchsorted(flat[order], bounds)
    # A copy: a cached value that held its own key would never be freed.
    table = table.detach().to(torch.int32, copy=True).contiguous()
    return Incidence(table, offsets.to(torch.int32), order.to(torch.int32))


_known_gaussians: WeakIdKeyDictionary = WeakIdKeyDictionary()
"""Index of faces -> (the other two tensors, weakly; all versions; size; incidence)."""


def gaussians_at_vertices(faces: Tensor, face_index: Tensor, vertex_index: Tensor | None, size: int) -> Incidence:
    """The Gaussians, bound to vertices and to faces, that depend on each of `size` vertices; cached.

    The table has P + 3 Q entries: the vertices `vertex_index`, shape [P] or None, then the corners of the faces
    `face_index`, shape [Q]. All indices have been checked.
    """
    tables = (face_index, faces, *([] if vertex_index is None else [vertex_index]))
    cached = not any(table.is_inference() for table in tables)
    versions = tuple(table._version for table in tables) if cached else ()
    if cached and face_index in _known_gaussians:
        others, known_versions, known_size, known = _known_gaussians[face_index]
        same = len(others) == len(tables) - 1 and all(o() is t for o, t in zip(others, tables[1:], strict=True))
        if same and known_versions == versions and known_size == size:
            return known
    corners = faces[face_index].reshape(-1)
    found = _transposed(corners if vertex_index is None else torch.cat([vertex_index, corners]), size)
    if cached:
        others = tuple(weakref.ref(table) for table in tables[1:])
        _known_gaussians[face_index] = (others, versions, size, found)
    return found


def sum_at_items(rows: Tensor, index: Incidence) -> Tensor:
    """Sums [size, D] of the rows [N K, D], one for each entry of the table, of each item; in a fixed order."""
    n_items, n_columns = len(index.offsets) - 1, rows.shape[1]
    out = rows.new_empty((n_items, n_columns))
    launch_ranges(kernels.sum_rows, n_items, [rows, index.offsets, index.entries, out], like=rows)
    return out
