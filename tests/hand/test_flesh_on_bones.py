"""Simulated flesh keeps the laws of elasticity; correctives fitted to it bend fingers without losing volume."""

import dataclasses
import itertools
import math

import igl
import numpy as np
import pytest
import scipy.sparse as sp
import torch
from elastic_hand import correctives, flesh, simulations
from elastic_hand.correctives import fit_to_flesh, overlaps, strengths, unposed
from elastic_hand.solid import Solid, outer_faces, skinned
from hand_build.quality import enclosed_volume, self_crossings
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from oasis_warp.core.types import HandPose
from oasis_warp.hand.contact import resolve_contact
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import bone_transforms, corrective_coefficients, rest_hand, skin


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


def test_shifts_of_overlaps_lead_out_of_a_hand_that_crosses_itself(hand):
    exact = hand.to(dtype=hand.template.double().dtype)
    rest, faces = 1e3 * exact.template.numpy(), hand.faces.numpy()
    surface = skinned(rest, exact.weights.numpy(), simulations.bones(exact, named_pose(exact, "victory").numpy()))
    crossings = self_crossings(surface, faces)
    for _ in range(4):
        inside, shift = overlaps(surface, rest, faces)
        assert np.linalg.norm(shift, axis=1).max() < 4.2
        surface[inside] += shift
    assert self_crossings(surface, faces) < crossings / 2


def test_fingers_of_named_poses_do_not_pass_through_each_other(hand):
    """Fists had up to 239 edges that pass through a face."""
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1]))
    poses = (HandPose(named_pose(hand, name), torch.eye(3), torch.zeros(3)) for name in POSE_NAMES)
    surfaces = (resolve_contact(hand, skin(hand, rest, pose).vertices).vertices for pose in poses)
    assert sum(self_crossings(vertices.numpy(), hand.faces.numpy()) for vertices in surfaces) <= 40


HINGES = [2, 3, 5, 6, 8, 9, 11, 12, 14, 15]


@pytest.fixture(scope="module")
def plain(hand):
    return dataclasses.replace(hand, corrective_basis=hand.corrective_basis[..., :0])


def bent(hand, joint, share):
    angles = torch.zeros(15, 3)
    angles[joint - 1, 0] = share * hand.pose_limits[joint, 0, 1]
    return angles


def surface(hand, angles):
    pose = HandPose(angles, torch.eye(3), torch.zeros(3))
    return skin(hand, rest_hand(hand, torch.zeros(40)), pose).vertices.double().numpy()


def volume(hand, angles):
    return enclosed_volume(surface(hand, angles), hand.faces.numpy(), hand.rim.numpy())


def test_at_rest_strengths_and_their_slopes_are_zero(hand):
    angles = torch.zeros(15, 3, requires_grad=True)
    strengths = corrective_coefficients(hand, angles)
    assert strengths.eq(0).all()
    (slope,) = torch.autograd.grad(strengths.sum(), angles)
    assert slope.eq(0).all()


def test_strengths_have_gradients_that_match_finite_differences(hand):
    exact = hand.to(dtype=torch.float64)
    angles = torch.rand(15, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: corrective_coefficients(exact, a), angles)


def test_a_hand_without_correctives_keeps_its_rest_surface(plain):
    angles = torch.full((15, 3), 0.3)
    assert corrective_coefficients(plain, angles).shape == (0,)
    rest = rest_hand(plain, torch.zeros(40))
    pose = HandPose(angles, torch.eye(3), torch.zeros(3))
    rotation, translation = bone_transforms(plain, rest.joints, pose)
    moved = (rotation @ rest.vertices[:, None, :, None])[..., 0] + translation
    alone = (plain.weights[..., None] * moved).sum(1)
    torch.testing.assert_close(skin(plain, rest, pose).vertices, alone, rtol=0, atol=1e-6)


def test_a_hand_with_other_correctives_is_refused(hand):
    odd = dataclasses.replace(hand, corrective_basis=hand.corrective_basis[..., :7])
    with pytest.raises(ValueError, match="hand: expected 0 or 30 or 135 pose correctives, got 7"):
        corrective_coefficients(odd, torch.zeros(15, 3))
    with pytest.raises(ValueError, match="hand: expected 0 or 30 or 135 pose correctives, got 7"):
        surface(odd, torch.zeros(15, 3))


def test_each_joint_corrects_its_own_finger_those_beside_it_and_the_palm(hand):
    reach = hand.corrective_basis.unflatten(-1, (15, 2)).abs().amax((1, 3)) > 1e-4
    row = ["thumb", "index", "middle", "ring", "little"]
    for joint in range(1, 16):
        touched = reach[:, joint - 1]
        assert touched.sum() > 500
        place = row.index(hand.joint_names[joint][:-1])
        far = [other for other in (3, 6, 9, 12, 15) if abs(row.index(hand.joint_names[other][:-1]) - place) > 1]
        assert not (touched & torch.isin(hand.segment, torch.tensor(far))).any()


@pytest.mark.parametrize("joint", HINGES)
def test_a_finger_joint_folds_without_crossing_itself(hand, joint):
    assert self_crossings(surface(hand, bent(hand, joint, 0.75)), hand.faces.numpy()) == 0


def test_blend_skinning_alone_would_cross_itself(hand, plain):
    angles = bent(hand, hand.joint_names.index("index2"), 0.75)
    assert self_crossings(surface(plain, angles), hand.faces.numpy()) > 20


@pytest.mark.parametrize("name", ["fist", "thumbs_up", "pinch", "ok"])
def test_a_pose_gets_a_third_of_its_lost_volume_back(hand, plain, name):
    rest = volume(hand, torch.zeros(15, 3))
    angles = named_pose(hand, name)
    lost_before, lost = rest - volume(plain, angles), rest - volume(hand, angles)
    assert -1e-6 < lost < 2 / 3 * lost_before  # knuckles that stand out add up to 1 cm^3


def test_nails_keep_their_shape(hand):
    moved = hand.corrective_basis[hand.nail > 0.5].norm(dim=1).amax()
    assert moved < 1e-3  # at strength 1, a bend by 90 degrees


def test_knuckles_of_a_bent_row_stand_over_the_hollows_between_them(hand):
    """A fist from its back was a block with bevelled corners: .6 to 2.8 mm."""
    firsts = [hand.joint_names.index(f"{finger}1") for finger in ("index", "middle", "ring", "little")]
    angles = torch.zeros(15, 3)
    angles[[joint - 1 for joint in firsts], 0] = math.pi / 2
    posed, rest = torch.from_numpy(surface(hand, angles)), hand.template
    on_back = torch.from_numpy(igl.per_vertex_normals(rest.double().numpy(), hand.faces.numpy()))[:, 1] > 0.5
    out = posed.new_tensor([-(0.5**0.5), 0.5**0.5, 0])  # away from palm and wrist

    def height(place):
        aside = (rest - place)[:, [0, 2]].norm(dim=1).masked_fill(~on_back, torch.inf)
        return float((posed[aside.topk(6, largest=False).indices] @ out).mean())

    for first, second in itertools.pairwise(hand.joints[firsts]):
        assert (height(first) + height(second)) / 2 - height((first + second) / 2) > 1.8e-3
