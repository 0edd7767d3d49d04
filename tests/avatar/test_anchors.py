"""Gaussians of a hand that nobody has photographed yet: where they lie, their colours, their wrist, their pose."""

import math

import pytest
import torch
from synthetic import PALM_TO_CAMERA, posed_hand

from oasis_warp.avatar.anchors import MIN_OPACITY, OPACITY, RIM_FADE, place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import (
    BLOOD,
    MELANIN,
    label_regions,
    region_colors,
    region_masks,
    skin_color,
)
from oasis_warp.avatar.densify import densify
from oasis_warp.avatar.pose import pose_gaussians, with_photo
from oasis_warp.avatar.wrist import ARM_LENGTH, SHADE_FADE, close_wrist, end_shade, fading_arm, rim_axis
from oasis_warp.core import rotation, surface
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.mirror import mirror_canonical, mirror_points
from oasis_warp.core.types import HandLight, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.ops import rest_mesh
from oasis_warp.render import render


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


SLEEVE, SKIN, PALM = torch.tensor([0.1, 0.2, 0.6]), torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.2, 0.5, 0.1])


@pytest.fixture(scope="module", params=[False, True], ids=["coarse", "fine"])
def hands(hand, request):
    """A hand at rest with a sleeve at the rim, then skin, then something else; the same closed."""
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1]))
    anchors, vertices = place_anchors(hand, rest), rest.vertices
    away = torch.cdist(vertices, vertices[hand.rim]).amin(1)
    at = torch.cat([away[anchors.vertex_index], away[hand.faces[anchors.face_index]].amin(1)])[:, None]
    colors = torch.where(at < 0.6 * RIM_FADE, SLEEVE, torch.where(at < 0.03, SKIN, PALM))
    gaussians = anchors.with_colors(colors)
    if request.param:
        gaussians = densify(gaussians, vertices, hand.faces, torch.full((len(hand.faces),), 2)).gaussians
    return vertices, gaussians, close_wrist(hand, gaussians, vertices)


def centers(hand, rest, gaussians):
    on_faces = (rest[hand.faces[gaussians.face_index]] * gaussians.barycentrics[..., None]).sum(1)
    return torch.cat([rest[gaussians.vertex_index] + gaussians.offsets, on_faces])


def arm_of(hand, rest, gaussians):
    """Indices of the arm's Gaussians, the last of those on vertices."""
    end, count = len(gaussians.vertex_index), len(fading_arm(rest, hand.rim)[0])
    return torch.arange(end - count, end)


def test_nobody_looks_into_a_hand(hand, hands):
    rest, before, after = hands
    camera = orbit_camera(rest, -math.pi / 2, size=96)  # where the arm would be: the hand lies along -x
    middle = rest[hand.rim].mean(0)
    points = (middle + 0.6 * (rest[hand.rim] - middle)) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    x, y, _ = (points @ camera.K.T / points[:, 2:]).long().unbind(1)
    opened, closed = (
        render(pose_gaussians(g, hand.faces, rest, rest), camera).image[y, x] for g in (before, after)
    )
    assert (closed - SKIN).abs().max() < 0.06
    assert (opened - SKIN).abs().max() > 0.3


def test_the_end_is_opaque_and_has_the_colour_of_the_skin_before_it(hand, hands):
    rest, before, after = hands

    def end(gaussians):
        return torch.cdist(centers(hand, rest, gaussians), rest[hand.rim]).amin(1) < 0.3 * RIM_FADE

    skin = end(after)
    skin[arm_of(hand, rest, after)] = False
    assert after.opacities[skin].min() > 0.9 and before.opacities[end(before)].median() < 0.5
    apart = (after.colors[end(after)] - SKIN).abs()
    assert apart.median() < 1e-3 and apart.max() < 0.06  # the detail of the edge to the palm comes along


def test_the_detail_of_the_end_is_no_louder_than_skin(hand, hands):
    """Beside the edge of a sleeve each value was clamped by itself, which left .05: a mottled patch."""
    rest, before, _ = hands
    noise = 0.3 * torch.randn(len(before.colors), 1, generator=torch.Generator().manual_seed(0))
    after = close_wrist(hand, before._replace(colors=(before.colors * noise.exp()).clamp(max=1)), rest)
    on_end = (torch.cdist(centers(hand, rest, after), rest[hand.rim]).amin(1) < 0.3 * RIM_FADE).nonzero()[:, 0]
    logs = after.colors[on_end[on_end >= len(after.vertex_index)]].log()
    assert 0.01 < (logs - logs.mean(0)).std() < 0.04
    far = torch.cdist(centers(hand, rest, after), rest[hand.rim]).amin(1)
    before_end = ((far > RIM_FADE) & (far < RIM_FADE + 0.2 * SHADE_FADE)).nonzero()[:, 0]
    logs = after.colors[before_end].log()
    assert (logs - logs.mean(0)).std() < 0.12  # it was .3, and ended at the rim in specks


def test_the_hand_beyond_the_fade_keeps_its_bits_and_the_cap_goes_with_the_wrist(hand, hands):
    rest, before, after = hands
    cap = torch.zeros(len(after.opacities), dtype=torch.bool)
    cap[: len(after.vertex_index)] = after.offsets.norm(dim=1) > 2e-3
    changed = RIM_FADE + SHADE_FADE + 0.004  # a face wide
    beyond = [torch.cdist(centers(hand, rest, g), rest[hand.rim]).amin(1) > changed for g in hands[1:]]
    for name in ("quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(before, name)[beyond[0]], getattr(after, name)[beyond[1] & ~cap])
    fist = HandPose(named_pose(hand, "fist"), torch.eye(3), torch.zeros(3))
    posed = skin(hand, rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1])), fist).vertices
    still, moved = (pose_gaussians(after, hand.faces, rest, to).means for to in (rest, posed))
    shift, arm = (moved - still).norm(dim=1), arm_of(hand, rest, after)
    assert shift[arm].max() < 1e-3  # its end swayed by 14 mm, when the rim moved with the thumb
    shift[arm] = 0
    assert shift[cap].max() < 1e-4


def test_the_arm_fades_from_the_rim_on_and_hides_the_cap_along_it(hand, hands):
    """A hand that ended at once looked sawn off, in all of 52 sheets."""
    rest, _, after = hands
    axis, middle, arm = rim_axis(rest, hand.rim), rest[hand.rim].mean(0), arm_of(hand, rest, after)
    height = (centers(hand, rest, after)[arm] - middle) @ axis
    end = 0.9 * ARM_LENGTH
    assert 0 < height.min() < 0.004 and end < height.max() < ARM_LENGTH
    assert after.opacities[arm][height < 0.005].min() > 0.6 and after.opacities[arm][height > end].max() < 0.03
    camera = orbit_camera(torch.cat([rest, rest + ARM_LENGTH * axis]), 0.0, size=128)
    alpha = render(pose_gaussians(after, hand.faces, rest, rest), camera).alpha
    seen = []
    for share in (0.3, 0.7, 0.95):
        x, y = project(camera, (middle + share * ARM_LENGTH * axis)[None])[0][0].long()
        seen.append(float(alpha[y, x]))
    assert seen[0] > 0.95 and 0.5 < seen[1] < 0.95 and seen[2] < 0.3


def test_light_falls_on_the_arm_as_on_the_skin_before_it(hand, hands):
    """It came by the arm's own normals, which are not those of a wrist that narrows: a line around the wrist."""
    rest, _, after = hands
    above = torch.tensor([[1.0], [0.0], [0.8], [0.0]]).expand(4, 3)
    lamp = HandLight(above, torch.tensor([[0.1] * 3, [3.0] * 3]), torch.ones(3))
    lit = pose_gaussians(after, hand.faces, rest, rest, with_photo(lamp, rest, rest, hand.faces)).colors
    factor, at = (lit / after.colors)[:, 0], centers(hand, rest, after)
    arm = arm_of(hand, rest, after)
    arm = arm[torch.cdist(at[arm], rest[hand.rim]).amin(1) < 0.003]
    skin = torch.ones(len(at), dtype=torch.bool)
    skin[: len(after.vertex_index)] = ~torch.isin(after.vertex_index, hand.rim)
    apart, nearest = torch.cdist(at[arm], at[skin]).min(1)
    assert apart.max() < 0.006 and factor[arm].max() > 1.4 * factor[arm].min()
    assert (factor[arm] / factor[skin][nearest]).log().abs().median() < 0.02


def test_the_cap_goes_on_from_the_skin_without_an_edge(hand, hands):
    rest, _, after = hands
    at = rest[after.vertex_index] + after.offsets
    normals = rotation.to_matrix(after.quats[: len(at)])[:, :, 2]
    own = torch.isin(after.vertex_index, hand.rim)
    pairs = torch.cdist(at[own], at[own]) < 0.001
    assert (normals[own] @ normals[own].T)[pairs].min() > math.cos(math.radians(50))


def test_a_small_photos_hand_without_gaussians_on_faces_is_closed_too(hand, hands):
    rest, before, after = hands
    n = len(before.vertex_index)
    few = before._replace(
        face_index=before.face_index[:0], barycentrics=before.barycentrics[:0],
        **{name: getattr(before, name)[:n] for name in ("quats", "scales", "opacities", "colors")},
    )  # fmt: skip
    closed = close_wrist(hand, few, rest)
    assert int(torch.isin(closed.vertex_index, hand.rim).sum()) == int(torch.isin(after.vertex_index, hand.rim).sum())


def test_the_rim_ends_without_teeth(hand, hands):
    """One Gaussian on each of its vertices, 2.5 mm apart, drew a saw."""
    rest, _, after = hands
    at = rest[after.vertex_index] + after.offsets
    on_rim = torch.isin(after.vertex_index, hand.rim) & (after.offsets.norm(dim=1) < 2e-3)
    second = torch.cdist(at[on_rim], at[on_rim]).topk(3, largest=False).values[:, 2]  # after itself and one side
    assert (second < 1.8 * after.scales[: len(on_rim), 0][on_rim]).all()


def test_two_colours_of_the_arm_meet_gradually_on_the_cap(hand, hands):
    """With one width of averaging its middle was cut in two: far from all skin, the nearest alone counted."""
    rest, before, _ = hands
    side = (rest[:, 1] > rest[hand.rim, 1].mean()).float()[:, None]
    two = before._replace(colors=torch.where(vertex_to_gaussians(side, hand.faces, before) > 0.5, SKIN, PALM))
    after = close_wrist(hand, two, rest)
    cap = torch.nonzero(after.offsets.norm(dim=1) > 2e-3)[:, 0]
    at = (rest[after.vertex_index] + after.offsets)[cap]
    near = torch.cdist(at, at) < 0.0035
    steps = (after.colors[cap][:, None] - after.colors[cap][None]).abs().amax(-1)[near]
    assert steps.max() < 0.25 * (SKIN - PALM).abs().max()


def test_shade_of_the_arm_ends_before_the_cap(hand, hands):
    rest, before, _ = hands
    shaded = before._replace(shade=torch.full_like(before.colors, 0.4))
    after = close_wrist(hand, shaded, rest)
    cap = torch.nonzero(after.offsets.norm(dim=1) > 2e-3)[:, 0]
    assert after.shade is not None and after.shade[cap].min() > 0.999 and after.shade.min() == pytest.approx(0.4)


def test_shade_ends_three_centimetres_before_the_wrist_does(hand, hands):
    """The dark of a sleeve ended a centimetre before it: a burnt stump from every side."""
    rest, before, _ = hands
    far = torch.cdist(rest, rest[hand.rim]).amin(1)
    light = HandLight(torch.ones(1, 3), torch.ones(2, 3), torch.ones(3), torch.full_like(rest, 0.4))
    of_vertices = end_shade(hand, light, rest).shade
    after = close_wrist(hand, before._replace(shade=torch.full_like(before.colors, 0.4)), rest)
    count = len(after.vertex_index)
    assert of_vertices is not None and after.shade is not None
    for shade, distance in (of_vertices, far), (after.shade[:count], far[after.vertex_index]):
        assert shade[distance < 0.008].min() == 1
        assert 0.55 < shade[(distance > 0.018) & (distance < 0.02)].mean() < 0.75
        assert shade[distance > 0.0301].max() == pytest.approx(0.4)


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
