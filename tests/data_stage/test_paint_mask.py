from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Photo
from oasis_warp.data.paint_mask import find_paint, match_size, read_mask
from oasis_warp.data.photo import read_photo

PHOTOS = Path(__file__).parents[1] / "data" / "photos"


@pytest.fixture(scope="module")
def photo():
    return read_photo(PHOTOS / "palm_flat_right_03.jpg")


def drawn(photo, color=(0.1, 0.15, 0.4)):
    """The photo with a disc, a thin line and a cross of hairs in `color`, and where they are."""
    mask = np.zeros(photo.rgb.shape[:2], np.uint8)
    cv2.circle(mask, (200, 330), 14, 255, -1, cv2.LINE_AA)
    cv2.line(mask, (170, 380), (250, 400), 255, 2, cv2.LINE_AA)
    share = torch.from_numpy(mask).float() / 255
    rgb = torch.lerp(photo.rgb.float() / 255, torch.tensor(color), share[..., None])
    return rgb, share


def saved(rgb, quality=None, scale=1.0):
    pixels = (rgb.numpy() * 255).round().astype(np.uint8)
    if scale != 1:
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LANCZOS4
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=how)
    if quality is not None:
        pixels = cv2.imdecode(cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality))[1], cv2.IMREAD_COLOR)
    return torch.from_numpy(pixels).float() / 255


@pytest.mark.parametrize(("quality", "scale"), [(None, 1.0), (95, 1.0), (70, 1.0), (85, 0.7), (90, 1.5), (75, 0.5)])
def test_paint_is_found_in_a_copy_that_was_scaled_and_compressed(photo, quality, scale):
    rgb, share = drawn(photo)
    painted = saved(rgb, quality, scale)
    height, width = painted.shape[:2]
    found = find_paint(match_size(photo, width, height, "x"), painted) > 0.5
    true = torch.from_numpy(cv2.resize(share.numpy(), (width, height))) > 0.5
    near = torch.from_numpy(cv2.dilate(true.numpy().astype(np.uint8), np.ones((15, 15)))) > 0
    assert found[true].float().mean() > 0.98
    assert (found & ~near).sum() < 0.03 * true.sum()


@pytest.mark.parametrize(("quality", "scale"), [(95, 1.0), (60, 1.0), (85, 0.7), (90, 1.5)])
def test_saving_and_scaling_alone_is_no_paint(photo, quality, scale):
    copy = saved(photo.rgb.float() / 255, quality, scale)
    assert find_paint(match_size(photo, copy.shape[1], copy.shape[0], "x"), copy).max() == 0


def test_faint_paint_is_found_in_an_exact_copy(photo):
    rgb, share = drawn(photo, color=tuple((photo.rgb[330, 200] / 255 + 0.15).clamp(max=1).tolist()))
    found = find_paint(photo.rgb.float() / 255, saved(rgb)) > 0.5
    disc = share.clone()
    disc[345:] = 0
    assert found[disc > 0.9].float().mean() > 0.98


def test_a_cut_or_turned_copy_is_refused_in_one_sentence(photo):
    for width, height in ((416, 416), (555, 416), (416, 400)):
        with pytest.raises(InputError, match=f"painted.png: {width} x {height} pixels are no scaled copy"):
            match_size(photo, width, height, "painted.png")


def test_rounded_sides_are_a_scaled_copy(photo):
    for width in range(100, 800, 37):
        assert match_size(photo, width, round(width * 555 / 416), "x").shape[1] == width


def test_a_mask_is_its_alpha_or_its_brightness(photo):
    grey = torch.zeros(100, 75, 3, dtype=torch.uint8)
    grey[20:40] = 255
    mask = Photo(grey, None, None, "mask.png", 1.0)
    assert torch.equal(read_mask(mask, 75, 100), (grey[..., 0] > 0).float())
    alpha = torch.rand(100, 75, generator=torch.Generator().manual_seed(0))
    assert torch.equal(read_mask(mask._replace(alpha=alpha), 75, 100), alpha)
    assert read_mask(mask, 150, 200)[50:70].min() > 0.99
