"""An avatar compared with a photo of the same hand."""

import pytest
import torch
from synthetic import avatar_of, crop_of, with_invented

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.core.color import cielab
from oasis_warp.core.types import Camera, Render
from oasis_warp.evaluation.band_energy import SIZE
from oasis_warp.evaluation.same_hand import compare_with_photo


def test_a_picture_equal_to_the_photo_is_free_of_error_on_any_device(hand, device):
    crop, truth, pose = crop_of(hand, region_colors(label_regions(hand), 0.03), size=SIZE)
    camera = Camera(crop.camera.viewmat.to(device), crop.camera.K.to(device), SIZE, SIZE)
    crop = crop._replace(
        **{name: getattr(crop, name).to(device) for name in ("image", "mask", "above_wrist")},
        camera=camera, rest=moved(crop.rest, device), posed=moved(crop.posed, device),
    )  # fmt: skip
    pose = moved(pose, device)
    avatar = avatar_of(hand, moved(truth, device), pose, camera)
    score = compare_with_photo(avatar, Render(crop.image, crop.mask), crop, pose)
    assert score.psnr > 60 and score.psnr_plain > 60
    assert score.ssim_quarter == pytest.approx(1, abs=1e-5)
    assert score.contrasts == pytest.approx([1, 1, 1, 1])
    assert max(score.region_errors.values()) < 0.02


def test_the_chromaticity_of_hidden_skin_is_compared_apart_from_that_of_seen_skin(hand):
    crop, truth, pose = crop_of(hand, torch.full((len(hand.template), 3), 0.6), size=SIZE)
    half = hand.template[:, 2] > hand.template[:, 2].median()
    greener = torch.where(half[:, None], torch.tensor([0.6, 0.65, 0.6]), 0.6)
    drawn, *_ = crop_of(hand, greener, size=SIZE)
    avatar = avatar_of(hand, truth, pose, crop.camera)
    picture = Render(drawn.image, crop.mask)

    def compared(invented):
        return compare_with_photo(with_invented(avatar, invented), picture, crop, pose).chroma_errors

    assert compared(None) == {}
    found = compared(half.float())
    off = cielab(torch.tensor([[0.6, 0.65, 0.6], [0.6, 0.6, 0.6]]))[:, 1:]
    assert found["chroma_hidden"] == pytest.approx(float((off[0] - off[1]).norm()), rel=0.05)
    assert found["chroma_seen"] < 0.3 and found["chroma_between"] == pytest.approx(found["chroma_hidden"], abs=0.3)
    assert list(compared(torch.zeros(len(half)))) == ["chroma_seen"]


def moved(parts, device):
    """A tuple of tensors on another device."""
    return type(parts)(*(part.to(device) if isinstance(part, torch.Tensor) else part for part in parts))
