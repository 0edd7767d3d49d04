"""Silhouettes of the posed mesh."""

import cv2
import numpy as np
import pytest

from oasis_warp.estimation.outline import front_faces, silhouette
from oasis_warp.hand.poses import named_pose


def drawn_face_by_face(image, faces, size):
    mask = np.zeros(size[::-1], np.uint8)
    for triangle in np.round((image[faces[front_faces(image, faces)]] - 0.5) * 16).astype(np.int32):
        cv2.fillConvexPoly(mask, triangle, 255, cv2.LINE_8, 4)
    return mask


@pytest.mark.parametrize("name", ["open", "fist", "ok", "victory"])
@pytest.mark.parametrize(("scale", "size"), [(5000.0, (900, 701)), (1500.0, (301, 260)), (400.0, (70, 90))])
def test_a_silhouette_has_the_pixels_of_its_front_faces(hand, kinematics, name, scale, size):
    """From four sides; fingers lie before each other and the hand reaches beyond the image."""
    table = np.concatenate([np.zeros((1, 3)), named_pose(hand, name).double().numpy()])
    points = kinematics.surface(kinematics.pose_joints(table, np.zeros(hand.shape_basis.shape[2])))
    for turn in np.radians([0, 80, 170, 260]):
        across = np.array([[np.cos(turn), 0.3, np.sin(turn)], [0.2, -1, 0.1]])
        image = scale * (points - points.mean(0)) @ across.T + np.array(size) * [0.3, 0.5]
        expected = drawn_face_by_face(image, kinematics.faces, size)
        assert expected.any() and not expected.all()
        assert np.count_nonzero(silhouette(image, kinematics.faces, size) != expected) <= 2  # long, thin faces inside


def test_one_face_is_its_own_outline():
    image, faces = np.array([[2.3, 1.2], [3.1, 17.4], [15.8, 6.6]]), np.array([[0, 1, 2]])
    drawn = silhouette(image, faces, (20, 20))
    assert np.array_equal(drawn, drawn_face_by_face(image, faces, (20, 20))) and (drawn > 0).sum() > 90
    assert not silhouette(image, faces[:, ::-1], (20, 20)).any()
