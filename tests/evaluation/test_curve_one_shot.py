"""The error-time curve of adaptation: smaller photos show the same, and tables say what was measured."""

import json

import curve_one_shot as curve
import torch
from synthetic import crop_of

from oasis_warp.avatar.pose import GAMMA
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.camera import project
from oasis_warp.core.types import HandLight
from oasis_warp.evaluation.methods import Made


def test_a_smaller_photo_shows_the_same_from_the_same_side(hand):
    crop, _, _ = crop_of(hand, MeanPrior(hand).vertex_colors(0.02), size=64)
    small = curve.shrink(crop, 32)
    assert small.image.shape == (32, 32, 3) and small.camera.width == small.camera.height == 32
    torch.testing.assert_close(small.image.mean((0, 1)), crop.image.mean((0, 1)))
    (large_uv, _), (small_uv, _) = (project(e.camera, e.posed.vertices) for e in (crop, small))
    torch.testing.assert_close(2 * small_uv, large_uv)


def test_tables_are_of_what_has_been_measured_for_everybody(tmp_path):
    wanted = curve.settings(curve.STEPS[-1])
    assert len({setting.name() for setting in wanted.values()}) == len(set(wanted.values()))
    assert curve.table(tmp_path, "same") is None
    for number, scale in ((0, 1.0), (1, 3.0)):
        found = {
            setting.name(): {"seconds": scale * (2 if setting != curve.DEFAULT else 1), "steps": 5, "own": 30 + number,
                             "other": 25.0}
            for setting in (wanted.values() if number == 0 else curve.settings(84).values())
        }  # fmt: skip
        curve.place_of(tmp_path, "same", number).write_text(json.dumps(found))
    made = curve.table(tmp_path, "same")
    assert made is not None and made["people"] == 2
    titles = {row["title"]: row for row in made["rows"]}
    assert list(titles) == [title for title, setting in wanted.items() if (setting.config.texture_steps or 0) <= 84]
    assert titles["lora, 84 steps"]["time"] == 2 and titles["lora, 84 steps"]["own"] == 30.5
    assert "| default: the field until its loss is flat | 5 | 30.50 | 25.00 | 1.00 |" in curve.as_markdown(made)


def test_avatars_are_drawn_in_the_light_of_their_photo(hand):
    crop, truth, _ = crop_of(hand, MeanPrior(hand).vertex_colors(0.02), size=64)
    dim = torch.tensor([0.5, 0.4, 0.3])
    light = HandLight(torch.cat([dim[None], torch.zeros(3, 3)]), dim.repeat(2, 1), torch.ones(3))
    shown = crop._replace(image=crop.image * dim.pow(1 / GAMMA))
    bench = curve.Bench(hand, shown, None, None, [], "raw")
    lit, unlit = (curve.own_psnr(bench, Made(truth, there)) for there in (light, None))
    assert lit > unlit + 5
