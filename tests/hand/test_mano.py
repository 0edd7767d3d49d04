"""MANO's files, its surface and the hand that is made of it, on files in its format that hold the bundled hand."""

import json
import pickle
import subprocess
import sys
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
from mano_files import SHIFT, left_arrays, mano_arrays, rest_angles, write_mano
from scipy.spatial.transform import Rotation
from synthetic import avatar_of, crop_of

from oasis_warp.assets import asset
from oasis_warp.core import surface
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.pickle_reader import read_pickle
from oasis_warp.core.types import HandPose
from oasis_warp.export import export_avatar
from oasis_warp.hand import mano_hand as making
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.mano import (
    ManoPose,
    hand_pose,
    mano_hd,
    mano_surface,
    mirror_mano_pose,
    read_mano,
    rotations,
)
from oasis_warp.hand.mano_hand import fit_vertices
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import bone_transforms, rest_hand, skin
from oasis_warp.hand.template import MANO_DIR, chosen_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.reconstruction import reconstruct


def random_pose(seed, size=0.6):
    random = np.random.default_rng(seed)
    return ManoPose(
        random.normal(size=10), random.normal(size=3), size * random.normal(size=(15, 3)), random.normal(size=3)
    )


def smplx_layer(arrays, pose):
    """The layer of smplx, by 4 x 4 matrices: vertices and joints (Loper et al. 2015)."""
    turns = Rotation.from_rotvec(np.concatenate([pose.global_orient[None], pose.hand_pose])).as_matrix()
    shaped = arrays["v_template"] + arrays["shapedirs"] @ pose.betas
    joints = arrays["J_regressor"] @ shaped
    posed = shaped + np.einsum("vkc,c->vk", arrays["posedirs"], (turns[1:] - np.eye(3)).reshape(-1))
    chains = []
    for j, parent in enumerate(arrays["kintree_table"][0].astype(np.int64)):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turns[j], joints[j] - (joints[parent] if j else 0)
        chains.append(chains[parent] @ local if j else local)
    places = np.stack([chain[:3, 3] for chain in chains])
    for chain, joint in zip(chains, joints, strict=True):
        chain[:3, 3] -= chain[:3, :3] @ joint
    blended = np.einsum("vj,jab->vab", arrays["weights"], np.stack(chains))
    points = np.einsum("vab,vb->va", blended, np.c_[posed, np.ones(len(posed))])[:, :3]
    return points + pose.transl, places + pose.transl


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("chumpy", [True, False])
def test_the_surface_is_that_of_smplx_layer(side, chumpy, tmp_path):
    model = read_mano(write_mano(tmp_path, chumpy=chumpy), side)
    arrays = mano_arrays()
    if side == "left":  # with the sign of its shapes corrected, as smplx's users do
        arrays = left_arrays(arrays) | {"shapedirs": arrays["shapedirs"] * np.array([-1.0, 1, 1])[:, None]}
    for seed in range(5):
        pose = random_pose(seed)
        for got, want in zip(mano_surface(model, pose), smplx_layer(arrays, pose), strict=True):
            assert np.abs(got - want).max() < 1e-6


def test_components_and_mean_pose_are_those_of_smplx_options(mano_dir):
    model, arrays, some = read_mano(mano_dir), mano_arrays(), np.random.default_rng(0).normal(size=45)
    want = (some[:12] @ arrays["hands_components"][:12] + arrays["hands_mean"]).reshape(15, 3)
    assert np.allclose(hand_pose(model, some[:12], flat_hand_mean=False), want, atol=1e-12)
    assert np.allclose(hand_pose(model, some, flat_hand_mean=True), some.reshape(15, 3))
    with pytest.raises(ValueError, match="45 angles or 1 to 44 components, got 46"):
        hand_pose(model, np.zeros(46), flat_hand_mean=True)


def test_the_left_hand_is_the_mirror_image_of_the_right_one(mano_dir):
    right, left, pose = read_mano(mano_dir), read_mano(mano_dir, "left"), random_pose(0)
    mirrored = mano_surface(right, pose)[0] * [-1, 1, 1]
    assert np.abs(mano_surface(left, mirror_mano_pose(pose))[0] - mirrored).max() < 1e-12


def test_mano_hd_has_its_counts_and_an_open_wrist(mano_dir):
    model = read_mano(mano_dir)
    fine = mano_hd(model)
    assert fine.template.shape == (12_337, 3) and fine.faces.shape == (24_608, 3)
    assert int(surface.open_vertices(torch.from_numpy(fine.faces), 12_337).sum()) == 64
    assert np.allclose(fine.weights.sum(1), 1) and np.array_equal(fine.weights[:778], model.weights)
    normals = [
        np.cross(*(each.template[each.faces[:, k]] - each.template[each.faces[:, 0]] for k in (1, 2))).sum(0)
        for each in (model, fine)
    ]
    assert normals[0] @ normals[1] > 0.98 * np.linalg.norm(normals[0]) * np.linalg.norm(normals[1])


def test_its_vertices_lie_where_the_bundled_hand_has_the_same_skin(mano):
    kinematics = HandKinematics(chosen_hand("bundled"))
    joints = kinematics.pose_all_joints(rest_angles(), np.zeros(40))
    same = kinematics.pose_surface(joints, kinematics.template) + SHIFT
    found = mano.template.double().numpy() + mano.origin.wrist.numpy()
    error = np.linalg.norm(found - same, axis=1)
    assert error.mean() < 1.5e-3 and error.max() < 4e-3  # the file has 6 mm edges, and fingers glide in themselves
    crosses = [np.cross(x[mano.faces[:, 1]] - x[mano.faces[:, 0]], x[mano.faces[:, 2]] - x[mano.faces[:, 0]])
               for x in (found, same)]  # fmt: skip
    assert ((crosses[0] * crosses[1]).sum(1) > 0).all()  # no face turned over


def test_every_bone_ends_at_its_own_fingers_joint_or_tip(hand):
    """The ends of ring and little finger were swapped: that bone was 51 mm long instead of 24."""
    rows = torch.cat([hand.joints, hand.tips])
    for joint, end in making.bone_ends().items():
        assert float((rows[end] - rows[joint]).norm()) < 0.06
        if end > 15:
            others = (rows[16:] - rows[joint]).norm(dim=1)
            assert int(others.argmin()) == end - 16


def test_its_parameters_pass_in_and_out(mano, mano_dir):
    fine = mano_hd(read_mano(mano_dir))
    found = mano.template.double().numpy() + mano.origin.wrist.numpy()
    _, face, near = igl.point_mesh_squared_distance(found, fine.template, fine.faces)
    shares = making._barycentrics(near, fine.template[fine.faces[face]])
    exact = mano.to(dtype=torch.float64)
    for seed in range(3):
        pose = random_pose(seed)
        ours = making.hand_pose_of_mano(mano, pose)
        posed = skin(exact, rest_hand(exact, torch.from_numpy(pose.betas)), ours)
        vertices, joints = mano_surface(fine, pose)
        assert np.abs(posed.joints.numpy() - joints).max() < 1e-6
        places = np.einsum("vc,vck->vk", shares, vertices[fine.faces[face]])
        assert np.abs(posed.vertices.numpy() - places).max() < 4e-4  # a blend within a face is no blend of its corners
        back = making.mano_of_hand_pose(mano, torch.from_numpy(pose.betas), ours)
        assert np.abs(back.transl - pose.transl).max() < 1e-6
        for vectors, given in ((back.hand_pose, pose.hand_pose), (back.global_orient, pose.global_orient)):
            assert np.abs(rotations(vectors) - rotations(given)).max() < 1e-6


@pytest.mark.parametrize("name", POSE_NAMES)
def test_named_poses_turn_its_bones_as_those_of_the_bundled_hand(mano, name):
    bundled = chosen_hand("bundled")
    angles = named_pose(mano, name)
    if name == "rest":
        assert not angles.any()
        return
    rest = mano.origin.rest_angles[1:]
    turns = []
    for hand, pose in ((bundled, named_pose(bundled, name).double()), (bundled, rest), (mano, angles.double())):
        still = torch.eye(3).double(), torch.zeros(3).double()
        turns.append(bone_transforms(hand.to(dtype=torch.float64), hand.joints.double(), HandPose(pose, *still))[0])
    goal = turns[0] @ turns[1].mT  # from the pose in which MANO rests
    frame = mano.pose_axes[1].double().mT @ bundled.pose_axes[1].double()  # of a child of the wrist: file to file
    assert (frame @ goal @ frame.mT - turns[2]).abs().max() < 1e-5


@pytest.mark.slow
def test_our_hand_fits_its_surface_and_back(mano, hand):
    """Millimetres that docs/hand.md states."""
    ours, other = HandKinematics(hand), HandKinematics(mano)
    bent = named_pose(hand, "relaxed").double().numpy()
    points = ours.surface(ours.pose_all_joints(np.concatenate([np.zeros((1, 3)), bent]), np.zeros(40)))
    there = fit_vertices(other, points).vertices(other)
    back = fit_vertices(ours, there).vertices(ours)
    for found, goal, most in ((there, points, 2.5e-3), (back, there, 2e-3), (back, points, 3e-3)):
        assert np.sqrt(((found - goal) ** 2).sum(1).mean()) < most


def test_an_avatar_of_it_survives_its_file_and_says_what_it_needs(mano, mano_dir, tmp_path, monkeypatch):
    crop, truth, pose = crop_of(mano, torch.full((len(mano.template), 3), 0.5), size=48)
    avatar_of(mano, truth, pose, crop.camera).save(tmp_path / "a.safetensors")
    monkeypatch.delenv(MANO_DIR, raising=False)
    with pytest.raises(InputError, match="MANO_RIGHT.pkl, got none; set OASIS_MANO_DIR"):
        Avatar.load(tmp_path / "a.safetensors")
    monkeypatch.setenv(MANO_DIR, str(mano_dir))
    back = Avatar.load(tmp_path / "a.safetensors")
    assert back.hand.name == "mano" and torch.equal(back.mesh(pose).vertices, skin(mano, back.rest, pose).vertices)
    assert back.in_even_light().hand.name == "mano"


@pytest.mark.slow
def test_a_photo_becomes_an_avatar_of_it_whose_file_gives_its_parameters(mano_dir, tmp_path, monkeypatch):
    monkeypatch.setenv(MANO_DIR, str(mano_dir))
    config = ReconstructConfig(hand_model="mano", mano_dir=mano_dir, prior="none", size=128, steps=5)
    made = reconstruct(Path(str(asset("photos", "palm_open_left_02.png"))), config)
    assert made.errors["input_psnr_db"] > 24 and made.errors["mask_iou"] > 0.88  # the bundled hand has .93
    made.avatar.save(tmp_path / "a.safetensors")
    avatar = Avatar.load(tmp_path / "a.safetensors")
    for name in ("a.glb", "a.json", "a.ply", "a.obj"):
        export_avatar(avatar, tmp_path / name)
    found = json.loads((tmp_path / "a.json").read_text())
    stored = ManoPose(*(np.array(found["as_mano"][name]) for name in ManoPose._fields))
    _, joints = mano_surface(read_mano(mano_dir, "left"), stored)
    landmarks = np.array([found["landmarks"][name] for name in ("wrist", "index1", "middle3", "thumb1")])
    assert np.abs(joints[[0, 1, 6, 13]] - landmarks).max() < 1e-5


class _Thief:
    def __reduce__(self):
        return subprocess.check_output, (["touch", "stolen"],)


def test_nothing_in_a_file_is_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps({"v_template": _Thief()}, protocol))
        with pytest.raises(InputError, match=r"the name \w+.check_output, which .* is not loaded"):
            read_mano(tmp_path)
    assert not (tmp_path / "stolen").exists() and "chumpy" not in sys.modules


def _damaged_file(arrays, name, change):
    return pickle.dumps(arrays | {name: change(arrays[name].copy())}, 4)


def _cut(values):
    return values[..., :-1]


def _holed(values):
    values.flat[0] = np.nan
    return values


_REAL = ("v_template", "shapedirs", "posedirs", "weights", "J_regressor", "hands_components", "hands_mean")
DAMAGE = {
    **{f"{name} missing": (lambda a, n=name: pickle.dumps({k: v for k, v in a.items() if k != n}, 4), f'"{name}" of')
       for name in (*_REAL, "f", "kintree_table")},
    **{f"{name} cut": (lambda a, n=name: _damaged_file(a, n, _cut), f'"{name}" must be .* numbers, got')
       for name in _REAL},
    **{f"{name} not finite": (lambda a, n=name: _damaged_file(a, n, _holed), f'"{name}" has values that are not finite')
       for name in _REAL},
    "millimetres": (lambda a: _damaged_file(a, "v_template", lambda v: 1e3 * v), "must be in metres"),
    "weights": (lambda a: _damaged_file(a, "weights", lambda v: 2 * v), 'rows of "weights" must sum to 1'),
    "faces": (lambda a: _damaged_file(a, "f", lambda v: v + 1), "names vertices from 1 to 778"),
    "closed": (lambda a: _damaged_file(a, "f", lambda v: np.r_[v[:-1], v[:1]]), "vertices open instead of the 16"),
    "joints": (lambda a: _damaged_file(a, "kintree_table", lambda v: v[:, ::-1].copy()), "not that of MANO's 16"),
    "a list": (lambda a: pickle.dumps([1, 2], 4), "a dict of arrays, got a list"),
    "texts": (lambda a: _damaged_file(a, "f", lambda v: v.astype("S3")), "which are no numbers"),
    "objects": (lambda a: _damaged_file(a, "f", lambda v: v.astype(object)), "which are no numbers"),
    "empty": (lambda a: b"", "no pickle of plain arrays"),
    "not a pickle": (lambda a: b"\x89PNG\r\n" + bytes(500), "no pickle of plain arrays"),
    "cut short": (lambda a: pickle.dumps(a, 4)[:-10_000], "no pickle of plain arrays"),
    "shape": (lambda a: pickle.dumps(a, 2).replace(b"K\x00\x85q", b"K\x01\x85q"), None),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_file_is_refused_in_a_sentence(kind, tmp_path):
    make, message = DAMAGE[kind]
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(make(mano_arrays()))
    if message is None:  # numpy ignores the shape of the empty array that comes before the real one, and so do we
        assert np.array_equal(read_mano(tmp_path).template, mano_arrays()["v_template"])
        return
    with pytest.raises(InputError, match=message) as raised:
        read_mano(tmp_path)
    assert str(raised.value).count("MANO_RIGHT.pkl") >= 1 and len(str(raised.value)) < 400


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR(K\x01J\xff\xff\xff\x7f\x85"
        b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x04abcdtb.",
        b"(" * 1000 + b".", b"\x80\x02]q\x00h\x00a.", b"\x80\x02N0.", b"cos\nsystem\n.", b"\x80\x02K\x01K\x02b.",
        b"\x80\x02}h\x09.", b"ibuiltins\neval\n.", b"\x80\x04\x8c\x02os\x8c\x06system\x93.", b"\x80\x02\x82\x01.",
        b"\x80\x02" + b"]" * 50 + b"a" * 49 + b".", b"\x80\x02cnumpy\ndtype\n.", b"L" + b"9" * 5000 + b"L\n.",
    ],
)  # fmt: skip
def test_pickles_of_hostile_programs_are_refused(content, tmp_path):
    (tmp_path / "x.pkl").write_bytes(content)
    with pytest.raises(InputError, match="x.pkl: expected numbers, got no pickle of plain arrays"):
        read_pickle(tmp_path / "x.pkl", "numbers")


def test_a_hand_that_is_not_shaped_as_mano_is_refused(tmp_path):
    arrays = mano_arrays()
    rotated = arrays["v_template"][:, [1, 0, 2]]
    write_mano(tmp_path, arrays | {"v_template": rotated})
    with pytest.raises(InputError, match="its palm is turned by .* degrees against the bundled hand's"):
        making.register(read_mano(tmp_path))
