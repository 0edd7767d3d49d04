import pytest
import torch
from synthetic import crop_of
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.appearance import label_regions, region_colors, region_masks
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.pose import pose_gaussians, with_photo
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.avatar.quality import (
    REACH,
    SurfaceQuality,
    assess_surface,
    combine_quality,
    coverage_percent,
    coverage_warnings,
    photo_warnings,
)
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.config import AdaptConfig
from oasis_warp.render.render import render

SIDE = 192.0
SKIN = torch.tensor([0.75, 0.55, 0.45])


@pytest.fixture(scope="module")
def case(hand):
    """An open palm with stripes that no prior knows, and how well it is known if all that is seen is explained."""
    stripes = 0.08 * torch.sin(hand.template[:, :1] * (2 * torch.pi / 0.012))
    colors = (region_colors(label_regions(hand), 0.03) + stripes).clamp(0, 1)
    crop, truth, _ = crop_of(hand, colors)
    return crop, truth, assess_surface(hand, crop, crop.image)


def test_the_side_towards_the_camera_is_seen_and_the_other_is_not(hand, case):
    crop, _, quality = case
    toward = -surface.vertex_normals(crop.posed.vertices, hand.faces)[:, 2]  # the camera looks along z
    assert quality.visibility[toward > 0.7].mean() > 0.8
    assert quality.visibility[toward < 0].max() == 0
    assert quality.uncertainty[toward > 0.7].mean() < 0.1
    assert quality.uncertainty[toward < -0.7].mean() > 0.5
    assert 0 <= quality.uncertainty.min() and quality.uncertainty.max() <= 1


def test_uncertainty_grows_no_faster_than_the_distance_along_the_surface(hand, case):
    crop, _, quality = case
    a, b = surface.mesh_edges(hand.faces).T
    lost = -torch.log(1 - quality.uncertainty.double())
    length = (crop.rest.vertices[a] - crop.rest.vertices[b]).norm(dim=1)
    assert ((lost[a] - lost[b]).abs() <= length / REACH + 1e-3).all()


def test_where_the_avatar_is_unlike_the_photo_it_is_less_certain(hand, case):
    crop, _, quality = case
    left = torch.arange(crop.image.shape[1]) < crop.image.shape[1] // 2
    wrong = torch.where(left[:, None], crop.image * 0.6, crop.image)
    doubted = assess_surface(hand, crop, wrong)
    change = doubted.uncertainty - quality.uncertainty
    assert change.min() >= -1e-6
    uv = crop.posed.vertices @ crop.camera.viewmat[:3, :3].T + crop.camera.viewmat[:3, 3]
    on_left = uv[:, 0] / uv[:, 2] < -0.04
    seen = quality.visibility > 0.9
    assert change[seen & on_left].mean() > 0.3
    assert change[seen & (uv[:, 0] / uv[:, 2] > 0.04)].max() < 0.01


def test_what_is_uncertain_is_more_often_wrong(hand, case):
    crop, truth, _ = case
    adapted = adapt(hand, [MeanPrior(hand)(crop)], [crop], AdaptConfig(texture_steps=20, reference_views=0))
    assert adapted.light is not None
    light = with_photo(adapted.light, crop.rest.vertices, crop.posed.vertices, hand.faces)
    posed = pose_gaussians(adapted.gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices, light)
    quality = assess_surface(hand, crop, render(posed, crop.camera).image)
    n = len(truth.vertex_index)
    error = (posed.colors[:n] - truth.colors[:n]).abs().mean(1)
    uncertainty = quality.uncertainty[truth.vertex_index]
    sure, unsure = (error[part].mean() for part in (uncertainty < 0.2, uncertainty > 0.8))
    assert unsure > 2 * sure


def test_shares_of_the_surface_add_up(hand, case):
    crop, _, quality = case
    found = coverage_percent(hand, surface.vertex_areas(crop.rest.vertices, hand.faces), quality)
    assert sum(found[f"{kind}_percent"] for kind in ("seen", "grazed", "extrapolated")) == pytest.approx(100)
    assert found["palm_seen_percent"] > 60 and found["back_seen_percent"] < 10
    assert 0 < found["uncertainty_mean"] < 1
    assert coverage_warnings(found) == []


def test_of_several_photos_each_place_is_known_from_the_best():
    one = SurfaceQuality(torch.tensor([1.0, 0.2, 0.0]), torch.tensor([0.1, 0.6, 0.9]))
    other = SurfaceQuality(torch.tensor([0.0, 0.7, 0.0]), torch.tensor([0.8, 0.3, 1.0]))
    together = combine_quality([one, other])
    assert together.visibility.tolist() == pytest.approx([1.0, 0.7, 0.0])
    assert together.uncertainty.tolist() == pytest.approx([0.1, 0.3, 0.9])


def test_a_hand_of_which_nothing_is_seen_is_guessed_throughout(hand, case):
    crop, _, _ = case
    quality = assess_surface(hand, crop._replace(mask=torch.zeros_like(crop.mask)), crop.image)
    assert (quality.visibility == 0).all() and (quality.uncertainty == 1).all()
    found = coverage_percent(hand, surface.vertex_areas(crop.rest.vertices, hand.faces), quality)
    assert found["extrapolated_percent"] == 100
    assert "little was seen" in coverage_warnings(found)[0]


def photo(color=SKIN, blurs=0):
    """A disc of skin with fine lines."""
    rows, columns = torch.meshgrid(*(2 * [torch.arange(SIDE) - SIDE / 2]), indexing="ij")
    lines = 0.06 * torch.sin(columns * 2.4) + 0.06 * torch.sin(rows * 2.1)
    for _ in range(blurs):
        lines = avg_pool2d(lines[None], 5, 1, 2)[0]
    slope = 0.1 * columns / SIDE
    mask = (rows.hypot(columns) < 0.4 * SIDE).float()
    return (color * (1 + lines + slope)[..., None]).clamp(0, 1), mask


def test_an_ordinary_photo_raises_no_doubt():
    assert photo_warnings(*photo(), SIDE) == []


@pytest.mark.parametrize(
    ("pictured", "said"),
    [
        (photo(0.1 * SKIN), "dark photo"),
        (photo(torch.tensor([1.3, 0.9, 0.8])), "over-exposed photo"),
        (photo(SKIN.flip(0)), "not the colour of skin"),
        (photo(blurs=4), "blurred photo"),
    ],
)
def test_what_ails_a_photo_is_said_and_nothing_else(pictured, said):
    found = photo_warnings(*pictured, SIDE)
    assert len(found) == 1 and said in found[0]


def test_a_sharp_photo_in_a_smaller_crop_is_not_said_to_be_blurred():
    # It was stretched back to the photo's size first, as by `--size 64`.
    image, mask = photo()
    small, fewer = image[::2, ::2], mask[::2, ::2]
    assert photo_warnings(small, fewer, 4 * SIDE) == []


def test_a_mask_of_a_few_pixels_is_said_to_hold_the_background():
    image, mask = photo()
    assert "background" in photo_warnings(image, mask * 0, SIDE)[0]


@pytest.mark.parametrize("name", ["palm", "back"])
def test_shares_are_shares_of_area(hand, case, name):
    rest = case[0].rest.vertices
    area, region = surface.vertex_areas(rest, hand.faces), region_masks(label_regions(hand))[name]
    seen = (area > area[region > 0.5].median()).float()  # the larger half of the region's vertices
    found = coverage_percent(hand, area, SurfaceQuality(seen, 1 - seen))
    of_area = float((area * region * seen).sum() / (area * region).sum())
    assert of_area > float((region * seen).sum() / region.sum()) + 0.05, "vertices are unlike enough to tell"
    assert found[f"{name}_seen_percent"] == pytest.approx(100 * of_area, abs=0.01)
    assert found["seen_percent"] == pytest.approx(100 * float((area * seen).sum() / area.sum()), abs=0.01)
    assert found["uncertainty_mean"] == pytest.approx(1 - found["seen_percent"] / 100, abs=1e-4)


@pytest.mark.parametrize("size", [95, 96])
def test_a_vertex_has_the_color_of_the_place_it_projects_to(hand, size):
    crop, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=size)
    x = (torch.arange(size) + 0.5) / size  # of pixel centres
    ramp = torch.stack([x.expand(size, size), x[:, None].expand(size, size), torch.zeros(size, size)], -1)
    seen = observe(hand, crop._replace(image=ramp))
    uv, _ = project(crop.camera, crop.posed.vertices)
    shown = seen.confidence > 0
    assert int(shown.sum()) > 1000
    torch.testing.assert_close(seen.colors[shown, :2], uv[shown] / size, atol=1e-4, rtol=0)
