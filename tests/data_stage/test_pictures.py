import cv2
import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.data.pictures import to_uint8, write_picture


def pixels(channels):
    generator = torch.Generator().manual_seed(2)
    return torch.randint(0, 256, (20, 30, channels), generator=generator, dtype=torch.uint8)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("suffix", [".png", ".webp", ".PNG"])
def test_pixels_come_back_exactly(tmp_path, suffix, channels):
    image = pixels(channels)
    image[..., 3:].clamp_(1)  # WebP drops the colour of what cannot be seen
    write_picture(tmp_path / f"a{suffix}", image)
    back = cv2.imread(str(tmp_path / f"a{suffix}"), cv2.IMREAD_UNCHANGED)
    assert torch.equal(torch.from_numpy(back)[..., [2, 1, 0, 3][:channels]], image)


def test_colours_are_rounded_and_clipped():
    image = torch.tensor([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 1.0, 7.0]).reshape(1, 2, 3)
    assert to_uint8(image).flatten().tolist() == [0, 0, 0, 1, 255, 255]


def test_what_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"ends in \.png or \.webp or \.jpg"):
        write_picture(tmp_path / "a.exr", pixels(3))
    with pytest.raises(InputError, match="JPEG has no transparency"):
        write_picture(tmp_path / "a.jpg", pixels(4))
    assert list(tmp_path.iterdir()) == []
