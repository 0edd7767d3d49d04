"""The measuring stick of skinning keeps the laws of elasticity, and what is measured keeps those of skinning."""

import numpy as np
import pytest
from elastic_hand import flesh, methods, truths
from elastic_hand.methods import ways_out
from elastic_hand.solid import Solid, outer_faces, skinned
from hand_build.quality import self_crossings
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from oasis_warp.hand.poses import named_pose


@pytest.fixture(scope="module")
def bar():
    """A bar along x, its left end one bone, its right end another."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(0, 31, 3.0), np.arange(0, 7, 3.0), np.arange(0, 7, 3.0)), -1).reshape(-1, 3)
    nodes = grid + rng.uniform(-0.2, 0.2, grid.shape)
    tetrahedra = Delaunay(nodes).simplices.astype(np.int64)
    corners = nodes[tetrahedra]
    short = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=3).max((1, 2)) < 6  # none along a flat side
    tetrahedra = tetrahedra[short]
    volume = np.linalg.det(nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]])
    tetrahedra[volume < 0] = tetrahedra[volume < 0][:, [1, 0, 2, 3]]
    tetrahedra = tetrahedra[np.abs(volume) > 0.1]
    bone = np.where(grid[:, 0] < 7, 0, np.where(grid[:, 0] > 23, 1, -1))
    return flesh.Flesh(Solid(nodes, tetrahedra, outer_faces(tetrahedra), bone, np.arange(len(nodes))))


def bones(turn, shift):
    """Bone 1 and the rest of 16 moved, bone 0 not."""
    one = np.concatenate([np.eye(3), np.zeros((3, 1))], 1)
    moved = np.concatenate([turn.as_matrix(), np.asarray(shift, float)[:, None]], 1)
    return np.stack([one, *[moved] * 15])


REST = bones(Rotation.identity(), [0, 0, 0])


def test_forces_are_the_slope_of_the_energy(bar):
    rng = np.random.default_rng(1)
    at, way = bar.solid.nodes + rng.normal(0, 0.2, bar.solid.nodes.shape), rng.normal(0, 1, bar.solid.nodes.shape)
    touching = flesh.Contacts(np.array([3, 5]), np.array([40, 50]), np.eye(3)[:2], np.array([1.0, 2.0]))
    _, slope = bar.energy(at, touching)
    ahead, behind = (bar.energy(at + sign * 1e-2 * way, touching)[0] for sign in (1, -1))
    assert (slope * way).sum() == pytest.approx((ahead - behind) / 2e-2, rel=2e-3)  # single precision


def test_rotations_are_the_polar_factors_also_of_mirrored_matrices():
    matrices = np.random.default_rng(2).normal(0, 1, (200, 3, 3))
    u, _, vt = np.linalg.svd(matrices)
    u[np.linalg.det(u @ vt) < 0, :, 2] *= -1
    got = flesh.nearest_rotations(matrices.transpose(1, 2, 0).astype(np.float32))
    np.testing.assert_allclose(got.transpose(2, 0, 1), u @ vt, atol=1e-3)


def test_flesh_whose_bones_move_together_moves_with_them(bar):
    turn, shift = Rotation.from_rotvec([0.3, -0.2, 0.5]), [4, -2, 7]
    moved = bones(turn, shift)
    moved[0] = moved[1]
    got = bar.bend(bar.solid.nodes, REST, moved)
    np.testing.assert_allclose(got, turn.apply(bar.solid.nodes) + shift, atol=1e-3)


def test_bent_flesh_keeps_the_volume_that_blending_loses(bar):
    turn = Rotation.from_rotvec([0, 0, np.radians(70)])
    centre = np.array([15.0, 3, 3])
    after = bones(turn, centre - turn.apply(centre))
    blended = skinned(bar.solid.nodes, bar.weights, after)
    half = bones(Rotation.from_rotvec([0, 0, np.radians(35)]), np.zeros(3))
    half[1:, :, 3] = centre - half[1, :, :3] @ centre
    settled = bar.bend(bar.bend(bar.solid.nodes, REST, half), half, after)
    share = bar.volume / bar.volume.sum()
    assert bar.swelling(blended) @ share < 0.93
    assert bar.swelling(settled) @ share > 0.96
    assert bar.swelling(settled).min() > 0


def test_skin_that_enters_other_skin_is_found(bar):
    turn = Rotation.from_rotvec([0, 0, np.radians(178)])
    centre = np.array([15.0, 9, 3])  # folds the bar onto itself, half a millimetre deep
    shift = centre - turn.apply(centre) - [0, 5.5, 0]
    folded = bar.solid.nodes.copy()
    right = folded[:, 0] > 16
    folded[right] = turn.apply(folded[right]) + shift
    found = bar.contacts(folded)
    assert len(found.node) > 5
    assert not len(bar.contacts(bar.solid.nodes).node)
    assert (right[found.node] != right[found.other]).all()


def test_a_rigid_motion_leaves_nothing_to_correct(hand):
    rest, weights = hand.template.double().numpy(), hand.weights.double().numpy()
    turn, shift = Rotation.from_rotvec([0.4, 1.9, -0.7]), np.array([0.1, 0.2, -0.3])
    moved = bones(turn, shift)
    moved[0] = moved[1]
    want = turn.apply(rest) + shift
    mush = methods.DeltaMush(rest, hand.faces.numpy(), hand.rim.numpy(), 3)
    np.testing.assert_allclose(mush(want), want, atol=1e-12)
    np.testing.assert_allclose(methods.dual_quaternions(rest, weights, moved), want, atol=1e-7)
    np.testing.assert_allclose(methods.unposed(want, rest, weights, moved), 0, atol=1e-7)


def test_fitted_shapes_find_the_shapes_that_made_the_poses(hand):
    exact = hand.to(dtype=hand.template.double().dtype)
    features = methods.flexion_features(exact)
    rng = np.random.default_rng(3)
    angles, made = rng.uniform(-0.4, 1.6, (120, 15, 3)), rng.normal(0, 1, (30, 7, 3))
    wanted = np.stack([np.tensordot(features(a), made, 1) for a in angles])
    fitted = methods.fit_shapes(features, angles, wanted, np.arange(120))
    np.testing.assert_allclose(fitted.displacement(angles[5]), wanted[5], atol=0.02)
    whole = methods.low_rank(fitted, 21)  # all there are: 7 points x 3
    np.testing.assert_allclose(whole.displacement(angles[5]), fitted.displacement(angles[5]), atol=1e-10)


def test_a_hand_at_rest_lies_nowhere_inside_itself(hand):
    rest = 1e3 * hand.template.double().numpy()
    inside, _ = ways_out(rest, rest, hand.faces.numpy())
    assert not len(inside)


def test_ways_out_lead_out_of_a_fist_that_crosses_itself(hand):
    exact = hand.to(dtype=hand.template.double().dtype)
    rest, faces = 1e3 * exact.template.numpy(), hand.faces.numpy()
    fist = skinned(rest, exact.weights.numpy(), truths.bones(exact, named_pose(exact, "fist").numpy()))
    crossings = self_crossings(fist, faces)
    for _ in range(4):
        inside, way = ways_out(fist, rest, faces)
        assert np.linalg.norm(way, axis=1).max() < 4.2
        fist[inside] += way
    assert self_crossings(fist, faces) < crossings / 2
