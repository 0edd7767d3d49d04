import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.rim_shade import limit_shade, match_rim
from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe
from oasis_warp.core.types import HandLight


@pytest.fixture(scope="module")
def scene(hand):
    """Crop in even light, its Gaussians, and a light without shade."""
    crop, truth, _ = crop_of(hand, 0.8 * region_colors(label_regions(hand), 0.03))
    even = torch.zeros(4, 3)
    even[0] = 1
    light = HandLight(even, torch.tensor([[0.3], [1.3]]).expand(2, 3), even[0], albedo=torch.tensor([0.4, 0.3, 0.25]))
    return crop, truth, light


def test_on_a_slant_shade_is_what_light_does_to_skin(hand, scene):
    crop, truth, light = scene
    floor = truth._replace(shade=torch.tensor([1.0, 0.8, 0.2]).expand_as(truth.colors))
    cosine = vertex_to_gaussians(observe(hand, crop).facing[:, None], hand.faces, truth)[:, 0]
    limited = limit_shade(hand, floor, [crop], light).shade
    assert limited is not None and floor.shade is not None
    slanted, openly = cosine.abs() < 0.2, cosine > 0.9
    assert float(limited[slanted].log().std(1).median()) < 0.12 < 0.7 < float(floor.shade[0].log().std())
    torch.testing.assert_close(limited[openly], floor.shade[openly])


def test_skin_just_behind_the_rim_is_drawn_in_the_colours_of_the_rim(hand, scene):
    """Its Gaussians show past outlines: in another tone they were thin lines along fingers in front of fingers."""
    crop, truth, light = scene
    seen = observe(hand, crop)
    known, hidden = seen.confidence > 0.1, seen.confidence <= 0
    tone = torch.where(known[:, None], 0.0, torch.tensor([-0.2, -0.25, -0.3])).exp()
    gaussians = truth._replace(
        colors=truth.colors * vertex_to_gaussians(tone, hand.faces, truth), shade=torch.ones_like(truth.colors)
    )
    shade = match_rim(hand, gaussians, crop, light._replace(shade=torch.ones_like(tone))).shade
    assert shade is not None
    distance = torch.cdist(crop.rest.vertices[hidden], crop.rest.vertices[known]).amin(1)
    difference = (tone * shade)[hidden].log()
    assert bool((shade[known] == 1).all())
    assert float(difference[distance < 0.001].abs().mean()) < 0.12 < 0.2 < float(-difference[distance > 0.02].mean())
    assert float(shade.log().abs().max()) < 0.7 and float(shade.log().std(1).max()) < 0.11


def test_without_shade_the_rim_stays_as_it_is(hand, scene):
    crop, truth, light = scene
    assert match_rim(hand, truth._replace(shade=None), crop, light) is light
