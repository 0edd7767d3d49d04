import json

import numpy as np
import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.data.motion_file import Motion, read_motion, resample

ANGLES = np.linspace(-1, 1, 4 * 45).reshape(4, 15, 3)


def test_json_and_npz_hold_the_same_motion(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"fps": 12, "angles": ANGLES.tolist()}))
    np.savez(tmp_path / "a.npz", angles=ANGLES, fps=12)
    np.savez(tmp_path / "b.npz", angles=ANGLES)
    for name, fps in (("a.json", 12), ("a.npz", 12), ("b.npz", 30)):
        motion = read_motion(tmp_path / name)
        assert motion.fps == fps
        assert np.allclose(motion.angles, ANGLES)


def test_another_rate_blends_between_frames_and_holds_the_last():
    motion = Motion(torch.arange(3.0)[:, None, None].expand(3, 15, 3), 10.0)
    assert [float(frame[0, 0]) for frame in resample(motion, 20.0)] == [0, 0.5, 1, 1.5, 2, 2]
    assert [float(frame[0, 0]) for frame in resample(motion, 10.0)] == [0, 1, 2]
    assert [float(frame[0, 0]) for frame in resample(motion, 1.0)] == [0]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.bvh", b"HIERARCHY", "expected a motion in .json or .npz"),
        ("none.npz", None, "cannot be read"),
        ("a.json", b"{", "not a motion"),
        ("a.json", b"[1]", "not a motion"),
        ("a.json", b"{}", "expected `angles`"),
        ("a.json", b'{"angles": [[1, 2]]}', "expected angles of shape"),
        ("a.json", b'{"angles": "x"}', "not a motion"),
        ("a.json", b'{"angles": [[1], [2, 3]]}', "not a motion"),
        ("a.json", json.dumps({"angles": (40 * ANGLES).tolist()}).encode(), "expected angles in radians"),
        ("a.json", json.dumps({"angles": ANGLES.tolist(), "fps": 0}).encode(), "1 to 1000 frames"),
        ("a.json", json.dumps({"angles": ANGLES.tolist(), "fps": [1, 2]}).encode(), "not a motion"),
        ("a.npz", b"no zip", "not a motion"),
        ("a.npz", b"PK\x03\x04 cut", "not a motion"),
    ],
)
def test_what_is_no_motion_is_refused_in_one_sentence(tmp_path, name, content, expected):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=expected) as error:
        read_motion(tmp_path / name)
    assert "\n" not in str(error.value)
