import cv2
import numpy as np
import pytest
import torch

from oasis_warp.assets import asset
from oasis_warp.core import rotation
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandPose
from oasis_warp.data.films import write_video
from oasis_warp.hand.poses import named_pose
from oasis_warp.motion import Motion, jitter, read_motion, recording, resample, smooth


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
        posed = avatar.mesh(poses(of))
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
    assert "no left hand in frames 1, 5 to 6, 12 of 12; bridged" in caplog.text
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
    frames = [cv2.copyMakeBorder(photo, 0, 0, 6 * k, 60 - 6 * k, cv2.BORDER_REPLICATE) for k in range(10)]
    frames[4] = np.zeros_like(frames[4])
    write_video(tmp_path / "film.mp4", [torch.from_numpy(np.ascontiguousarray(frame)) for frame in frames], 10.0)
    found = read_motion(tmp_path / "film.mp4", avatars["left"])
    assert len(found.angles) == 10
    assert (found.angles - found.angles.mean(0)).abs().max() < 0.2  # the hand itself does not move
    places = poses(found).translation
    assert ((places[:, 0] / places[:, 2]).diff() > 0).all()
