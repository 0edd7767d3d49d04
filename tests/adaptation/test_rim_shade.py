import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.rim_shade import continue_shade, limit_shade, match_rim
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


@pytest.mark.parametrize(("shade", "behind"), [(0.7, 0.85), (1.3, 1.0)])
def test_dark_shade_goes_on_behind_the_rim_and_bright_shade_does_not(hand, scene, shade, behind):
    """The shaded edge of a hand was a dark stripe before bright skin, seen from the side."""
    crop, truth, light = scene
    seen = observe(hand, crop)
    own = torch.where((seen.confidence > 0)[:, None], shade, 1.0).expand(-1, 3)
    shaded = truth._replace(shade=vertex_to_gaussians(own, hand.faces, truth))
    found = continue_shade(hand, shaded, crop, light._replace(shade=torch.ones_like(own))).shade
    assert found is not None
    known, hidden = seen.confidence > 0.1, seen.confidence <= 0
    assert bool((found[known] == 1).all())
    near = torch.cdist(crop.rest.vertices[hidden], crop.rest.vertices[known]).amin(1) < 0.006
    assert float(found[hidden][near].quantile(0.25)) == pytest.approx(behind, abs=0.1)
    assert float(found.min()) > min(shade, 1) - 0.01


def test_without_shade_there_is_none_to_continue(hand, scene):
    crop, truth, light = scene
    assert continue_shade(hand, truth._replace(shade=None), crop, light) is light


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
