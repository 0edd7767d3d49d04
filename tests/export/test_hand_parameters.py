import json

import cv2
import numpy as np
import torch

from oasis_warp.export import export_avatar
from oasis_warp.hand.poses import named_pose


def test_rotations_as_manos_place_the_joints(avatar, tmp_path):
    """A forward pass as MANO's: rotations relative to parents, about joints at rest. Catches a transposed one."""
    pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, "ok"))
    export_avatar(avatar, tmp_path / "hand.json", pose=pose)
    read = json.loads((tmp_path / "hand.json").read_text())
    mano, parents = read["as_mano"], avatar.hand.parents
    rest = np.array(mano["rest_joints"])
    turns = [cv2.Rodrigues(np.array(mano["global_orient"]))[0]]
    places = [turns[0] @ rest[0] + mano["transl"]]
    for joint, vector in enumerate(mano["hand_pose"], start=1):
        above = parents[joint]
        places.append(places[above] + turns[above] @ (rest[joint] - rest[above]))
        turns.append(turns[above] @ cv2.Rodrigues(np.array(vector))[0])
    np.testing.assert_allclose(places, avatar.mesh(pose).joints, atol=2e-6)
    np.testing.assert_allclose(read["landmarks"]["index1"], places[1], atol=2e-6)
    np.testing.assert_allclose(read["landmarks"]["thumb4"], avatar.mesh(pose).tips[0], atol=2e-6)


def test_the_file_gives_back_shape_pose_and_camera(left_hand, tmp_path):
    export_avatar(left_hand, tmp_path / "hand.json")
    read = json.loads((tmp_path / "hand.json").read_text())
    assert read["side"] == "left"
    assert list(read["shape"].values()) == left_hand.shape.tolist()
    angles = [list(row.values()) for row in read["pose"]["angles"].values()]
    assert torch.equal(torch.tensor(angles), left_hand.source_pose.angles)
    assert list(read["pose"]["angles"]) == list(left_hand.hand.joint_names[1:])
    assert torch.equal(torch.tensor(read["camera"]["K"]), left_hand.source_camera.K)
