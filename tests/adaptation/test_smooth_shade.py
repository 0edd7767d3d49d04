import pytest
import torch
from synthetic import avatar_of, crop_of

from oasis_warp.adaptation.smooth_shade import IN_THE_OPEN, spread_shade
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.vertex_light import posed_lighting
from oasis_warp.core.types import HandLight
from oasis_warp.hand.poses import named_pose


@pytest.fixture(scope="module")
def scene(hand):
    """Crop in even light, its Gaussians, its pose, a light without shade, and what the crop shows."""
    crop, truth, pose = crop_of(hand, 0.6 * region_colors(label_regions(hand), 0.03))
    even = torch.zeros(4, 3)
    even[0] = 1
    light = HandLight(even, torch.tensor([[0.3], [1.3]]).expand(2, 3), even[0], albedo=torch.tensor([0.4, 0.3, 0.25]))
    facing = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, light).normals
    return crop, truth, pose, light._replace(shade=torch.ones_like(facing), facing=facing), observe(hand, crop)


def shown_in(seen):
    return (seen.visibility > 0.5) & (seen.facing > 0)


def shaded(hand, truth, log_shade):
    return truth._replace(shade=vertex_to_gaussians(log_shade, hand.faces, truth).exp())


@pytest.mark.parametrize("shade", [(-0.2, -0.2, -0.2), (0.1, 0.08, 0.05)])
def test_smooth_shade_goes_on_behind_the_rim(hand, scene, shade):
    """From the side there was an edge where the photo's pale skin met painted skin."""
    crop, truth, _, light, seen = scene
    shown, wanted = shown_in(seen), torch.tensor(shade)
    gaussians = shaded(hand, truth, torch.where(shown[:, None], wanted, 0.0))
    _, spread = spread_shade(hand, gaussians, crop, light)
    assert spread.shade is not None
    distance = torch.cdist(crop.rest.vertices, crop.rest.vertices[seen.confidence > 0.1]).amin(1)
    near, far = ~shown & (distance > 0.004) & (distance < 0.006), ~shown & (distance > 0.02)
    torch.testing.assert_close(spread.shade[near].log().median(0).values, 0.8 * wanted, atol=0.05, rtol=0)
    assert float(spread.shade[far].log().abs().median()) < 0.6 * float(wanted.abs().max())


def test_bright_shade_goes_on_only_a_little(hand, scene):
    """Bright rims bleached the flanks of fingers behind them."""
    crop, truth, _, light, seen = scene
    gaussians = shaded(hand, truth, torch.where(shown_in(seen)[:, None], 0.25, 0.0).expand(-1, 3))
    shade = spread_shade(hand, gaussians, crop, light)[1].shade
    assert shade is not None
    behind, shown = shade[seen.facing < -0.3].log(), shade[seen.confidence > 0.9].log()
    assert float(behind.max()) < 0.11 < 0.2 < float(shown.median())


def test_no_impossible_hue_goes_on_behind_the_rim(hand, scene):
    """Yellow floor beside an outline would dye the back."""
    crop, truth, _, light, seen = scene
    floor = torch.where(shown_in(seen)[:, None], torch.tensor([0.6, 0.3, -0.9]), 0.0)
    _, spread = spread_shade(hand, shaded(hand, truth, floor), crop, light)
    assert spread.shade is not None
    logs = spread.shade[seen.facing < -0.3].log()
    assert float((logs - logs.mean(1, keepdim=True)).abs().max()) < 0.15 and float(logs.max()) < 0.41


def test_the_photo_view_stays_and_fine_shade_with_the_gaussians(hand, scene):
    crop, truth, pose, light, seen = scene
    relief = 0.05 * torch.randn(len(hand.template), 1, generator=torch.Generator().manual_seed(0))
    log_shade = torch.where(shown_in(seen)[:, None], 0.25 * torch.sin(90 * hand.template[:, :1]) + relief, 0.0)
    before = shaded(hand, truth, log_shade.expand(-1, 3))
    after, spread = spread_shade(hand, before, crop, light)
    drawn = [
        avatar_of(hand, g, pose, crop.camera, own).render(crop.camera, pose).image
        for g, own in ((before, light), (after, spread))
    ]
    assert float((drawn[1] - drawn[0]).abs().quantile(0.99)) < 2 / 255
    sure = (seen.confidence > 0.9)[truth.vertex_index]
    assert after.shade is not None
    left, fine = after.shade[: len(sure)][sure].log()[:, 0], relief[truth.vertex_index][sure][:, 0]
    assert float(torch.corrcoef(torch.stack([left, fine]))[0, 1]) > 0.8 and float(left.std()) < 0.08


def test_where_the_photo_is_in_doubt_the_light_gets_what_continues_the_skin_around(hand, scene):
    """A thumb's edge on the palm behind it was light, and stayed there from other sides."""
    crop, truth, pose, light, seen = scene
    place = hand.template[:, 0]
    doubted = (place < place[shown_in(seen)].quantile(0.3)).float()
    wrong = -0.7 * doubted * torch.sin(600 * place).sign()
    log_shade = torch.where(shown_in(seen), wrong - 0.1, 0.0)[:, None].expand(-1, 3)
    light = light._replace(doubt=doubted)
    before = shaded(hand, truth, log_shade)
    after, spread = spread_shade(hand, before, crop, light)
    drawn = [
        avatar_of(hand, g, pose, crop.camera, own).render(crop.camera, pose).image
        for g, own in ((before, light), (after, spread))
    ]
    assert float((drawn[1] - drawn[0]).abs().quantile(0.99)) < 2 / 255
    assert spread.shade is not None
    exposure = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, light).exposure
    assert exposure is not None
    there = (doubted > 0) & (seen.confidence > 0.9) & (exposure[:, 0] > IN_THE_OPEN)
    assert float(spread.shade[there].log().min()) > -0.15  # -0.7 with what the photo shows there


def test_a_shadow_between_parts_that_hide_the_sky_stays_where_the_photo_is_in_doubt(hand):
    """Dark gaps between fingertips and palm were lit some degrees beside the photo, as if the fingers floated."""
    crop, truth, _ = crop_of(hand, 0.6 * region_colors(label_regions(hand), 0.03), pose_name="fist")
    even = torch.eye(4, 3)[:, :1].expand(4, 3)
    light = HandLight(even, torch.tensor([[0.3], [1.3]]).expand(2, 3), even[0], albedo=torch.tensor([0.4, 0.3, 0.25]))
    on = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, light)
    shown = shown_in(observe(hand, crop))
    light = light._replace(shade=torch.ones_like(on.normals), facing=on.normals, doubt=torch.ones(len(shown)))
    dark = torch.where(shown, -0.5, 0.0)[:, None].expand(-1, 3)
    spread = spread_shade(hand, shaded(hand, truth, dark), crop, light)[1].shade
    assert spread is not None and on.exposure is not None
    kept, sky = spread.log(), on.exposure[:, 0]
    in_gap, open_skin = shown & (sky < 0.5) & (hand.nail < 0.1), shown & (sky > IN_THE_OPEN)
    # Of -0.5: the smooth field falls towards what the photo does not show. Without the shadow it is 0.
    assert float(kept[in_gap].mean(1).median()) < -0.3 and float(kept[open_skin].min()) > -0.05
    red, _, blue = kept[in_gap].median(0).values.tolist()
    assert red > 0.8 * blue  # shadows of skin are warm; grey ones looked like soot


def test_in_another_pose_no_part_of_the_hand_keeps_smooth_shade(hand, scene):
    """A palm kept its shade beside fingers that lost it as they turned: two tones with an edge."""
    crop, truth, pose, light, _ = scene
    log_shade = torch.full_like(hand.template, -0.25)
    after, spread = spread_shade(hand, shaded(hand, truth, log_shade), crop, light)
    fist = pose._replace(angles=named_pose(hand, "fist"))
    dark, plain = (
        avatar_of(hand, g, pose, crop.camera, own).pose(fist).colors for g, own in ((after, spread), (truth, light))
    )
    ratio = (dark / plain).log()[: len(truth.vertex_index)]
    palm = ((label_regions(hand).palm > 0.9) & (hand.segment == 0))[truth.vertex_index]
    assert float(ratio[palm].median()) > -0.05


def test_without_shade_there_is_none_to_spread(hand, scene):
    crop, truth, _, light, _ = scene
    assert spread_shade(hand, truth._replace(shade=None), crop, light)[1] is light
