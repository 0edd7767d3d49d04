"""Contact: a posed surface gives way where it lies inside another part of itself."""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.skinning import contact as kernels
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.incidence import Incidence, incidence
from oasis_warp.ops._runtime.launch import (
    aligned,
    block_count,
    current_stream,
    run_cuda,
    run_native,
)

GROUP = 32
"""Parts of a group: bits of a word."""
DEEPEST = 0.005
"""Distance of a vertex inside from the skin above it, at most: past half a finger its other side is nearer [m]."""
OPPOSED, PARTS_OPPOSED = -0.3, 0.3
"""Cosines of the normals of skin that touches, and of its parts, at most: they differ by 35 degrees within a part."""
ASIDE = 0.003
"""Distance along the surface to the nearest vertex of skin that touches, at most: edges have 2 mm [m]."""
MARGIN = 0.00075
"""How far skin is moved out [m]: edges between vertices that just touch would still cross."""
FADES = 0.5
"""Share of the skin around a vertex that touches, below which its shift fades: that at the edge of a contact."""
BETWEEN = 0.0015
"""Distance along the skin to the nearest vertex that is no gap: that between vertices [m]."""
PAD = 0.003
"""Margin around a part's box [m]: normals of the flesh below differ from the part's own and lead that far aside."""
MAX_SURFACES = 1024
"""Surfaces of a launch on CUDA, at most: Warp counts threads in 32 bits."""


class ContactTables(NamedTuple):
    """What contact needs to know of a surface in any pose; indices are int32."""

    members: Int[Tensor, "V"]
    """The vertices, those of a part together."""
    starts: Int[Tensor, "P+1"]
    """First place of each of P parts there; parts in a row, `GROUP` a group, lie near each other."""
    part: Int[Tensor, "V"]
    """Part of each vertex."""
    samples: Int[Tensor, "P E"]
    """Some faces of each part."""
    beside: Int[Tensor, "P A"]
    """The part itself and those within the reach of `neighbours`; -1 fills rows up."""
    allowed: Int[Tensor, "P G"]
    """The parts of each of G groups that a part may touch, as bits."""
    give: Float[Tensor, "V"]
    """How far each vertex can give way [m]; two that touch share what is needed in proportion."""
    offsets: Int[Tensor, "V+1"]
    """Rows of `neighbours`."""
    neighbours: Int[Tensor, "K"]
    """Vertices around each vertex, itself among them."""
    weights: Float[Tensor, "K"]
    """Their weights; each row sums to 1."""


class Contact(NamedTuple):
    """What contact does to posed surfaces."""

    shifts: Float[Tensor, "B V 3"]
    """That lead the vertices out of other parts of the same surface [m]; 0 where no contact reaches."""
    closeness: Float[Tensor, "B V"]
    """exp(-gap / width) of what the shifts leave of the gap to the nearest skin that faces the vertex; 0 where there is
    no such skin within `DEEPEST`."""


_CONTACT = Declaration(
    "contact_shifts",
    inputs={"vertices": Array("B V 3"), "faces": Array("F 3", index="V"), "changes": Array("B K", optional=True)},
    public=False,
)


@torch.no_grad()
def contact_shifts(
    vertices: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    tables: ContactTables,
    mirrored: bool,
    changes: Float[Tensor, "B K"] | None = None,
    whole: float = 1.0,
    width: float = 0.001,
) -> Contact | None:
    """Lead the vertices of posed surfaces out of other parts of the same surface; None if nothing touches.

    A vertex in other flesh, at most `DEEPEST` from the nearest skin that it faces, moves along the normal of that skin,
    which comes towards it by its own share. A mean over the vertices around makes a dent of it. Vertices that no
    contact reaches have a shift of 0. On CUDA no step waits for the device, so None is never returned there. The same
    bits for a surface in a batch as alone. Float32; values are trusted; not differentiable.

    Args:
        vertices: Vertices of posed surfaces [m].
        faces: Corners.
        tables: Tables of that surface.
        mirrored: Whether faces wind the other way.
        changes: Changes from a pose in which nothing gives way: shifts and closeness are those times the largest one
            over `whole`.
        whole: Largest change from which on everything gives way.
        width: Gap over which closeness falls to 1/e [m].

    Raises:
        ValueError: a wrong shape or index.
    """
    n = _CONTACT.check(vertices=vertices, faces=faces, changes=changes)["V"]
    index, outward = incidence("faces", faces, n, "vertices"), -1.0 if mirrored else 1.0
    if vertices.is_cuda:
        parts = []
        for k in range(0, len(vertices), MAX_SURFACES):
            some, by = aligned(*(None if t is None else t[k : k + MAX_SURFACES] for t in (vertices, changes)))
            parts.append(_contact_on_cuda(some, index, tables, outward, by, whole, width))
        none = Contact(vertices[:0], vertices[:0, :, 0])
        return parts[0] if len(parts) == 1 else Contact(*map(torch.cat, zip(none, *parts, strict=True)))
    share = None if changes is None else (changes.abs().amax(1, keepdim=True) / whole).clamp(max=1)
    return _contact_on_cpu(vertices.contiguous(), index, tables, outward, share, width)


def _empty(vertices: Float[Tensor, "B V 3"], *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Memory of this shape for each surface."""
    return vertices.new_empty((len(vertices), *shape), dtype=dtype)


def _contact_on_cpu(
    vertices: Float[Tensor, "B V 3"], index: Incidence, t: ContactTables, outward: float,
    share: Float[Tensor, "B 1"] | None, width: float,
) -> Contact | None:  # fmt: skip
    batch, n, n_parts, n_groups = *vertices.shape[:2], *t.allowed.shape

    empty, whole = functools.partial(_empty, vertices), torch.int32
    lengths = (DEEPEST, PAD, PARTS_OPPOSED, OPPOSED, ASIDE, MARGIN, FADES, BETWEEN, width)
    state = torch.zeros(kernels.FLAGS + 2, dtype=torch.int64)
    params = t._asdict() | {
        "batch": batch, "n": n, "n_parts": n_parts, "n_groups": n_groups, "n_samples": t.samples.shape[1],
        "n_beside": t.beside.shape[1], "mirrored": int(outward < 0), "lengths": torch.tensor(lengths),
        "points": vertices, "faces": index.table, "face_offsets": index.offsets, "face_entries": index.entries,
        "part_of_it": share, "tables": empty(4, n, 4), "sorted": empty(6, n + 16),
        "boxes": empty(n_parts + n_groups, 16), "met": empty(n_parts, n_groups, dtype=whole),
        "meets": empty(n_parts, dtype=whole), "others": empty(n, dtype=whole),
        "moving": empty(n, dtype=whole).zero_(), "shifts": empty(n, 3), "close": empty(n), "state": state,
    }  # fmt: skip
    run_native(kernels.resolve, params, batch * n_parts)
    return Contact(params["shifts"], params["close"]) if bool(state[kernels.FLAGS :].all()) else None


def _contact_on_cuda(
    vertices: Float[Tensor, "B V 3"], index: Incidence, t: ContactTables, outward: float,
    changes: Float[Tensor, "B K"] | None, whole: float, width: float,
) -> Contact:  # fmt: skip
    batch, n, n_parts, n_groups = *vertices.shape[:2], *t.allowed.shape

    empty = functools.partial(_empty, vertices)
    box_blocks, find_blocks = (block_count(batch * items, kernels.WARPS) for items in (n_parts, n))
    rows = block_count(batch * n, kernels.BLOCK // kernels.LANES)
    params = t._asdict() | {
        "batch": batch, "n": n, "n_parts": n_parts, "n_groups": n_groups, "reach": DEEPEST, "points": vertices,
        "boxes": empty(5, n_parts, 4), "normals": empty(n, 3), "met": empty(n_parts, n_groups, dtype=torch.int32),
        "state": empty(n_parts, dtype=torch.int32), "others": empty(n, dtype=torch.int32), "wanted": empty(n, 4),
        "aside": ASIDE, "margin": MARGIN, "fades": FADES, "whole": whole, "shifts": None, "changes": None,
        "n_changes": 0,
    }  # fmt: skip
    stream = current_stream(vertices.device)
    surface = {
        "box_blocks": box_blocks, "offsets": index.offsets, "entries": index.entries, "faces": index.table,
        "n_samples": t.samples.shape[1], "outward": outward, "pad": PAD,
    }  # fmt: skip
    vertex_blocks = block_count(batch * n, kernels.BLOCK)
    run_cuda(kernels.boxes, params | surface, box_blocks + vertex_blocks, stream)
    near = {"n_beside": t.beside.shape[1], "opposed": PARTS_OPPOSED}
    run_cuda(kernels.meetings, params | near, box_blocks, stream)
    params["opposed"] = OPPOSED
    run_cuda(kernels.find, params, find_blocks, stream)
    for k in range(kernels.ROUNDS):
        run_cuda(kernels.contacts, params, rows, stream)
        if changes is not None and k == kernels.ROUNDS - 1:
            params |= {"changes": changes, "n_changes": changes.shape[1]}
        params["out"] = empty(n, 3)
        run_cuda(kernels.spread, params, rows, stream)
        params["shifts"] = params["out"]
    params["close"] = empty(n)
    run_cuda(kernels.closeness, params | {"aside": BETWEEN, "width": width}, rows, stream)
    return Contact(params["shifts"], params["close"])
