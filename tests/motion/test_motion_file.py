"""What other programs write, or a video shows, comes back as the joint angles that it was made from."""

import json
import os
import zipfile

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.assets import asset
from oasis_warp.core import pickle_reader, rotation
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandPose
from oasis_warp.data.pictures import write_video
from oasis_warp.export import export_avatar
from oasis_warp.hand.mano import ManoPose, hand_pose, mano_surface, read_mano
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import bone_transforms, skin
from oasis_warp.hand.webxr_rig import TO_WEBXR, webxr_rig
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion import Motion, jitter, read_motion, recording, resample, smooth
from oasis_warp.motion.motion_file import WRIST

ANGLES = np.linspace(-1, 1, 4 * 45).reshape(4, 15, 3)
NAMES = ("open", "fist", "ok", "point")


def motion_of(avatar):
    """Named poses, and the wrist somewhere else in each."""
    generator = torch.Generator().manual_seed(3)
    angles = torch.stack([named_pose(avatar.hand, name) for name in NAMES])
    low, high = avatar.hand.pose_limits[1:].unbind(-1)
    angles = torch.minimum(torch.maximum(angles + 0.2 * torch.randn(4, 15, 3, generator=generator), low), high)
    turns = rotation.to_matrix(torch.randn(4, 4, generator=generator))
    return HandPose(angles, turns, 0.3 * torch.randn(4, 3, generator=generator))


def world_turns(avatar, poses):
    hand, rest = avatar.parts[:2]
    return bone_transforms(hand, rest.joints, poses)[0]


def local_turns(avatar, poses):
    turns = world_turns(avatar, poses)
    return turns[:, list(avatar.hand.parents[1:])].mT @ turns[:, 1:]


def places_as_smplx(avatar, poses):
    """Of a hand that turns about its wrist, which MANO's file has at WRIST."""
    at = torch.tensor(WRIST) * (torch.tensor([-1.0, 1, 1]) if avatar.side == "left" else 1)
    return poses.translation + poses.orientation @ avatar.parts.rest.joints[0] - at


def check(found, expected, atol=1e-5):
    assert np.allclose(found.angles, expected.angles, atol=atol)
    assert np.allclose(found.orientations, expected.orientation, atol=atol)
    assert np.allclose(found.translations, expected.translation, atol=atol)


def test_json_and_npz_hold_the_same_motion(tmp_path, avatar):
    (tmp_path / "a.json").write_text(json.dumps({"fps": 12, "angles": ANGLES.tolist()}))
    np.savez(tmp_path / "a.npz", angles=ANGLES, fps=12)
    np.savez(tmp_path / "b.npz", angles=ANGLES)
    for name, fps in (("a.json", 12), ("a.npz", 12), ("b.npz", 30)):
        motion = read_motion(tmp_path / name, avatar)
        assert motion.fps == fps
        assert np.allclose(motion.angles, ANGLES)


def test_the_parameters_that_we_export_give_the_pose_back(tmp_path, avatar):
    poses = motion_of(avatar)
    for k in range(4):
        pose = HandPose(*(part[k] for part in poses))
        export_avatar(avatar, tmp_path / "hand.json", pose=pose)
        check(read_motion(tmp_path / "hand.json", avatar), HandPose(*(part[None] for part in pose)))


@pytest.mark.parametrize("form", ["matrices", "vectors", "with the wrist", "components", "about a mean"])
def test_mano_is_read_in_all_the_forms_that_programs_write(tmp_path, avatar, form):
    poses = motion_of(avatar)
    local, wrist = local_turns(avatar, poses), poses.orientation
    vectors, turn = rotation.to_vector(local.double()).reshape(4, 45), rotation.to_vector(wrist)
    places = places_as_smplx(avatar, poses)
    mean = torch.linspace(-0.3, 0.3, 45).double()
    basis = torch.linalg.qr(torch.randn(45, 45, generator=torch.Generator().manual_seed(1)).double()).Q
    parts = {
        "matrices": {"hand_pose": local, "global_orient": wrist[:, None], "transl": places},
        "vectors": {"hand_pose": vectors, "global_orient": turn, "transl": places},
        "with the wrist": {"poses": torch.cat([turn.double(), vectors], 1), "trans": places},
        "components": {"hand_pose": vectors @ basis.T, "hands_components": basis, "global_orient": turn,
                       "transl": places},
        "about a mean": {"pose": vectors - mean, "hands_mean": mean, "root_orient": turn, "trans": places},
    }[form]  # fmt: skip
    if form == "components":  # a full basis, of which files often have the first rows
        parts["hand_pose"] = vectors @ torch.linalg.inv(basis)
    np.savez(tmp_path / "mano.npz", **{name: part.numpy() for name, part in parts.items()})
    check(read_motion(tmp_path / "mano.npz", avatar), poses, 1e-4)


@pytest.mark.parametrize("side", ["left", "right"])
def test_an_avatar_of_mano_plays_smplx_parameters_and_components(tmp_path, avatars, mano_dir, mano, monkeypatch, side):
    """Its joints lie where MANO's layer has them; 6 numbers are of the files' own components, about their mean."""
    monkeypatch.setenv("OASIS_MANO_DIR", str(mano_dir))
    some, plain = np.random.default_rng(4), avatars["left"]
    avatar = Avatar(
        side=side, shape=torch.from_numpy(some.normal(size=10)).float(), gaussians=plain.gaussians,
        surface_offsets=torch.zeros_like(mano.template), source_pose=plain.source_pose,
        source_camera=plain.source_camera, hand=mano,
    )  # fmt: skip
    model, few = read_mano(mano_dir, side), 0.5 * some.normal(size=6)
    orient, place = np.array([0.3, -0.5, 0.2]), np.array([0.1, 0.2, 0.6])
    layer = ManoPose(avatar.shape.numpy(), orient, hand_pose(model, few, flat_hand_mean=False), place)
    np.savez(tmp_path / "m.npz", hand_pose=few[None], global_orient=orient[None], transl=place[None])
    motion = read_motion(tmp_path / "m.npz", avatar)
    assert motion.orientations is not None and motion.translations is not None
    found = avatar.mesh(HandPose(motion.angles[0], motion.orientations[0], motion.translations[0])).joints
    np.testing.assert_allclose(found, mano_surface(model, layer)[1], atol=2e-5)


@pytest.mark.parametrize("palm", [False, True], ids=["webxr", "openxr"])
def test_tracked_joints_give_the_pose_back_and_the_place_of_the_wrist(tmp_path, avatar, palm):
    """A transposed rotation, a wrong order of quaternions or an axis of the room would show."""
    hand, rest = avatar.parts[:2]
    poses, rig = motion_of(avatar), webxr_rig(hand, rest, avatar.side)
    turns, shifts = bone_transforms(hand, rest.joints, poses)
    to_file, bones = torch.tensor(TO_WEBXR[avatar.side]).float(), list(rig.bones)
    room = torch.diag(torch.tensor([1.0, -1, -1]))  # y up, z to the viewer
    joints = rig.bind[:, :3, 3] @ to_file
    places = ((turns[:, bones] @ joints[..., None])[..., 0] + shifts[:, bones]) @ room
    quats = rotation.from_matrix(room @ turns[:, bones] @ to_file.T @ rig.bind[:, :3, :3])[..., [1, 2, 3, 0]]
    if palm:
        places, quats = torch.cat([places[:, :1], places], 1), torch.cat([quats.flip(1)[:, :1], quats], 1)
    parts = {"orientations": quats.tolist(), "positions": places.tolist(), "fps": 72}
    other = {"orientations": quats.flip(0).tolist(), "positions": places.tolist()}
    sides = {avatar.side: parts, {"left": "right", "right": "left"}[avatar.side]: other}
    for name, content in (("one.json", parts), ("both.json", sides)):
        (tmp_path / name).write_text(json.dumps(content))
        motion = read_motion(tmp_path / name, avatar)
        check(motion, poses, 1e-4)
        assert motion.fps == 72


def test_the_other_hands_motion_is_done_by_the_same_fingers(tmp_path, avatars):
    """A left hand that plays a right hand's rotations must close where that one closes."""
    poses = motion_of(avatars["right"])
    vectors = rotation.to_vector(local_turns(avatars["right"], poses).double())
    (tmp_path / "right.json").write_text(json.dumps({"side": "right", "hand_pose": vectors.tolist()}))
    assert np.allclose(read_motion(tmp_path / "right.json", avatars["left"]).angles, poses.angles, atol=1e-4)


NAMINGS = {
    "mixamo": ("mixamorig:{Side}Hand", "mixamorig:{Side}Hand{Finger}{k}"),
    "unreal": ("hand_{s}", "{finger}_0{k}_{s}"),
    "cmu": ("{S}Hand", "{S}{Finger}{k}"),
    "one hand": ("wrist", "{finger}{k}"),
}


def bvh_of(avatar, poses, naming):
    """The hand as a skeleton in centimetres that is laid elsewhere in its world, below an arm that moves too."""
    hand, rest = avatar.parts[:2]
    laid = rotation.to_matrix(torch.tensor([0.4, -0.3, 0.8, 0.2]))
    joints = 100 * rest.joints @ laid.T
    local = torch.cat([torch.eye(3).expand(len(poses.angles), 1, 3, 3), local_turns(avatar, poses)], 1)
    local = laid @ local @ laid.T
    arm = rotation.to_matrix(torch.tensor([[0.9, 0.1 * k, 0.2, -0.1] for k in range(len(local))]))
    local[:, 0] = arm
    wrist, joint = NAMINGS[naming]
    words = {"s": avatar.side[0], "S": avatar.side[0].upper(), "Side": avatar.side.capitalize(), "side": avatar.side}
    tips = dict(zip((15, 3, 6, 12, 9), 100 * rest.tips @ laid.T, strict=True))
    lines, frames = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0", "CHANNELS 3 Xposition Yposition Zposition"], []

    def offset(vector):
        return "OFFSET " + " ".join(f"{float(value):.6f}" for value in vector)

    def write(bone):
        if bone == 0:
            name = wrist.format(**words)
        else:
            finger = hand.joint_names[bone][:-1]
            finger = "pinky" if finger == "little" and naming != "one hand" else finger
            name = joint.format(finger=finger, Finger=finger.capitalize(), k=(bone - 1) % 3 + 1, **words)
        lines.extend([f"JOINT {name}", "{"])
        lines.append(offset(joints[bone] - (joints[hand.parents[bone]] if bone else 0)))
        lines.append("CHANNELS 3 Zrotation Yrotation Xrotation")
        m = local[:, bone].double()
        x, y, z = (torch.atan2(m[:, 2, 1], m[:, 2, 2]), torch.asin(-m[:, 2, 0]), torch.atan2(m[:, 1, 0], m[:, 0, 0]))
        frames.append(torch.stack([z, y, x], 1).rad2deg())
        for child in [k for k in range(16) if hand.parents[k] == bone]:
            write(child)
        if bone in tips:
            lines.extend(["End Site", "{", offset(tips[bone] - joints[bone]), "}"])
        lines.append("}")

    write(0)
    numbers = torch.cat([torch.zeros(len(local), 3), *frames], 1)
    rows = [" ".join(f"{float(value):.6f}" for value in row) for row in numbers]
    return "\n".join([*lines, "}", "MOTION", f"Frames: {len(rows)}", "Frame Time: 0.0166667", *rows]) + "\n"


@pytest.mark.parametrize("naming", NAMINGS)
def test_a_skeleton_that_moves_as_our_hand_gives_its_angles(tmp_path, avatar, naming):
    poses = motion_of(avatar)
    (tmp_path / "a.bvh").write_text(bvh_of(avatar, poses, naming))
    motion = read_motion(tmp_path / "a.bvh", avatar)
    assert np.allclose(motion.angles, poses.angles, atol=2e-3)
    assert motion.fps == pytest.approx(60, rel=1e-4)


def test_a_skeleton_of_the_other_side_only_is_refused(tmp_path, avatars):
    (tmp_path / "a.bvh").write_text(bvh_of(avatars["left"], motion_of(avatars["left"]), "mixamo"))
    with pytest.raises(InputError, match="fingers of a right hand are expected"):
        read_motion(tmp_path / "a.bvh", avatars["right"])


def test_fingers_point_where_those_of_a_skeleton_with_bent_fingers_at_rest_point(tmp_path, avatars):
    """Rotations count from the skeleton's own rest pose, here a relaxed hand."""
    avatar = avatars["right"]
    relaxed = named_pose(avatar.hand, "relaxed")[None]
    still = HandPose(relaxed, torch.eye(3)[None], torch.zeros(1, 3))
    posed = avatar.mesh(still)
    rest = avatar.rest
    bent = rest._replace(joints=posed.joints[0], tips=posed.tips[0])

    class Laid:
        side, hand = avatar.side, avatar.hand
        parts = (avatar.hand, bent)

    text = bvh_of(Laid, HandPose(torch.zeros(1, 15, 3), torch.eye(3)[None], torch.zeros(1, 3)), "mixamo")
    (tmp_path / "a.bvh").write_text(text)
    found = read_motion(tmp_path / "a.bvh", avatar).angles[0]
    flexion = torch.tensor([k for k in range(12)])
    assert np.allclose(found[flexion, 0], relaxed[0, flexion, 0], atol=0.03)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.fbx", b"Kaydara", "expected a motion in .json, .npz, .bvh"),
        ("none.npz", None, "cannot be read"),
        ("none.mp4", None, "cannot be read"),
        ("a.mp4", b"no video", "expected a video"),
        ("a.json", b"{", "not a motion"),
        ("a.json", b"[1]", "not a motion"),
        ("a.json", b"{}", "`angles`, `hand_pose` or `orientations` are expected"),
        ("a.json", b'{"angles": [[1, 2]]}', "expected angles of shape"),
        ("a.json", b'{"angles": "x"}', "not a motion"),
        ("a.json", b'{"angles": [[1], [2, 3]]}', "not a motion"),
        ("a.json", json.dumps({"angles": (40 * ANGLES).tolist()}).encode(), "expected angles in radians"),
        ("a.json", json.dumps({"angles": ANGLES.tolist(), "fps": 0}).encode(), "1 to 1000 frames"),
        ("a.json", json.dumps({"angles": ANGLES.tolist(), "fps": [1, 2]}).encode(), "not a motion"),
        ("a.json", json.dumps({"angles": ANGLES.tolist(), "transl": [[0, 0, 0]]}).encode(), "a finite place of"),
        ("a.json", json.dumps({"hand_pose": [[0] * 12]}).encode(), "need `hands_components`"),
        ("a.json", json.dumps({"orientations": [[[0, 0, 0, 1]] * 21]}).encode(), "orientations of shape"),
        ("a.json", json.dumps({"orientations": [[[0, 0, 0, 0]] * 25]}).encode(), "leave out frames"),
        ("a.json", json.dumps({"side": "up", "angles": ANGLES.tolist()}).encode(), "the side left or right"),
        ("a.npz", b"no zip", "expected arrays of numbers"),
        ("a.npz", b"PK\x03\x04 cut", "expected arrays of numbers"),
        ("a.json", b'{"hand_pose": [[]]}', "one frame or more"),
        ("a.bvh", b"HIERARCHY", "HIERARCHY and MOTION are expected"),
        ("a.bvh", b"HIERARCHY ROOT a { OFFSET 0 0 } MOTION Frames: 1 Frame Time: 1 ", "not a motion"),
        ("a.bvh", b"HIERARCHY ROOT a { CHANNELS 1 Xrotation } MOTION\nFrames: 2\nFrame Time: .1\n1", "2 frames of 1"),
    ],
)
def test_what_is_no_motion_is_refused_in_one_sentence(tmp_path, avatars, name, content, expected):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=expected) as error:
        read_motion(tmp_path / name, avatars["left"])
    assert "\n" not in str(error.value)


@pytest.mark.timeout(20)
def test_a_motion_that_unpacks_without_end_and_a_pipe_are_refused(tmp_path, avatars, monkeypatch):
    # A few MB of zeros took gigabytes, and a pipe was waited for.
    monkeypatch.setattr(pickle_reader, "MAX_BYTES", 1 << 20)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("hand_pose.npy", bytes(3 << 20))
    os.mkfifo(tmp_path / "pipe.json")
    for name, words in (("bomb.npz", "unpacks to more than 1 MB"), ("pipe.json", "a device or a pipe")):
        with pytest.raises(InputError, match=words):
            read_motion(tmp_path / name, avatars["left"])


def closing(avatar, n, fps=30.0):
    """A hand that opens and closes once a second, and turns."""
    share = 0.5 - 0.5 * torch.cos(2 * torch.pi * torch.arange(n) / fps)
    start, end = (named_pose(avatar.hand, name) for name in ("open", "fist"))
    turns = rotation.from_axis_angle(torch.tensor([0.0, 0.6, 0.8]).expand(n, 3), 0.05 * torch.arange(n))
    places = torch.stack([0.1 * share, 0 * share, 0.5 + 0 * share], 1)
    return Motion(torch.lerp(start, end, share[:, None, None]), fps, turns, places)


def poses(motion):
    assert motion.orientations is not None and motion.translations is not None
    return HandPose(motion.angles, motion.orientations, motion.translations)


def test_another_rate_blends_between_frames_and_holds_the_last():
    motion = Motion(torch.arange(3.0)[:, None, None].expand(3, 15, 3), 10.0)
    for fps, expected in ((20.0, [0, 0.5, 1, 1.5, 2, 2]), (10.0, [0, 1, 2]), (1.0, [0])):
        blended = resample(motion, fps)
        assert blended.fps == fps
        assert blended.angles[:, 0, 0].tolist() == expected


def test_another_rate_turns_the_wrist_the_short_way(avatars):
    motion = closing(avatars["left"], 90)
    turns = poses(resample(motion, 60.0)).orientation
    assert torch.allclose(turns[::2][:90], poses(motion).orientation, atol=1e-6)
    steps = rotation.to_vector(turns[:-1].mT @ turns[1:]).norm(dim=1)
    assert float(steps.max()) < 0.06  # quaternions of other signs would turn by pi


def test_the_filter_keeps_the_motion_and_takes_away_the_noise(avatars):
    avatar = avatars["right"]
    motion, generator = closing(avatar, 120), torch.Generator().manual_seed(2)
    noise = 0.03 * torch.randn(motion.angles.shape, generator=generator)
    shaken = motion._replace(angles=motion.angles + noise)

    def points(of):
        posed = skin(avatar.hand, avatar.rest, poses(of))
        return torch.cat([posed.joints, posed.tips], 1)

    true, found = points(motion), points(smooth(shaken))
    middle = slice(10, -10)
    assert (points(smooth(motion)) - true)[middle].norm(dim=-1).mean() < 1e-4
    assert (found - true)[middle].norm(dim=-1).mean() < 0.7 * (points(shaken) - true)[middle].norm(dim=-1).mean()
    extra = [jitter(each - true, 30.0) for each in (points(shaken), found)]
    assert extra[1] < 0.2 * extra[0]


def test_points_that_fall_shake_by_their_acceleration():
    at = torch.arange(20) / 25
    fall = torch.stack([0 * at, 4.905 * at**2, 3 * at], 1)[:, None]
    assert jitter(fall, 25.0) == pytest.approx(9.81, rel=1e-3)
    assert jitter(fall[:2], 25.0) == 0


@pytest.fixture
def film(tmp_path):
    write_video(tmp_path / "film.mp4", [torch.full((32, 32, 3), k, dtype=torch.uint8) for k in range(12)], 12.0)
    return tmp_path / "film.mp4"


def seen_in(monkeypatch, avatar, lost):
    """Frames that show a motion, but for the `lost` ones, instead of the estimator."""
    motion, calls = closing(avatar, 12, 12.0), []

    def fit(estimator, photo, avatar, focal):
        k = len(calls)
        calls.append(focal)
        pose = HandPose(*(part[k] for part in poses(motion)))
        return (None if k in lost else pose), 500.0

    monkeypatch.setattr(recording, "_fit_frame", fit)
    monkeypatch.setattr("oasis_warp.motion.motion.CUTOFF", 100.0)  # no filter
    return motion, calls


def test_frames_without_the_hand_are_bridged_and_said(film, avatars, monkeypatch, caplog):
    motion, focals = seen_in(monkeypatch, avatars["left"], {0, 4, 5, 11})
    found = read_motion(film, avatars["left"])
    assert "no left hand in frames 1, 5 to 6, 12 of 12; interpolated" in caplog.text
    assert found.fps == pytest.approx(12)
    seen = [1, 2, 3, 6, 7, 8, 9, 10]
    assert torch.allclose(found.angles[seen], motion.angles[seen], atol=1e-6)
    assert torch.allclose(found.angles[4], torch.lerp(motion.angles[3], motion.angles[6], 1 / 3), atol=1e-6)
    assert torch.allclose(found.angles[[0, 11]], motion.angles[[1, 10]], atol=1e-6)
    before, after = poses(motion).translation[[3, 6]]
    assert torch.allclose(poses(found).translation[5], torch.lerp(before, after, 2 / 3), atol=1e-6)
    assert focals[1:] == [500.0] * 11  # that of the first frame


def test_a_video_that_hardly_shows_the_hand_is_refused(film, avatars, monkeypatch):
    seen_in(monkeypatch, avatars["left"], set(range(7)))
    with pytest.raises(InputError, match="5 of 12 frames show a left hand"):
        read_motion(film, avatars["left"])


@pytest.mark.slow
def test_a_hand_that_moves_through_the_picture_is_followed(avatars, tmp_path):
    """The bundled photo, moved by 6 pixels a frame, and black once."""
    photo = np.asarray(cv2.imread(str(asset("photos", "palm_open_left_02.png"))))[..., ::-1]
    frames = [cv2.copyMakeBorder(photo, 0, 0, 6 * k, 60 - 6 * k, cv2.BORDER_REPLICATE) for k in range(7)]
    frames[3] = np.zeros_like(frames[3])
    write_video(tmp_path / "film.mp4", [torch.from_numpy(np.ascontiguousarray(frame)) for frame in frames], 10.0)
    found = read_motion(tmp_path / "film.mp4", avatars["left"])
    assert len(found.angles) == 7
    assert (found.angles - found.angles.mean(0)).abs().max() < 0.2  # the hand itself does not move
    places = poses(found).translation
    assert ((places[:, 0] / places[:, 2]).diff() > 0).all()
