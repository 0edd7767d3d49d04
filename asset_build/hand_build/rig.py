"""Where the hand lies, and which bone moves which part of its skin."""

import igl
import numpy as np
import scipy.optimize
import scipy.sparse as sp
import scipy.sparse.linalg

from hand_build.anatomy import FINGERS, FIRST, JOINTS, Array, Index, finger_chain, unit

HEAT = 1.0
"""Strength c of the pull to the nearest bone; larger makes the weights sharper."""
SMALLEST_WEIGHT = 0.01
"""Weights below are dropped. Keeping only the four largest instead would move the skin of a fist by up to 3 mm."""
REGRESSOR_REACH = 160
"""Number of nearest vertices that a joint may be regressed from."""


def hand_frame(points: Array) -> Array:
    """Rows: the axes of the hand's frame (fingers -x, palm -y, thumb +z) seen from the frame of `points`."""
    wrist = points[0]
    forward = unit(points[FIRST["middle"]] - wrist)
    palm = unit(np.cross(points[FIRST["index"]] - wrist, points[FIRST["little"]] - wrist))
    thumb = unit(np.cross(forward, palm))
    return np.stack([-forward, -np.cross(thumb, forward), thumb])


def best_rotation(source: Array, target: Array) -> Array:
    """The rotation R that brings the centred points `source` nearest to `target`: R source_i ~ target_i (Kabsch)."""
    u, _, vt = np.linalg.svd((source - source.mean(0)).T @ (target - target.mean(0)))
    return vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T


def _distance_to_segment(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def _heat_weights(vertices: Array, faces: Index, bones: list[list[tuple[Array, Array]]]) -> Array:
    """Bone heat on the surface: -Lap w + (c / d^2) w = (c / d^2) [nearest bone] (Baran & Popovic 2007), [V, bones]."""
    distance = np.stack(
        [np.min([_distance_to_segment(vertices, a, b) for a, b in segments], 0) for segments in bones], 1
    )
    nearest = distance <= distance.min(1, keepdims=True) * 1.0001
    wanted = nearest / nearest.sum(1, keepdims=True)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
    pull = mass @ sp.diags(HEAT / distance.min(1) ** 2)
    return scipy.sparse.linalg.splu((-igl.cotmatrix(vertices, faces) + pull).tocsc()).solve(pull @ wanted)


def skinning_weights(vertices: Array, faces: Index, points: Array, phalanx_shares: dict[str, Array]) -> Array:
    """Skinning weights [V, 16], rows sum to one.

    Heat decides between the palm and each whole finger, which mends what moving the pivots broke; the split of a
    finger over its phalanges stays the artists' (`phalanx_shares`), which follows the creases. The palm and its
    metacarpals are one bone, the wrist's.
    """
    palm = [(points[0], points[FIRST[finger]]) for finger in FINGERS]
    fingers = []
    for finger in FINGERS:
        chain = finger_chain(points, finger)
        fingers.append([(chain[i], chain[i + 1]) for i in range(3)])
    whole = _heat_weights(vertices, faces, [palm, *fingers])
    weights = np.zeros((len(vertices), len(JOINTS)))
    weights[:, 0] = whole[:, 0]
    for k, finger in enumerate(FINGERS, 1):
        weights[:, FIRST[finger] : FIRST[finger] + 3] = whole[:, [k]] * phalanx_shares[finger]
    weights[weights < SMALLEST_WEIGHT] = 0
    return weights / weights.sum(1, keepdims=True)


def joint_regressor(hands: Array, joints: Array, template: Array, template_joints: Array) -> Array:
    """Joints as non-negative means of vertices, [16, V], fitted over `hands` [B, V, 3] and the template.

    For code that expects MANO's regressor; `joint_shapedirs` of the asset is exact where this is 0.6 mm off.
    """
    regressor = np.zeros((len(template_joints), len(template)))
    for i, joint in enumerate(template_joints):
        near = np.argsort(np.linalg.norm(template - joint, axis=1))[:REGRESSOR_REACH]
        n = len(near)
        samples = hands[:, near].transpose(0, 2, 1).reshape(-1, n)
        rows = np.vstack([samples, 3 * template[near].T, 10.0 * np.ones((1, n)), 1e-3 * np.eye(n)])
        wanted = np.concatenate([joints[:, i].ravel(), 3 * joint, [10.0], np.zeros(n)])
        share, _ = scipy.optimize.nnls(rows, wanted)
        share[share < 1e-3] = 0
        regressor[i, near] = share / share.sum()
    return regressor
