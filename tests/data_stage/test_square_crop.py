"""Squares cut out of pictures, and the crop that avatars are fitted to, of a photo that is known."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from synthetic import posed_hand

from oasis_warp.core.camera import crop_camera, project
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.mirror import as_right_hand, mirror_camera, mirror_landmarks, mirror_pose, mirror_reading
from oasis_warp.core.types import Camera, HandFit, Landmarks, Photo, SurfaceReading
from oasis_warp.data.photo import read_photo
from oasis_warp.data.square_crop import find_square, resample_square, square_around
from oasis_warp.estimation.hand_crop import crop_hand, crop_landmarks
from oasis_warp.hand.skinning import hand21


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


WIDTH, HEIGHT = 237, 301
ABOVE = 0.10
"""The wrist line's share of the way to the knuckles (docs/estimator.md)."""


@pytest.fixture(scope="module")
def right(hand):
    """A hand that points up and to the right, off the middle of its photo; the photo's colours are places in it."""
    tilt = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    _, pose, _ = posed_hand(hand)
    pose = pose._replace(orientation=tilt @ pose.orientation, translation=torch.tensor([-0.02, 0.05, 0.6]))
    K = torch.tensor([[420.0, 0, 118.5], [0, 420, 150.5], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, WIDTH, HEIGHT)
    _, _, posed = posed_hand(hand, orientation=pose.orientation)
    posed = posed._replace(
        vertices=posed.vertices + pose.translation - torch.tensor([0, 0, 0.5]),
        joints=posed.joints + pose.translation - torch.tensor([0, 0, 0.5]),
        tips=posed.tips + pose.translation - torch.tensor([0, 0, 0.5]),
    )
    xy, _ = project(camera, hand21(posed, hand))
    mask = torch.zeros(HEIGHT, WIDTH)
    low, high = xy.amin(0).int().tolist(), xy.amax(0).int().tolist()
    mask[low[1] : high[1], low[0] : high[0]] = 1
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    photo = Photo(torch.stack([x, y % 256, x * 0], -1).to(torch.uint8), None, None, "places.png", 1.0)
    shape = torch.zeros(len(hand.shape_names))
    places = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    reading = SurfaceReading(places, places[..., 0], places, low[0] - 7.3, low[1] - 4.8, 0.8 * (high[1] - low[1]))
    landmarks = Landmarks(xy, None, "right", 1.0, 1.0, "file")
    return photo, HandFit("right", shape, pose, camera, landmarks, mask, 0, 0, 1, 0, (), reading)


@pytest.fixture(scope="module")
def left(right):
    """The mirror image."""
    photo, fit = right
    return photo._replace(rgb=photo.rgb.flip(1).contiguous()), fit._replace(
        side="left", pose=mirror_pose(fit.pose), camera=mirror_camera(fit.camera),
        landmarks=mirror_landmarks(fit.landmarks, WIDTH), mask=fit.mask.flip(1),
        reading=mirror_reading(fit.reading, WIDTH),
    )  # fmt: skip


def crop_of(hand, case, size=95):
    return crop_hand(*case, torch.zeros_like(hand.template), ReconstructConfig(), size)


def test_the_mirrored_photo_of_the_other_hand_gives_the_same_crop(hand, right, left):
    a, b = crop_of(hand, right), crop_of(hand, left)
    for name in ("image", "mask", "above_wrist", "reading"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=1e-5, rtol=0)
    torch.testing.assert_close(a.camera.K, b.camera.K)
    torch.testing.assert_close(a.posed.vertices, b.posed.vertices)
    torch.testing.assert_close(crop_landmarks(right[1], a.camera), crop_landmarks(left[1], b.camera))


def test_a_pixel_of_the_crop_has_the_place_that_was_read_there(hand, right):
    _, fit = right
    crop, size = crop_of(hand, right), 95
    (K, Kc), there = (camera.K for camera in (fit.camera, crop.camera)), fit.reading
    at = (torch.tensor([40.5, 30.5]) - Kc[:2, 2]) / Kc.diagonal()[:2] * K.diagonal()[:2] + K[:2, 2]
    column, row = ((at - torch.tensor([there.left, there.top])) / there.side * 32).floor().long().tolist()
    assert 0 <= row < 32 and 0 <= column < 32
    assert torch.equal(crop.reading[30, 40, :3], there.places[row, column])
    assert crop.reading.shape == (size, size, 7) and bool(crop.reading[-1, -1, 3].isinf())  # beyond what was read


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_wrist_line_lies_across_the_arm_of_either_hand(hand, right, left, side):
    case = {"left": left, "right": right}[side]
    crop = crop_of(hand, case)
    xy = crop_landmarks(case[1], crop.camera)
    wrist, knuckles = xy[0], xy[[5, 9, 13, 17]].mean(0)
    y, x = torch.meshgrid(torch.arange(95) + 0.5, torch.arange(95) + 0.5, indexing="ij")
    along = (torch.stack([x, y], -1) - wrist) @ (knuckles - wrist) / (knuckles - wrist).square().sum()
    inside = crop.image.sum(-1) > 0
    clear = inside & ((along - ABOVE).abs() > 0.06)
    torch.testing.assert_close(crop.above_wrist[clear], (along > ABOVE).float()[clear])


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_camera_of_a_crop_sees_the_landmarks_where_the_crop_shows_them(hand, right, left, side):
    case = {"left": left, "right": right}[side]
    crop = crop_of(hand, case)
    xy = crop_landmarks(case[1], crop.camera)
    seen, _ = project(crop.camera, hand21(crop.posed, hand))
    torch.testing.assert_close(seen, xy, atol=0.02, rtol=0)
    places = as_right_hand(case[1]).landmarks.xy - 0.5  # a pixel's colour is the place of its corner
    for (u, v), place in zip(xy.tolist(), places, strict=True):
        if 2 < u < 93 and 2 < v < 93 and place.min() > 5 and place[0] < WIDTH - 5 and place[1] < 250:
            shown = torch.nn.functional.grid_sample(
                crop.image.permute(2, 0, 1)[None], torch.tensor([[[[u, v]]]]) / 95 * 2 - 1, align_corners=False
            )[0, :2, 0, 0]
            torch.testing.assert_close(255 * shown, place, atol=0.3, rtol=0)
