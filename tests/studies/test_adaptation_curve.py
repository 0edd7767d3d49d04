"""The error-time curve of adaptation: smaller photos show the same, and tables say what was measured."""

import torch
from synthetic import crop_of

from oasis_warp.avatar.pose import GAMMA
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.camera import project
from oasis_warp.core.types import HandLight
from oasis_warp.evaluation.methods import LitGaussians
from studies import adaptation_curve as curve


def test_a_smaller_photo_shows_the_same_from_the_same_side(hand):
    crop, _, _ = crop_of(hand, MeanPrior(hand).vertex_colors(0.02), size=64)
    small = curve.shrink(crop, 32)
    assert small.image.shape == (32, 32, 3) and small.camera.width == small.camera.height == 32
    torch.testing.assert_close(small.image.mean((0, 1)), crop.image.mean((0, 1)))
    (large_uv, _), (small_uv, _) = (project(e.camera, e.posed.vertices) for e in (crop, small))
    torch.testing.assert_close(2 * small_uv, large_uv)


def test_tables_are_of_what_has_been_measured_for_everybody():
    rows = [
        {"light": "same", "person": person, "title": title, "seconds": scale * (2 - (title == curve.DEFAULT_TITLE)),
         "steps": 5, "own": 30 + person, "other": 25.0, "weights": "0" * 64, "device": "cpu"}
        for person, scale, longest in ((0, 1.0, 1000), (1, 3.0, 84)) for title in curve.all_settings(longest)
    ]  # fmt: skip
    text = curve.curve_text(rows) or ""
    assert "people: 2:" in text and text.endswith("Weights 000000000000, cpu.")
    lines = [line.split(" | ")[0].removeprefix("| ") for line in text.splitlines() if line.startswith("| ")][2:]
    assert lines == list(curve.all_settings(84))
    assert "| lora, 84 steps | 5 | 30.50 | 25.00 | 2.00 |" in text
    assert "| default: the field until its loss is flat | 5 | 30.50 | 25.00 | 1.00 |" in text
    assert curve.curve_text([]) is None


def test_avatars_are_drawn_in_the_light_of_their_photo(hand):
    crop, truth, _ = crop_of(hand, MeanPrior(hand).vertex_colors(0.02), size=64)
    dim = torch.tensor([0.5, 0.4, 0.3])
    light = HandLight(torch.cat([dim[None], torch.zeros(3, 3)]), dim.repeat(2, 1), torch.ones(3))
    shown = crop._replace(image=crop.image * dim.pow(1 / GAMMA))
    lit, unlit = (curve.own_psnr(shown, LitGaussians(truth, there)) for there in (light, None))
    assert lit > unlit + 5
