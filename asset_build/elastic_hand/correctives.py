"""Pose correctives fitted to flesh on bones, which keep the parts of a hand out of each other.

They are a ridge regression of the flesh's displacements on the strengths of the shapes, and of contact: where the posed
surface lies inside another part of itself, both sides have to give way by half, in poses without simulated flesh too.
Each round adds targets for what is still inside; earlier targets stay.
"""

from collections.abc import Sequence

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
import torch
from hand_build.anatomy import FINGERS, FIRST, Array, Index
from scipy.spatial import cKDTree

from elastic_hand.simulations import Simulation, bones
from elastic_hand.solid import MILLIMETRES, facing_skin, skinned
from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.skinning import corrective_coefficients

RIDGE = 1.0
ELSEWHERE = 1e6
"""Ridge of a shape on a finger that is not its own nor beside it."""
NAIL_BED, NAIL_FREE = 3.0, 9.0
"""Distances from a nail up to which skin keeps to the bone, and from which on it is free of it [mm]."""
POSE_WEIGHT = 2.0
"""Of a state in which several joints are bent, against one joint bent alone."""
CONTACT_WEIGHT = 10.0
"""Of giving way at a vertex in a pose, against following the flesh of one joint there."""
ROUNDS = 5
APART, DEEPEST, MARGIN = 5.0, 8.0, 0.2
"""Skin touches skin that is at least so far off at rest, is at most so deep inside, and is moved so far out [mm]."""
OPPOSED = -0.3
"""Cosine of the normals of skin that touches, at most."""


def strengths(hand: HandModel, angles: Array) -> Array:
    """Strengths [C] of the product's shapes in a pose [15, 3]."""
    return corrective_coefficients(hand, torch.from_numpy(angles)).numpy()


def unposed(surface: Array, rest: Array, weights: Array, bones: Array) -> Array:
    """The displacement of the rest surface that blend skinning carries to `surface`, [V, 3]."""
    blend = np.tensordot(weights, bones, 1)
    return np.linalg.solve(blend[:, :, :3], (surface - blend[:, :, 3])[..., None])[..., 0] - rest


def fit_to_flesh(
    hand: HandModel, subdivision: sp.csr_matrix, learnt: Sequence[Simulation], others: Sequence[Array]
) -> Array:
    """Displacements of the coarse vertices by each shape [mm], [C, n, 3].

    Args:
        hand: float64.
        subdivision: Coarse vertices to the hand's.
        learnt: What flesh does.
        others: Angles [15, 3] of more poses, in which nothing shall lie inside.
    """
    rest, weights, faces = hand.template.numpy() * MILLIMETRES, hand.weights.numpy(), hand.faces.numpy()
    states = [(a, v * MILLIMETRES) for t in learnt for a, v in zip(t.angles, t.vertices, strict=True)]
    inputs = np.stack([strengths(hand, a) for a, _ in states])
    scale = np.sqrt((inputs**2).mean(0))
    inputs = inputs / scale
    wanted = np.stack([unposed(v, rest, weights, bones(hand, a)) for a, v in states])
    together = np.array([np.count_nonzero(a[:, 0]) > 1 for a, _ in states])
    weighted = inputs * np.where(together, POSE_WEIGHT, 1.0)[:, None]
    left = np.broadcast_to(weighted.T @ inputs + RIDGE * np.eye(inputs.shape[1]), (len(rest), *[inputs.shape[1]] * 2))
    left = left + np.eye(inputs.shape[1]) * np.where(_within_reach(hand), 0, ELSEWHERE)[:, None]
    right = np.tensordot(weighted.T, wanted, 1).transpose(1, 0, 2)

    coarse = scipy.sparse.linalg.splu((subdivision.T @ subdivision).tocsc())
    to_nail, _ = cKDTree(rest[hand.nail.numpy() > 0.5]).query(coarse.solve(subdivision.T @ rest))
    free = np.clip((to_nail - NAIL_BED) / (NAIL_FREE - NAIL_BED), 0, 1)[:, None]  # nails are rigid

    def solved(left: Array, right: Array) -> tuple[Array, Array]:
        """Of the coarse vertices, and what that is on the hand's."""
        fine = (np.linalg.solve(left, right) / scale[:, None]).transpose(1, 0, 2)
        found = np.stack([free * coarse.solve(subdivision.T @ shape) for shape in fine])
        return found, np.stack([subdivision @ shape for shape in found])

    poses = [a for a, _ in states] + list(others)
    given = [np.full_like(rest, np.nan) for _ in poses]
    found, basis = solved(left, right)
    for _ in range(ROUNDS):
        a, b = left.copy(), right.copy()
        for angles, target in zip(poses, given, strict=True):
            posed = bones(hand, angles)
            displacement = np.tensordot(strengths(hand, angles), basis, 1)
            inside, shift = overlaps(skinned(rest + displacement, weights, posed), rest, faces)
            rotation = np.tensordot(weights[inside], posed, 1)[:, :, :3]
            target[inside] = displacement[inside] + np.linalg.solve(rotation, shift[..., None])[..., 0]
            held = np.flatnonzero(~np.isnan(target[:, 0]))
            x = strengths(hand, angles) / scale
            a[held] += CONTACT_WEIGHT * np.outer(x, x)
            b[held] += CONTACT_WEIGHT * x[:, None] * target[held][:, None]
        found, basis = solved(a, b)
    return found


def overlaps(surface: Array, rest: Array, faces: Index) -> tuple[Index, Array]:
    """Vertices inside another part of the surface, [n], and half of the shifts that lead out of it [mm], [n, 3]."""
    normals = np.asarray(igl.per_vertex_normals(surface, faces))
    vertex, other = facing_skin(surface, normals, rest, reach=DEEPEST, cosine=OPPOSED, apart=APART)
    depth = ((surface[other] - surface[vertex]) * normals[other]).sum(-1)
    inside = (depth > -MARGIN) & (depth < DEEPEST)
    return vertex[inside], normals[other[inside]] * ((depth[inside] + MARGIN) / 2)[:, None]


def _within_reach(hand: HandModel) -> np.ndarray:
    """Whether each shape may move each vertex, [V, C]: on its own finger, on those beside it and on the palm."""
    order = {FIRST[finger] + i: place for place, finger in enumerate(FINGERS) for i in range(3)}
    of_joint = np.array([order[joint] for joint in range(1, len(hand.parents))])
    of_vertex = np.array([order.get(joint, -1) for joint in hand.segment.tolist()])
    beside = np.abs(of_vertex[:, None] - of_joint) <= 1
    return np.repeat(beside | (of_vertex < 0)[:, None], 2, axis=1)
