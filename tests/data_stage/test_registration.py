from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.data.photo import read_photo
from oasis_warp.data.square_crop import find_square, resample_square

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
