from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.core.camera import crop_camera
from oasis_warp.core.types import Camera
from oasis_warp.data.photo import read_photo
from oasis_warp.data.square_crop import find_square, resample_square, square_around


def ramp(height, width):
    """A picture whose channels are the x and y of its pixels' centres."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1)


@pytest.mark.parametrize(("side", "size"), [(60.0, 60), (60.0, 151), (61.5, 33), (90.0, 32)])
def test_a_resampled_pixel_shows_its_place_in_the_photo(side, size):
    left, top = 20.25, 31.75
    shown = resample_square(ramp(171, 140), left, top, side, size)
    centres = (torch.arange(size) + 0.5) * side / size
    torch.testing.assert_close(shown[..., 0], (left + centres).expand(size, size), atol=0.05, rtol=0)
    torch.testing.assert_close(shown[..., 1], (top + centres)[:, None].expand(size, size), atol=0.05, rtol=0)


def test_the_camera_of_a_square_sees_what_the_square_shows():
    K = torch.tensor([[300.0, 0, 70], [0, 300, 85], [0, 0, 1]])
    camera = crop_camera(Camera(torch.eye(4), K, 140, 171), 20.25, 31.75, 61.5, 33)
    shown = resample_square(ramp(171, 140), 20.25, 31.75, 61.5, 33)[12, 20]
    ray = torch.tensor([(20.5 - camera.K[0, 2]) / camera.K[0, 0], (12.5 - camera.K[1, 2]) / camera.K[1, 1], 1.0])
    torch.testing.assert_close((K @ ray)[:2], shown, atol=0.05, rtol=0)


def test_the_square_is_centred_on_the_mask():
    mask = torch.zeros(90, 121)
    mask[20:41, 60:101] = 1
    assert square_around(mask, 1.5) == (pytest.approx(80.5 - 30.75), pytest.approx(30.5 - 30.75), pytest.approx(61.5))


PHOTOS = Path(__file__).parents[1] / "data" / "photos"
DISC = torch.from_numpy(cv2.circle(np.zeros((128, 128), np.float32), (64, 70), 48, 1.0, -1))


@pytest.fixture(scope="module")
def photo():
    return read_photo(PHOTOS / "palm_flat_right_03.jpg").rgb.float() / 255


@pytest.mark.parametrize("square", [(20.3, 60.8, 380.0), (-44.1, 50.9, 524.2), (110.0, 200.5, 190.7)])
def test_a_square_is_found_where_it_was_cut(photo, square):
    picture = resample_square(photo, *square, 128) * DISC[..., None]  # over black, as avatars are drawn
    found = find_square(picture, DISC, photo)
    error = torch.tensor(found[:3]) - torch.tensor(square)
    assert error.abs().max() < 0.4 * square[2] / 128  # pixels of the picture
    assert found.difference < 0.005


def test_paint_pulls_the_square_by_less_than_a_pixel_of_the_picture(photo):
    square = (20.3, 60.8, 380.0)
    picture = resample_square(photo, *square, 128) * DISC[..., None]
    painted = photo.clone()
    painted[280:340, 180:240] = torch.tensor([0.1, 0.1, 0.6])
    found = find_square(picture, DISC, painted)
    assert (torch.tensor(found[:3]) - torch.tensor(square)).abs().max() < 380 / 128


def test_another_photo_is_far_from_alike(photo):
    other = read_photo(PHOTOS / "back_flat_right_04.jpg").rgb.float() / 255
    picture = resample_square(other, -10.0, 60.0, 440.0, 128) * DISC[..., None]
    assert find_square(picture, DISC, photo).difference > 0.02
