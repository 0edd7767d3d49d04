"""How well each place of the surface is known, and more Gaussians where a photo shows more."""

import pytest
import torch
from synthetic import crop_of
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors, region_masks
from oasis_warp.avatar.densify import GROUND_DEPTH, coarsen, densify, parts_for_spacing, read_at
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.avatar.pose import pose_gaussians
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
from oasis_warp.avatar.vertex_light import with_photo
from oasis_warp.core import surface
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.losses import masked_psnr
from oasis_warp.render import render

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
        (photo(SKIN.flip(0)), "not have the colour of skin"),
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


@pytest.fixture(scope="module")
def dressed(hand):
    """The hand at rest in colours that change smoothly, and the faces around the middle of its back."""
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1]))
    anchors = place_anchors(hand, rest)
    waves = 0.5 + 0.3 * torch.sin(rest.vertices @ (60 * torch.eye(3)))
    gaussians = anchors.with_colors(vertex_to_gaussians(waves, hand.faces, anchors))
    center = rest.vertices[hand.segment == 0].mean(0)
    normals, _ = surface.face_normals(rest.vertices, hand.faces)
    near = (rest.vertices[hand.faces].mean(1) - center).norm(dim=1) < 0.03
    return gaussians, rest.vertices, hand.faces, near & (normals[:, 1] > 0.3)


def split(dressed, n):
    gaussians, vertices, faces, chosen = dressed
    return densify(gaussians, vertices, faces, torch.where(chosen, n, 1))


def test_a_face_of_n_parts_an_edge_gets_n_squared_gaussians_inside_it(dressed):
    made = split(dressed, 3)
    _, _, faces, chosen = dressed
    new = made.gaussians.face_index[-made.n_new :]
    assert made.n_new == 9 * int(chosen.sum())
    assert torch.equal(new.bincount(minlength=len(faces)), torch.where(chosen, 9, 0))
    places = made.gaussians.barycentrics[-made.n_new :]
    assert (places > 0).all()
    assert torch.allclose(places.sum(1), torch.ones(len(places)))
    means = torch.zeros(len(faces), 3).index_add_(0, new, places)[chosen] / 9
    assert torch.allclose(means, torch.full_like(means, 1 / 3), atol=1e-6)
    assert len(torch.unique(places.round(decimals=5), dim=0)) == 9


def test_gaussians_on_other_faces_stay_bit_for_bit_and_in_order(dressed):
    gaussians, _, faces, chosen = dressed
    made, changed, _ = split(dressed, 2)
    inner = ~torch.isin(gaussians.vertex_index, faces[~chosen])  # all of whose faces are split
    kept = torch.cat([~inner, ~chosen[gaussians.face_index]])
    for name in ("quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(made, name)[~changed], getattr(gaussians, name)[kept]), name
    assert torch.equal(made.offsets[~inner], gaussians.offsets[~inner])


def test_vertex_gaussians_under_the_parts_sink_into_the_hand(dressed):
    gaussians, vertices, faces, _ = dressed
    made = split(dressed, 2)
    sunk = made.changed[: len(gaussians.vertex_index)]
    normals = surface.vertex_normals(vertices, faces)[gaussians.vertex_index]
    depth = -((made.gaussians.offsets - gaussians.offsets) * normals).sum(1)
    assert sunk.sum() > 50
    assert torch.allclose(depth, torch.where(sunk, GROUND_DEPTH, 0.0), atol=1e-7)


def test_parts_of_faint_faces_are_as_opaque_as_those_of_solid_ones(dressed):
    gaussians, vertices, faces, chosen = dressed
    n = len(gaussians.vertex_index)
    faint = gaussians._replace(opacities=torch.cat([gaussians.opacities[:n], 0.5 * gaussians.opacities[n:]]))
    parts = torch.where(chosen, 2, 1)
    solid, made = (densify(layer, vertices, faces, parts) for layer in (gaussians, faint))
    assert torch.equal(made.gaussians.opacities[-made.n_new :], solid.gaussians.opacities[-made.n_new :])


def test_the_ground_is_the_same_whatever_lay_on_the_vertices(dressed):
    gaussians, vertices, faces, chosen = dressed
    n, parts = len(gaussians.vertex_index), torch.where(chosen, 2, 1)
    normals = surface.vertex_normals(vertices, faces)[gaussians.vertex_index]
    wide = gaussians._replace(
        offsets=-2 * GROUND_DEPTH * normals,
        scales=torch.cat([3 * gaussians.scales[:n], gaussians.scales[n:]]),
        opacities=torch.cat([0.6 * gaussians.opacities[:n], gaussians.opacities[n:]]),
    )
    plain, made = (densify(layer, vertices, faces, parts) for layer in (gaussians, wide))
    for name in ("scales", "quats", "opacities"):
        assert torch.equal(*(getattr(d.gaussians, name)[d.changed] for d in (plain, made))), name
    ground = made.changed[:n]
    assert torch.equal(made.gaussians.offsets[ground], plain.gaussians.offsets[ground])


def test_a_hand_with_finer_gaussians_looks_the_same(dressed):
    gaussians, vertices, faces, _ = dressed
    for n in (2, 5):
        made = split(dressed, n)
        for azimuth, elevation in ((0.0, -1.4), (0.3, -0.9)):  # the back, from above
            camera = orbit_camera(vertices, azimuth, elevation, 256)
            both = (pose_gaussians(layer, faces, vertices, vertices) for layer in (gaussians, made.gaussians))
            before, after = (render(posed, camera) for posed in both)
            changed = ((before.image - after.image).abs().amax(-1) > 0).float()
            assert changed.sum() > 300  # it is in view
            assert masked_psnr(after.image, before.image, changed) > 40
            assert (after.alpha - before.alpha).abs().max() < 0.05


def test_parts_are_as_small_as_the_spacing_asks(dressed):
    _, vertices, faces, _ = dressed
    _, areas = surface.face_normals(vertices, faces)
    spacing = torch.full((len(faces),), 0.4e-3)
    parts = parts_for_spacing(vertices, faces, spacing)
    assert (areas.sqrt() / parts <= spacing + 1e-9).all()
    assert (areas.sqrt() / (parts - 1) >= spacing)[parts > 1].all()
    assert (parts_for_spacing(vertices, faces, torch.full((len(faces),), 1.0)) == 1).all()


def test_asking_for_no_parts_changes_nothing(dressed):
    gaussians = dressed[0]
    made = split(dressed, 1)
    assert made.n_new == 0
    assert made.gaussians.shade is None
    assert all(torch.equal(a, b) for a, b in zip(made.gaussians[:-1], gaussians[:-1], strict=True))


def test_new_gaussians_have_the_shade_of_the_old_ones_there(dressed):
    gaussians, vertices, faces, chosen = dressed
    shaded = gaussians._replace(shade=gaussians.colors.flip(1).clamp_min(0.1))
    made, flipped = (
        densify(layer, vertices, faces, torch.where(chosen, 3, 1))
        for layer in (shaded, gaussians._replace(colors=shaded.shade))
    )
    torch.testing.assert_close(made.gaussians.shade, flipped.gaussians.colors)


def test_faces_can_be_split_again(dressed):
    _, vertices, faces, chosen = dressed
    once = split(dressed, 2)
    twice = densify(once.gaussians, vertices, faces, torch.where(chosen, 4, 1))
    direct = split(dressed, 4)
    assert twice.n_new == direct.n_new
    assert torch.equal(twice.gaussians.scales, direct.gaussians.scales)
    assert (twice.gaussians.colors - direct.gaussians.colors).abs().max() < 0.02


def test_the_fade_at_the_wrist_stays_faded(dressed):
    gaussians, vertices, faces, _ = dressed
    made = densify(gaussians, vertices, faces, torch.full((len(faces),), 2))
    with_gaussian = torch.zeros(len(faces), dtype=torch.bool)
    with_gaussian[gaussians.face_index] = True
    assert made.n_new == 4 * int(with_gaussian.sum())
    assert made.gaussians.opacities[-made.n_new :].min() < 0.02


def test_the_colour_at_a_gaussian_of_an_even_hand_is_that_colour(dressed):
    gaussians, vertices, faces, _ = dressed
    even = gaussians._replace(colors=torch.tensor([0.2, 0.5, 0.8]).expand_as(gaussians.colors))
    found = read_at(even, even.colors, vertices, faces, vertices[::500])
    assert torch.allclose(found, torch.tensor([0.2, 0.5, 0.8]).expand_as(found), atol=1e-6)


@pytest.fixture(scope="module")
def coarsened(hand):
    crop, fine, _ = crop_of(hand, region_colors(label_regions(hand), 0.03))
    return crop.rest, fine, coarsen(hand, fine, crop.rest)


def draw_in_pose(hand, rest, gaussians, pose, size):
    still = HandPose(named_pose(hand, pose), torch.eye(3), torch.tensor([0.0, 0.0, 0.5]))
    posed = skin(hand, rest, still).vertices
    camera = orbit_camera(posed, 0.6, 0.3, size)
    return render(pose_gaussians(gaussians, hand.faces, rest.vertices, posed), camera)


@pytest.mark.parametrize("pose", ["open", "fist"])
def test_a_third_of_the_gaussians_look_alike_and_leave_no_gaps(hand, coarsened, pose):
    rest, fine, coarse = coarsened
    assert len(coarse.opacities) < 0.36 * len(fine.opacities)
    before, after = (draw_in_pose(hand, rest, gaussians, pose, 128) for gaussians in (fine, coarse))
    assert masked_psnr(after.image, before.image, (before.alpha > 0.5).float()) > 28
    assert abs(after.alpha.sum() / before.alpha.sum() - 1) < 0.03
    before, after = (draw_in_pose(hand, rest, gaussians, pose, 384) for gaussians in (fine, coarse))
    inside = inner_mask((before.alpha > 0.99).float(), 6) > 0.5
    assert inside.float().mean() > 0.1
    assert torch.quantile(after.alpha[inside], 0.01) > 0.95


def test_finer_gaussians_can_be_put_on_it_again(hand, coarsened):
    rest, _, coarse = coarsened
    parts = torch.ones(len(hand.faces), dtype=torch.long)
    far = rest.vertices[hand.faces].mean(1).sub(rest.vertices[hand.rim].mean(0)).norm(dim=1) > 0.06
    parts[far] = 2
    dense = densify(coarse, rest.vertices, hand.faces, parts)
    assert dense.n_new == 4 * int(far.sum())
    assert (dense.gaussians.opacities[-dense.n_new :] > 0.2).all()
