"""Contact of a posed hand with itself: fingers and palm that pass through each other are moved apart."""

import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from oasis_warp.core import surface
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.core.types import Side
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops.contact import GROUP, PARTS_OPPOSED, ContactTables, contact_shifts

LIMIT = 0.006
"""Largest shift of a vertex [m]."""
YIELD = 0.4
"""Share of the distance from a finger's bone to its skin that can yield: bones take .42 of it."""
SPACING = 0.014
"""Width of patches of skin that are tested as one, and what a right angle between normals counts there [m]."""
APART = 0.015
"""Distance over the surface from which two patches may touch [m]: nearer ones only bend."""
RINGS = 2
"""Rings of neighbours over which a shift is spread: 4 mm."""
NAIL_EDGE = 2
"""Rings around a nail over which skin becomes free of it."""
FREE = math.radians(10)
"""Change of a joint's angle up to which skin gives way only in part [rad]."""
CREVICE = 0.0024
"""Gap to other skin over which closeness falls to 1/e [m]."""
SAMPLES = 8
"""Faces whose mean normal is that of a patch."""


class Touching(NamedTuple):
    """Posed vertices after contact."""

    vertices: Float[Tensor, "*B V 3"]
    """[m]."""
    closeness: Float[Tensor, "*B V"] | None
    """Of each vertex to other skin that it faces: exp(-gap / `CREVICE`); None where nothing is near."""


def resolve_contact(
    hand: HandModel,
    vertices: Float[Tensor, "*B V 3"],
    side: Side = "right",
    changes: Float[Tensor, "*B K"] | None = None,
) -> Touching:
    """Move posed vertices of a hand out of each other: both sides of a contact yield, each by at most `LIMIT`.

    Fingers yield by up to `YIELD` of their thickness, nails not at all. Vertices that no contact reaches keep their
    bits; on the CPU a hand without contact is returned itself. Derivatives see the shifts as constants. Skin that lies
    deeper inside than both sides can yield stays inside by the rest. The skin of one bone is never moved out of itself.

    Args:
        hand: Model of the surface.
        vertices: In poses [m].
        side: The faces of a left hand wind the other way.
        changes: Changes of angles [rad] from a pose in which nothing gives way; from `FREE` on it does wholly.
    """
    if changes is not None:
        if changes.is_cpu and not changes.any():
            return Touching(vertices, None)
        changes = changes.detach().float().reshape(-1, changes.shape[-1])
    flat = vertices.detach().float().reshape(-1, *vertices.shape[-2:])
    tables = contact_tables(vertices.device)
    found = contact_shifts(flat, hand.faces, tables, side == "left", changes, FREE, CREVICE)
    if found is None:
        return Touching(vertices, None)
    moved = vertices + found.shifts.to(vertices).view_as(vertices)
    return Touching(moved, found.closeness.to(vertices).view(vertices.shape[:-1]))


@functools.cache
def contact_tables(device: torch.device) -> ContactTables:
    """Tables of the bundled hand; all hands share its triangles."""
    hand = bundled_hand()
    points, faces = hand.template.double().numpy(), hand.faces.numpy()
    edges = surface.mesh_edges(hand.faces).numpy()
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    adjacent = sparse.csr_array((np.ones(len(rows)), (rows, columns))) + sparse.eye_array(len(points))
    mean = sparse.csr_array(sparse.diags_array(1 / adjacent.sum(1)) @ adjacent)
    around = sparse.csr_array(sparse.linalg.matrix_power(mean, RINGS))
    around.sort_indices()
    rigid = (hand.nail.numpy() > 0.5).astype(float)
    for _ in range(NAIL_EDGE):
        rigid = np.maximum(rigid, mean @ rigid)
    members, starts = _patches(hand)
    n_parts = len(starts) - 1
    part = np.empty_like(members)
    part[members] = np.repeat(np.arange(n_parts), np.diff(starts))
    face = np.empty_like(members)
    face[faces] = np.arange(len(faces))[:, None]  # one of those around each vertex
    near = sparse.coo_array(around)
    tables = {
        "members": members,
        "starts": starts,
        "part": part,
        "samples": face[members[starts[:-1, None] + np.diff(starts)[:, None] * np.arange(SAMPLES) // SAMPLES]],
        "beside": _beside(part[near.row], part[near.col], n_parts),
        "allowed": _may_touch(hand, part, edges),
        "give": np.minimum(LIMIT, YIELD * flesh_thickness(hand)) * (1 - rigid).clip(0),
        "offsets": around.indptr,
        "neighbours": around.indices,
        "weights": around.data,
    }
    real = {"give", "weights"}
    return ContactTables(**{
        name: torch.from_numpy(array.astype(np.float32 if name in real else np.int32)).to(device)
        for name, array in tables.items()
    })  # fmt: skip


def _patches(hand: HandModel) -> tuple[np.ndarray, np.ndarray]:
    """The vertices in patches, and the first of each: parts of one bone, small and nearly flat."""
    normals = surface.vertex_normals(hand.template, hand.faces)
    places = torch.cat([hand.template, SPACING * normals], 1).double().numpy()
    waiting = [np.flatnonzero(hand.segment.numpy() == bone) for bone in reversed(range(len(hand.parents)))]
    patches = []
    while waiting:
        own = waiting.pop()
        extent = np.ptp(places[own], axis=0)
        if extent.max() < SPACING:
            patches.append(own)
            continue
        along = own[places[own, extent.argmax()].argsort(kind="stable")]
        waiting += [along[len(along) // 2 :], along[: len(along) // 2]]
    return np.concatenate(patches), np.cumsum([0, *map(len, patches)])


def _beside(a: np.ndarray, b: np.ndarray, n_parts: int) -> np.ndarray:
    """The patches beside each patch, itself first, filled up with -1; given as pairs of patches."""
    rank = np.full((n_parts, n_parts), 2)
    rank[a, b] = 1
    np.fill_diagonal(rank, 0)
    first = rank.argsort(1, kind="stable")[:, : (rank < 2).sum(1).max()]
    return np.where(np.take_along_axis(rank, first, 1) < 2, first, -1)


def _may_touch(hand: HandModel, part: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Bits that say which patches may touch in some pose: not those of one bone, nor two sides of a finger."""
    n_parts = part.max() + 1
    normals = surface.vertex_normals(hand.template, hand.faces)
    sums = np.zeros((n_parts, 7))
    np.add.at(sums, part, torch.cat([hand.template, normals, torch.ones_like(normals[:, :1])], 1).double().numpy())
    middle, outward = sums[:, :3] / sums[:, 6:], sums[:, 3:6] / np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
    bone = np.zeros(n_parts, int)
    bone[part] = hand.segment.numpy()
    a, b = part[edges].T
    steps = np.zeros((n_parts, n_parts))  # 0 is no step
    steps[a, b] = np.linalg.norm(middle[a] - middle[b], axis=1)
    above = np.array(hand.parents)[bone]
    joined = (above[:, None] == bone) | (bone[:, None] == above)
    two_sides = joined & (outward @ outward.T < PARTS_OPPOSED)
    allowed = (dijkstra(steps, directed=False) > APART) & (bone[:, None] != bone) & ~two_sides
    filled = np.pad(allowed, ((0, 0), (0, -n_parts % GROUP)))
    return np.packbits(filled, axis=1, bitorder="little").view("<i4")


def flesh_thickness(hand: HandModel) -> np.ndarray:
    """Distance of each vertex at rest from the axis of its finger's bone [m]; infinite on the palm."""
    joints, tips, points = (part.double().numpy() for part in (hand.joints, hand.tips, hand.template))
    found = np.full(len(points), np.inf)
    for joint in range(1, len(joints)):
        own = hand.segment.numpy() == joint
        end = tips[TIP_JOINTS.index(joint)] if joint in TIP_JOINTS else joints[hand.parents.index(joint)]
        along, arm = end - joints[joint], points[own] - joints[joint]
        at = np.clip(arm @ along / (along @ along), 0, 1)
        found[own] = np.linalg.norm(arm - at[:, None] * along, axis=1)
    return found
