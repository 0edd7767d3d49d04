import json

import cv2
import numpy as np
import pytest
import torch
from synthetic import as_left_hand
from torch.nn.functional import normalize

from oasis_warp.avatar.wrist import hand_up
from oasis_warp.cli import main
from oasis_warp.cli.animate import around, draw_frames, still_camera, turntable
from oasis_warp.core import rotation
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.logging import silent
from oasis_warp.core.types import HandLight, HandPose
from oasis_warp.data.pictures import to_uint8
from oasis_warp.hand.poses import named_pose, pose_sequence
from oasis_warp.hand_avatar import Avatar

LOOK = {"elevation": 0.0, "background": (1.0, 1.0, 1.0), "progress": silent}


def draw(avatar_file, *arguments, name="x.png"):
    out = avatar_file.with_name(name)
    assert main(["render", str(avatar_file), "-o", str(out), "--size", "96", *arguments]) == 0
    return np.asarray(cv2.imread(str(out), cv2.IMREAD_UNCHANGED), int)


def pose_frames(avatar, angles, size, *, elevation, background, progress):
    """A frame for each of the joint `angles`, from the direction of the photo; transparent without a `background`."""
    hands = [(avatar, [avatar.source_pose._replace(angles=each.to(avatar.shape)) for each in angles])]
    cameras = [still_camera(hands, size, elevation)] * len(angles)
    return draw_frames(hands, cameras, background=background, progress=progress, stage="poses")


def test_a_picture_shows_the_photos_pose_from_where_it_was_taken(scene, avatar_file):
    avatar = scene[2]
    camera = orbit_camera(avatar.mesh(avatar.source_pose).vertices, 0.0, 0.0, 96)
    expected = to_uint8(avatar.render(camera, avatar.source_pose).image).numpy()
    assert np.array_equal(draw(avatar_file)[..., ::-1], expected)


@pytest.mark.parametrize("arguments", [["--pose", "fist"], ["--azimuth", "90"], ["--elevation", "45"]])
def test_pose_and_place_change_the_picture(avatar_file, arguments):
    assert np.abs(draw(avatar_file, *arguments) - draw(avatar_file)).max() > 100


def test_a_pose_comes_from_a_file(scene, avatar_file):
    file = avatar_file.with_name("fist.json")
    file.write_text(json.dumps({"angles": [named_pose(scene[2].hand, "fist").tolist()]}))
    assert np.array_equal(draw(avatar_file, "--pose", str(file)), draw(avatar_file, "--pose", "fist"))


def test_a_full_turn_is_none(avatar_file):
    assert np.abs(draw(avatar_file, "--azimuth", "360") - draw(avatar_file)).max() <= 2


def test_a_transparent_picture_laid_over_a_colour_is_the_picture_on_that_colour(avatar_file):
    clear = draw(avatar_file, "--background", "transparent")
    solid = draw(avatar_file, "--background", "#2060c0")
    alpha = clear[..., 3:] / 255
    laid = clear[..., :3] * alpha + np.array([0xC0, 0x60, 0x20]) * (1 - alpha)
    assert clear[..., 3].min() == 0
    assert np.abs(laid - solid).max() <= 2  # alpha and colour are rounded apart


def test_a_picture_replaces_an_older_one(avatar_file):
    first = draw(avatar_file)
    assert not np.array_equal(draw(avatar_file, "--pose", "fist"), first)


def test_a_turntable_turns_once_and_starts_at_the_photo(scene):
    avatar = scene[2]
    frames = list(turntable(avatar, avatar.source_pose, 4, 64, **LOOK))
    camera = orbit_camera(avatar.mesh(avatar.source_pose).vertices, 0.0, 0.0, 64)
    assert torch.equal(frames[0], to_uint8(avatar.render(camera, avatar.source_pose).image))
    # From behind, a hand's outline is the image mirrored at its arm, but for perspective.
    x, y = normalize(hand_up(avatar.hand, avatar.mesh(avatar.source_pose).vertices)[:2], dim=0).tolist()
    across = np.array([[2 * x * x - 1, 2 * x * y], [2 * x * y, 2 * y * y - 1]])
    mirror = np.column_stack([across, 31.5 - across @ [31.5, 31.5]])
    back = cv2.warpAffine(frames[2].numpy(), mirror, (64, 64), borderValue=(255, 255, 255))
    front, back = ((frame < 250).any(-1) for frame in (frames[0].numpy(), back))
    assert (front & back).sum() / (front | back).sum() > 0.8
    assert len({frame.numpy().tobytes() for frame in frames}) == 4


@pytest.mark.parametrize("left", [False, True])
def test_a_turning_hand_in_its_photos_shade_is_drawn_as_single_pictures_are_and_posed_only_where_shade_fades(
    scene, left, monkeypatch
):
    plain = as_left_hand(scene[2]) if left else scene[2]
    random = torch.randn(plain.rest.vertices.shape, generator=torch.Generator().manual_seed(1))
    facing = torch.nn.functional.normalize(random, dim=1)
    light = HandLight(torch.tensor([[0.9] * 3, *[[0.0] * 3] * 3]), torch.tensor([[0.2] * 3, [1.6] * 3]), torch.ones(3),
                      torch.full_like(facing, 0.5), facing)  # fmt: skip
    avatar, calls, pose = plain.with_looks(plain.gaussians, light), [], Avatar.pose
    monkeypatch.setattr(Avatar, "pose", lambda *args, **named: calls.append(1) or pose(*args, **named))
    hands = [(avatar, [avatar.source_pose] * 24)]
    cameras = around(hands, 24, 64, 0.0)
    frames = list(draw_frames(hands, cameras, background=LOOK["background"], progress=silent, stage="turntable"))
    assert 3 <= len(calls) <= 12
    for camera, frame in zip(cameras, frames, strict=True):
        assert torch.equal(frame, to_uint8(avatar.render(camera, avatar.source_pose).image))


def test_a_pose_film_keeps_every_pose_in_the_picture(scene):
    frames = list(pose_frames(scene[2], pose_sequence(scene[2].hand, ["open", "fist"], 4), 64, **LOOK))
    assert len(frames) == 8
    for frame in frames:
        border = torch.cat([frame[0], frame[-1], frame[:, 0], frame[:, -1]])
        assert (border == 255).all()
        assert (frame < 250).any()


@pytest.mark.parametrize("motion", ["turntable", "poses"])
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_has_the_length_that_was_asked_for(avatar_file, motion, suffix, capsys):
    out = avatar_file.with_name(f"film{suffix}")
    arguments = ["--motion", motion, "--poses", "open, fist", "--seconds", "0.5", "--fps", "12", "--size", "64"]
    assert main(["animate", str(avatar_file), "-o", str(out), *arguments]) == 0
    capture, count = cv2.VideoCapture(str(out), cv2.CAP_FFMPEG), 0
    while capture.grab():
        count += 1
    assert count == 6
    assert f"{motion}: " in capsys.readouterr().err


def test_a_motion_of_ones_own_is_played_over_nothing(scene, avatar_file):
    avatar = scene[2]
    angles = np.stack([named_pose(avatar.hand, name).numpy() for name in ("open", "fist")])
    motion, out = avatar_file.with_name("motion.npz"), avatar_file.with_name("pictures")
    np.savez(motion, angles=angles, fps=10)
    arguments = ["--motion", str(motion), "--fps", "10", "--size", "64", "--background", "transparent"]
    assert main(["animate", str(avatar_file), "-o", str(out), *arguments]) == 0
    found = [np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) for file in sorted(out.iterdir())]
    look = LOOK | {"background": None}
    for frame, drawn in zip(found, pose_frames(avatar, [*map(torch.from_numpy, angles)], 64, **look), strict=True):
        assert np.array_equal(frame[..., [2, 1, 0, 3]], drawn)
        assert frame[0, 0, 3] == 0


def frames_of(out):
    return [np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) for file in sorted(out.iterdir())]


def test_two_hands_stand_side_by_side_in_the_order_given(scene, avatar_file):
    """Without a shift they would lie in one another, with one of the wrong sign in the other order."""
    plain, out = scene[2], avatar_file.with_name("both")
    blue = plain.with_looks(plain.gaussians._replace(colors=torch.tensor([[0.1, 0.2, 0.9]]).expand(
        len(plain.gaussians.colors), 3)), None)  # fmt: skip
    blue.save(avatar_file.with_name("blue.safetensors"))
    files = [str(avatar_file), str(avatar_file.with_name("blue.safetensors"))]
    for order in (files, files[::-1]):
        arguments = ["--motion", "poses", "--poses", "open,fist", "--seconds", ".4", "--fps", "10", "--size", "96"]
        assert main(["animate", *order, "-o", str(out), *arguments, "--background", "transparent"]) == 0
        for frame in frames_of(out):
            seen = frame[..., 3] > 128
            first = frame[..., 0] > frame[..., 2] if order is not files else frame[..., 0] < frame[..., 2]
            mine, others = np.nonzero(seen & first)[1], np.nonzero(seen & ~first)[1]
            assert len(mine) > 200 and len(others) > 200
            assert mine.max() < others.min()


def test_a_motion_of_the_wrist_is_seen_by_a_camera_of_ones_own(scene, avatar_file):
    avatar, camera = scene[2], scene[2].source_camera
    angles = torch.stack([named_pose(avatar.hand, name) for name in ("open", "fist")])
    turns = rotation.from_axis_angle(torch.tensor([0.0, 0, 1]), torch.tensor(0.4)) @ avatar.source_pose.orientation
    places = avatar.source_pose.translation + torch.tensor([[0.0, 0, 0.1], [0.05, 0, 0]])
    motion, out, view = (avatar_file.with_name(name) for name in ("motion.npz", "out", "camera.json"))
    np.savez(motion, angles=angles, global_orient=torch.stack([turns, turns]), transl=places, fps=10)
    second = camera.viewmat.clone()
    second[0, 3] += 0.05
    path = {"viewmat": [camera.viewmat.tolist(), second.tolist()], "K": camera.K.tolist()}
    view.write_text(json.dumps({"camera": path | {"width": camera.width, "height": camera.height}}))
    arguments = ["--motion", str(motion), "--wrist", "moves", "--camera", str(view), "--fps", "10"]
    assert main(["animate", str(avatar_file), "-o", str(out), *arguments]) == 0
    for k, frame in enumerate(frames_of(out)):
        viewmat = (camera.viewmat, second)[k]
        drawn = avatar.render(camera._replace(viewmat=viewmat), HandPose(angles[k], turns, places[k])).image
        assert np.abs(frame[..., ::-1].astype(int) - to_uint8(drawn).numpy()).max() <= 1


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "no such file"),
        ("[]", "expected a JSON object"),
        ('{"width": 64, "height": 64}', "finite numbers in `viewmat`"),
        ('{"width": 0, "height": 64}', "`width` and `height`"),
        ('{"width": 64, "height": 64, "K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "viewmat": "x"}', "not a camera"),
        (json.dumps({"width": 64, "height": 64, "K": [[1] * 3] * 3, "viewmat": [[1] * 4] * 4}), "rotations in"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_sentence(avatar_file, content, expected, capsys):
    file = avatar_file.with_name("camera.json")
    if content is not None:
        file.write_text(content)
    arguments = ["-o", str(avatar_file.with_name("x.mp4")), "--motion", "poses", "--camera", str(file)]
    assert main(["animate", str(avatar_file), *arguments]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["animate", "-o", "x.mp4", "--camera", "avatar.safetensors"], "not a camera"),
        (["animate", "avatar.safetensors", "avatar.safetensors", "-o", "x.mp4"], "expected one or two, got 3"),
        (["render", "-o", "x.bmp"], "ends in .png or .webp"),
        (["render", "-o", "x.jpg", "--background", "transparent"], "JPEG has no transparency"),
        (["render", "-o", "x.png", "--background", "mauve"], "mauve: expected white, black, transparent or six hex"),
        (["render", "-o", "x.png", "--pose", "fits"], "Did you mean 'fist'?"),
        (["render", "-o", "x.png", "--pose", "none.json"], "none.json: cannot be read"),
        (["render", "-o", "x.png", "--size", "0"], "--size 0: expected 16 to"),
        (["render", "-o", "x.png", "--size", "100000"], "--size 100000: expected 16 to"),
        (["render", "-o", "x.png", "--azimuth", "nan"], "--azimuth nan: expected a number of degrees"),
        (["animate", "-o", "x.gif", "--elevation", "inf"], "--elevation inf: expected a number of degrees"),
        (["render", "-o", "avatar.safetensors/x.png"], "found a file; choose another name"),
        (["animate", "-o", "x.avi"], "ends in .mp4 or .gif"),
        (["animate", "-o", "x.gif", "--loop", "-1"], "--loop -1: expected 0"),
        (["animate", "-o", "x.mp4", "--motion", "none.npz"], "none.npz: cannot be read"),
        (["animate", "-o", "x.mp4", "--fps", "0"], "--fps 0: expected 1 to 120"),
        (["animate", "-o", "x.mp4", "--seconds", "0"], "--seconds 0: expected 1 to"),
        (["animate", "-o", "x.mp4", "--seconds", "nan"], "--seconds nan: expected 1 to"),
        (["animate", "-o", "x.mp4", "--motion", "poses", "--poses", "fist,frog"], "got frog"),
        (["animate", "-o", "x.mp4", "--motion", "poses", "--poses", ","], "got none"),
        (["animate", "-o", "x.mp4", "--motion", "pose"], "expected turntable, poses or a motion file. Did you mean 'p"),
        (["animate", "-o", "x.mp4", "--background", "transparent"], "has no transparency; write .webp"),
    ],
)
def test_a_wrong_option_is_refused_in_one_sentence(avatar_file, arguments, expected, capsys, monkeypatch):
    monkeypatch.chdir(avatar_file.parent)
    assert main([arguments[0], "avatar.safetensors", *arguments[1:]]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert [path.name for path in avatar_file.parent.iterdir()] == ["avatar.safetensors"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_refused(avatar_file, capsys):
    assert main(["render", str(avatar_file), "-o", "x.png", "--device", "cuda"]) == 2
    assert "torch finds no CUDA device" in capsys.readouterr().err


@pytest.mark.parametrize("motion", ["turntable", "poses"])
def test_a_film_in_even_light_is_without_the_light_of_the_photo(scene, tmp_path, monkeypatch, motion):
    dark = HandLight(torch.tensor([[0.05] * 3, *[[0.0] * 3] * 3]), torch.tensor([[0.01] * 3, [1.0] * 3]), torch.ones(3))
    kept, path = {}, tmp_path / "avatar.safetensors"
    plain = scene[2]
    Avatar(
        side=plain.side, shape=plain.shape, surface_offsets=plain.surface_offsets, gaussians=plain.gaussians,
        source_pose=plain.source_pose, source_camera=plain.source_camera, light=dark,
    ).save(path)  # fmt: skip
    keep = lambda out, frames, fps, loops: kept.update({how: list(frames)})  # noqa: E731
    monkeypatch.setattr("oasis_warp.cli.animate.write_video", keep)
    given = ["--motion", motion, "--poses", "open", "--seconds", "0.2", "--fps", "10", "--size", "48"]
    for how in ("photo", "even"):
        assert main(["animate", str(path), "-o", str(tmp_path / "x.mp4"), "--light", how, *given]) == 0
    if motion == "turntable":
        film = turntable(plain, plain.source_pose, 2, 48, **LOOK)
    else:
        film = pose_frames(plain, pose_sequence(plain.hand, ["open"], 2), 48, **LOOK)
    for even, photo, wanted in zip(kept["even"], kept["photo"], film, strict=True):
        assert torch.equal(even, wanted)
        assert photo.float().mean() < even.float().mean() - 5


def test_light_from_all_around_comes_from_a_studio_or_a_file(avatar_file, capsys):
    around = np.full((16, 32, 3), 0.2, np.float32)
    around[:, :10, 2] = 4  # red, from the left
    file = avatar_file.with_name("around.hdr")
    assert cv2.imwrite(str(file), around)
    plain = draw(avatar_file)
    for light in ("studio", str(file)):
        assert np.abs(draw(avatar_file, "--light", light) - plain).max() > 10
    square, black = np.ones((8, 8, 3), np.uint8), np.zeros((8, 16, 3), np.uint8)
    wrong = {"missing.hdr": None, "square.png": square, "black.png": black, "text.hdr": b"no picture"}
    for name, pixels in wrong.items():
        path = avatar_file.with_name(name)
        if isinstance(pixels, bytes):
            path.write_bytes(pixels)
        elif pixels is not None:
            cv2.imwrite(str(path), pixels)
        assert main(["render", str(avatar_file), "-o", str(path.with_name("y.png")), "--light", str(path)]) != 0
        assert name in capsys.readouterr().err
