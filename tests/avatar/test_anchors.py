"""Gaussians of a hand that nobody has photographed yet: where they lie, their colours, their pose."""

import pytest
import torch
from synthetic import PALM_TO_CAMERA, posed_hand

from oasis_warp.avatar.anchors import MIN_OPACITY, OPACITY, place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import (
    BLOOD,
    MELANIN,
    label_regions,
    region_colors,
    region_masks,
    skin_color,
    skin_regions,
)
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import rotation, surface
from oasis_warp.core.hand_model import TIP_JOINTS
from oasis_warp.core.mirror import mirror_canonical, mirror_points
from oasis_warp.hand.skinning import rest_hand
from oasis_warp.ops import rest_mesh


@pytest.fixture(scope="module")
def rest(hand):
    return rest_hand(hand, torch.zeros(len(hand.shape_names)))


@pytest.fixture(scope="module")
def anchors(hand, rest):
    return place_anchors(hand, rest)


def test_nearly_every_vertex_and_face_carries_a_gaussian(hand, anchors):
    full = len(hand.template) + len(hand.faces)
    assert full == 36_945
    assert 0.98 * full < len(anchors.opacities) < full


def test_what_the_wrist_hides_is_left_out_and_the_rest_is_nearly_opaque(hand, anchors):
    assert float(anchors.opacities.min()) >= MIN_OPACITY
    assert not set(hand.rim.tolist()) & set(anchors.vertex_index.tolist())
    assert float((anchors.opacities > OPACITY - 1e-4).float().mean()) > 0.9


def test_gaussians_are_flat_along_the_surface(hand, rest, anchors):
    normals = surface.vertex_normals(rest.vertices, hand.faces)[anchors.vertex_index]
    frames = rotation.to_matrix(anchors.quats[: len(anchors.vertex_index)])
    torch.testing.assert_close(frames[:, :, 2], normals, atol=1e-5, rtol=0)
    assert bool((anchors.scales[:, 2] < anchors.scales[:, :2].amin(1)).all())
    assert float((anchors.scales.amax(1) / anchors.scales[:, 1]).max()) <= 3.01


def test_sizes_are_those_of_the_mesh(anchors):
    assert 3e-4 < float(anchors.scales[:, :2].median()) < 2e-3
    assert float(anchors.scales.max()) < 4e-3


def test_gaussians_grow_with_the_hand(hand, rest, anchors):
    twice = place_anchors(hand, rest._replace(vertices=2 * rest.vertices))
    common = torch.isin(twice.vertex_index, anchors.vertex_index)
    a = anchors.scales[: len(anchors.vertex_index)][torch.isin(anchors.vertex_index, twice.vertex_index)]
    torch.testing.assert_close(twice.scales[: len(twice.vertex_index)][common], 2 * a)


def test_a_field_over_the_vertices_is_read_at_centres(hand, rest, anchors):
    means = vertex_to_gaussians(rest.vertices, hand.faces, anchors)
    n = len(anchors.vertex_index)
    assert torch.equal(means[:n], rest.vertices[anchors.vertex_index])
    torch.testing.assert_close(means[n:], rest.vertices[hand.faces[anchors.face_index]].mean(1))


def luminance(colors):
    return colors @ torch.tensor([0.2126, 0.7152, 0.0722])


@pytest.fixture(scope="module")
def regions(hand):
    return label_regions(hand)


def test_the_table_is_met_at_its_knots():
    colors = skin_color(torch.tensor([MELANIN[3]]), torch.tensor([BLOOD[1]]))
    torch.testing.assert_close(colors[0] * 255, torch.tensor([177.0, 141.0, 115.0]), atol=1e-3, rtol=0)


def test_more_melanin_is_darker_and_more_blood_is_redder():
    melanin = torch.logspace(-2.3, -0.46, 30)
    light = luminance(skin_color(melanin, torch.full_like(melanin, 0.0125)))
    assert bool((light[1:] < light[:-1]).all())
    pale, red = (skin_color(torch.tensor([0.02]), torch.tensor([b]))[0] for b in (0.006, 0.035))
    assert float(red[0] / red[1]) > float(pale[0] / pale[1])


def test_shares_beyond_the_table_are_clamped():
    inside = skin_color(torch.tensor([0.35]), torch.tensor([0.04]))
    torch.testing.assert_close(skin_color(torch.tensor([5.0]), torch.tensor([1.0])), inside)


def test_palm_and_back_lie_on_opposite_sides(hand, regions):
    palm = hand.template[regions.palm > 0.95, 1].mean()
    back = hand.template[regions.palm < 0.05, 1].mean()
    assert float(palm) < float(back)  # the palm faces -y


def test_the_palms_skin_ends_in_one_soft_line_and_at_the_wrist(hand, regions):
    """The labels jump by the whole beside the ball of the thumb: dark skin had a stain with an edge there."""
    skin, edges = skin_regions(hand), surface.mesh_edges(hand.faces)
    ball, wrist = ((hand.segment[edges] == bone).any(1) for bone in (TIP_JOINTS[0] - 2, 0))
    labels, ours = (field[edges].diff(dim=1).abs()[ball & wrist].max() for field in (regions.palm, skin.palm))
    assert float(labels) > 0.5
    assert float(ours) < 0.25
    assert float(skin.palm[hand.rim].max()) < 0.5
    fingers = (hand.segment > 0) & (hand.segment != TIP_JOINTS[0] - 2)
    assert float((skin.palm - regions.palm)[fingers].abs().mean()) < 0.01
    assert torch.equal(skin.nail, regions.nail)


def test_five_nails_lie_on_the_back_near_the_tips(hand, regions):
    nails = regions.nail > 0.5
    assert sorted(hand.segment[nails].unique().tolist()) == [3, 6, 9, 12, 15]
    assert float(regions.palm[nails].max()) < 0.1


def test_regions_lie_between_zero_and_one(regions):
    for field in regions[:-1]:
        assert float(field.min()) >= 0
        assert float(field.max()) <= 1


@pytest.mark.parametrize("melanin", [0.006, 0.04, 0.15, 0.35])
def test_palms_are_no_darker_than_backs_and_much_lighter_in_dark_skin(regions, melanin):
    light = luminance(region_colors(regions, melanin))
    palm, back = float(light[regions.palm > 0.95].mean()), float(light[regions.palm < 0.05].mean())
    assert palm > back - 0.01
    if melanin > 0.1:
        assert palm > back + 0.08


def test_region_masks_split_the_surface(regions):
    masks = region_masks(regions)
    assert tuple(masks) == ("palm", "back", "nail")
    torch.testing.assert_close(sum(masks.values()), torch.ones_like(regions.palm))


def test_skin_is_mottled_the_same_way_every_time(hand, regions):
    label_regions.cache_clear()
    assert torch.equal(label_regions(hand).mottle, regions.mottle)
    assert abs(float(regions.mottle.mean())) < 0.05
    colors = region_colors(regions, 0.04)
    back = (regions.palm < 0.05) & (regions.nail < 0.1) & (regions.knuckle < 0.1)
    assert 0.005 < float(colors[back].std(0).mean()) < 0.04


def test_labels_are_the_same_on_any_device(hand, regions, device):
    found = label_regions(hand.to(device))
    for name, want in regions._asdict().items():
        torch.testing.assert_close(getattr(found, name).cpu(), want, rtol=0, atol=1e-5, msg=name)


def canonical_and_rest(hand):
    rest, _, _ = posed_hand(hand)
    anchors = place_anchors(hand, rest)
    return anchors.with_colors(torch.full((len(anchors.opacities), 3), 0.5)), rest


def covariances(gaussians):
    half = rotation.to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    return half @ half.transpose(1, 2)


def test_the_rest_pose_returns_the_canonical_gaussians(hand):
    canonical, rest = canonical_and_rest(hand)
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, rest.vertices)
    torch.testing.assert_close(posed.means, vertex_to_gaussians(rest.vertices, hand.faces, canonical))
    torch.testing.assert_close(posed.scales, canonical.scales, atol=1e-8, rtol=1e-4)
    dots = (posed.quats * canonical.quats).sum(-1).abs()
    assert float(dots.min()) > 1 - 1e-5


def test_a_rigid_motion_moves_gaussians_rigidly(hand):
    canonical, rest = canonical_and_rest(hand)
    shift = torch.tensor([0.1, -0.2, 0.5])
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, rest.vertices @ PALM_TO_CAMERA.T + shift)
    still = pose_gaussians(canonical, hand.faces, rest.vertices, rest.vertices)
    torch.testing.assert_close(posed.means, still.means @ PALM_TO_CAMERA.T + shift, atol=1e-6, rtol=0)
    rotated = PALM_TO_CAMERA @ covariances(still) @ PALM_TO_CAMERA.T
    torch.testing.assert_close(covariances(posed), rotated, atol=1e-10, rtol=1e-3)


def test_offsets_turn_with_the_surface(hand):
    canonical, rest = canonical_and_rest(hand)
    outwards = torch.zeros_like(canonical.offsets)
    outwards[:, 1] = 0.002
    lifted = canonical._replace(offsets=outwards)
    posed = pose_gaussians(lifted, hand.faces, rest.vertices, rest.vertices @ PALM_TO_CAMERA.T)
    n = len(canonical.vertex_index)
    expected = (rest.vertices[canonical.vertex_index] + outwards) @ PALM_TO_CAMERA.T
    torch.testing.assert_close(posed.means[:n], expected, atol=1e-6, rtol=0)


def test_gaussians_grow_with_the_surface_and_do_not_shrink(hand):
    """Skin is pressed together in one direction: in the palm of a fist gaps opened in the other, as light lines."""
    canonical, rest = canonical_and_rest(hand)
    small, large = (
        pose_gaussians(canonical, hand.faces, rest.vertices, size * rest.vertices).scales for size in (0.5, 2)
    )
    assert torch.equal(small, canonical.scales)
    torch.testing.assert_close(large, 2 * canonical.scales)


def test_the_mirrored_gaussians_on_the_mirrored_surface_are_the_mirror_image(hand):
    canonical, rest = canonical_and_rest(hand)
    generator = torch.Generator().manual_seed(0)
    canonical = canonical._replace(offsets=0.001 * torch.randn(canonical.offsets.shape, generator=generator))
    fist = posed_hand(hand, "fist")[2].vertices
    posed = pose_gaussians(canonical, hand.faces, rest.vertices, fist)
    mirrored = mirror_canonical(canonical)
    left = pose_gaussians(mirrored, hand.faces, mirror_points(rest.vertices), mirror_points(fist))
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    torch.testing.assert_close(left.means, posed.means @ flip, atol=1e-7, rtol=0)
    torch.testing.assert_close(covariances(left), flip @ covariances(posed) @ flip, atol=1e-12, rtol=1e-4)
    back = mirror_canonical(mirrored)
    assert back.shade is canonical.shade
    assert all(torch.equal(a, b) for a, b in zip(back[:-1], canonical[:-1], strict=True))


def test_many_poses_are_what_as_many_calls_give_and_a_measured_surface_poses_as_its_vertices(hand):
    canonical, rest = canonical_and_rest(hand)
    surfaces = [posed_hand(hand, name)[2].vertices for name in ("fist", "pinch")]
    still = rest_mesh(rest.vertices, hand.faces)
    together = pose_gaussians(canonical, hand.faces, still, torch.stack(surfaces))
    for k, posed in enumerate(surfaces):
        alone = pose_gaussians(canonical, hand.faces, rest.vertices, posed)
        assert all(torch.equal(a[k], b) for a, b in zip(together[:3], alone[:3], strict=True))
