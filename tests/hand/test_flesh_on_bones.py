"""Simulated flesh keeps the laws of elasticity, and correctives are fitted to what it does."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from elastic_hand import correctives, flesh, simulations
from elastic_hand.correctives import fit_to_flesh, overlaps, strengths, unposed
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
    np.testing.assert_allclose(unposed(want, rest, weights, moved), 0, atol=1e-7)


def test_fitted_shapes_correct_the_poses_that_they_were_fitted_to(hand, monkeypatch):
    monkeypatch.setattr(correctives, "ROUNDS", 1)
    exact = hand.to(dtype=torch.float64)
    rest, weights = 1e3 * exact.template.numpy(), exact.weights.numpy()
    own = hand.segment.numpy() == hand.joint_names.index("index2")
    bulge, made = own[:, None] * [0, 1.0, 0], []
    for bend in simulations.bends(exact)[:15]:  # each joint alone
        states = np.stack([bend.angles * share for share in (0.5, 1.0)])
        surfaces = [skinned(rest + (1 - np.cos(a[1, 0])) * bulge, weights, simulations.bones(exact, a)) for a in states]
        vertices, nothing = np.stack(surfaces) / 1e3, np.zeros(2)
        made.append(simulations.Simulation(bend.name, "train", states, vertices, 1 + nothing, nothing))
    shapes = fit_to_flesh(exact, sp.eye(len(rest), format="csr"), made, [])
    bent = next(each for each in made if each.name == "index2").angles[1]
    found, wanted = np.tensordot(strengths(exact, bent), shapes, 1), (1 - np.cos(bent[1, 0])) * bulge
    assert np.linalg.norm(found - wanted, axis=1)[own].mean() < 0.5 * np.linalg.norm(wanted, axis=1)[own].mean()
    assert np.abs(shapes)[:, hand.nail.numpy() > 0.5].max() == 0


def test_a_hand_at_rest_lies_nowhere_inside_itself(hand):
    rest = 1e3 * hand.template.double().numpy()
    inside, _ = overlaps(rest, rest, hand.faces.numpy())
    assert not len(inside)


def test_shifts_of_overlaps_lead_out_of_a_fist_that_crosses_itself(hand):
    exact = hand.to(dtype=hand.template.double().dtype)
    rest, faces = 1e3 * exact.template.numpy(), hand.faces.numpy()
    fist = skinned(rest, exact.weights.numpy(), simulations.bones(exact, named_pose(exact, "fist").numpy()))
    crossings = self_crossings(fist, faces)
    for _ in range(4):
        inside, shift = overlaps(fist, rest, faces)
        assert np.linalg.norm(shift, axis=1).max() < 4.2
        fist[inside] += shift
    assert self_crossings(fist, faces) < crossings / 2
