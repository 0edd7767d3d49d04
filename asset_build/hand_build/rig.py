"""The skeleton in the mesh: its frame, its skinning weights, how far each joint turns, and labels of the vertices."""

from typing import NamedTuple

import igl
import numpy as np
import scipy.optimize
import scipy.sparse as sp
import scipy.sparse.linalg

from hand_build.anatomy import FINGERS, FIRST, JOINTS, Array, Index, bone_ends, finger_chain, unit
from oasis_warp.synthetic.body import rising

HEAT = 1.0
"""Strength c of the pull to the nearest bone; larger makes the weights sharper."""
SMALLEST_WEIGHT = 0.01
"""Weights below are dropped. Keeping only the four largest instead would move the skin of a fist by up to 3 mm."""
REGRESSOR_REACH = 160
"""Number of nearest vertices that a joint may be regressed from."""
STEADY = 0.008, 0.025
"""Distances from the wrist's rim up to which skin does not follow the fingers, and from which it does wholly [m]."""

# Anatomical ranges of flexion, abduction and twist [degrees]; 0 flexion is a straight finger, the thumb's base counts
# from rest. Clinical tables of flexion with some slack; the thumb's base, sideways play and twist are judgement.
FINGER_RANGES = (
    ((-25, 90), (-20, 20), (-8, 8)),
    ((-5, 110), (-4, 4), (-4, 4)),
    ((-10, 80), (-3, 3), (-3, 3)),
)
THUMB_RANGES = (
    ((-35, 45), (-40, 35), (-25, 35)),
    ((-15, 65), (-10, 10), (-10, 10)),
    ((-20, 85), (-5, 5), (-5, 5)),
)

NAIL_REACH = 0.02
"""A nail's faces are nearer to the tip of their finger than this [m]."""


class Labels(NamedTuple):
    """Where each vertex lies on the skeleton."""

    segment: Index
    """Joint with the largest weight."""
    side: Index
    """0 palm, 1 back, 2 flank."""
    bone_t: Array
    """Position along the bone of `segment`: 0 at the joint, 1 at the next."""
    bone_theta: Array
    """Angle of the normal about that bone [rad]: 0 back, +-pi palm."""


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

    Heat decides between the palm and each whole finger, which repairs what moving the pivots broke; the split of a
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


def moving_share(vertices: Array, rim: Index) -> Array:
    """How far skin follows the fingers, by its distance from the rim of the wrist, which the arm continues, [V]."""
    return rising(np.linalg.norm(vertices[:, None] - vertices[rim], axis=2).min(1), *STEADY)


def steady_wrist(weights: Array, vertices: Array, rim: Index) -> Array:
    """Skinning weights whose share of the fingers ends at the wrist: an arm of 12 cm swayed by 14 mm with the thumb."""
    share = moving_share(vertices, rim)[:, None]
    return share * weights + (1 - share) * np.eye(len(JOINTS))[0]


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


def pose_axes(vertices: Array, quads: Index, points: Array, nail_quads: Index) -> Array:
    """Unit axes of each joint at rest, [16, 3, 3]; rows flexion, abduction (also "to the back"), twist.

    A finger flexes in the plane of its nail's normal, which agrees with the plane of its joints within 10 to 15
    degrees and, unlike that, does not depend on how straight the finger is at rest.
    """
    axes = np.tile(np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]]), (16, 1, 1))
    normals = np.cross(vertices[quads[:, 2]] - vertices[quads[:, 0]], vertices[quads[:, 3]] - vertices[quads[:, 1]])
    centres = vertices[quads].mean(1)
    for finger in FINGERS:
        chain = finger_chain(points, finger)
        on_nail = nail_quads & (np.linalg.norm(centres - chain[3], axis=1) < NAIL_REACH)
        across = unit(np.cross(unit(normals[on_nail].sum(0)), chain[3] - chain[2]))
        for i in range(3):
            along = unit(chain[i + 1] - chain[i])
            flexion = unit(across - (across @ along) * along)
            axes[FIRST[finger] + i] = np.stack([flexion, np.cross(along, flexion), along])
    return axes


def pose_limits(points: Array, axes: Array) -> tuple[Array, Array]:
    """Limits relative to rest [16, 3, 2] and the flexion that rest already has [16], in radians."""
    limits, bend = np.zeros((16, 3, 2)), np.zeros(16)
    limits[0] = [-np.pi, np.pi]
    for finger in FINGERS:
        bones = np.diff(np.vstack([points[0], finger_chain(points, finger)]), axis=0)
        for i, ranges in enumerate(THUMB_RANGES if finger == "thumb" else FINGER_RANGES):
            joint = FIRST[finger] + i
            axis = axes[joint, 0]
            before, after = (unit(bone - (bone @ axis) * axis) for bone in bones[i : i + 2])
            if (finger, i) != ("thumb", 0):
                bend[joint] = np.arctan2(np.cross(before, after) @ axis, before @ after)
            limits[joint] = np.radians(ranges)
            limits[joint, 0] -= bend[joint]
    return limits, bend


def labels(vertices: Array, faces: Index, points: Array, weights: Array, axes: Array) -> Labels:
    """Segment, side and bone coordinates of each vertex."""
    segment = weights.argmax(1)
    normals = igl.per_vertex_normals(vertices, faces)
    ends = bone_ends(points) | {0: points[FIRST["middle"]]}
    along_bone, theta = np.zeros(len(vertices)), np.zeros(len(vertices))
    for joint, end in ends.items():
        on = segment == joint
        along = end - points[joint]
        along_bone[on] = (vertices[on] - points[joint]) @ along / (along @ along)
        theta[on] = np.arctan2(normals[on] @ axes[joint, 0], normals[on] @ axes[joint, 1])
    turned = np.abs(theta)
    side = np.where(turned < np.radians(60), 1, np.where(turned > np.radians(120), 0, 2))
    return Labels(segment, side, along_bone, theta)


def tip_vertices(vertices: Array, points: Array) -> Index:
    """The foremost vertex of each finger, thumb to little, [5]."""
    found = []
    for finger in FINGERS:
        chain = finger_chain(points, finger)
        ahead = vertices @ unit(chain[3] - chain[2])
        ahead[np.linalg.norm(vertices - chain[3], axis=1) > 0.015] = -np.inf
        found.append(int(ahead.argmax()))
    return np.array(found)
