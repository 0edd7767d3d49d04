"""The end of the hand: opaque, and continued by an arm that fades."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import RIM_FADE, place_anchors, vertex_to_gaussians
from oasis_warp.avatar.densify import densify
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.vertex_light import with_photo
from oasis_warp.avatar.wrist import (
    ARM_LENGTH,
    BEFORE_RIM,
    SHADE_FADE,
    arm_axis,
    close_wrist,
    end_shade,
    fading_arm,
    rim_axis,
)
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.types import HandLight, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.render import render

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
    logs = (after.colors[end(after)] / SKIN).log()
    assert logs.mean(0).abs().max() < 0.03 and 0.01 < logs.std() < 0.06 and logs.abs().max() < 0.25  # its own pattern


def test_the_end_does_not_repeat_what_is_loud_before_it(hand, hands):
    """Beside the edge of a sleeve each value was clamped by itself, which left .05: a mottled patch."""
    rest, before, _ = hands
    noise = 0.3 * torch.randn(len(before.colors), 1, generator=torch.Generator().manual_seed(0))
    after = close_wrist(hand, before._replace(colors=(before.colors * noise.exp()).clamp(max=1)), rest)
    on_end = (torch.cdist(centers(hand, rest, after), rest[hand.rim]).amin(1) < 0.3 * RIM_FADE).nonzero()[:, 0]
    logs = after.colors[on_end[on_end >= len(after.vertex_index)]].log()
    assert 0.01 < (logs - logs.mean(0)).std() < 0.06
    far = torch.cdist(centers(hand, rest, after), rest[hand.rim]).amin(1)
    before_end = ((far > RIM_FADE) & (far < RIM_FADE + 0.2 * SHADE_FADE)).nonzero()[:, 0]
    logs = after.colors[before_end].log()
    assert (logs - logs.mean(0)).std() < 0.12  # it was .3, and ended at the rim in specks


def test_a_black_hand_has_no_colours_that_are_no_numbers(hand, hands):
    """The hand's colours are mixed with those of the arm by their ratio."""
    rest, before, _ = hands
    after = close_wrist(hand, before._replace(colors=torch.zeros_like(before.colors)), rest)
    assert bool(after.colors.isfinite().all()) and float(after.colors.amax()) < 0.05


def test_the_arms_detail_varies_along_it(hand, hands):
    """It repeated the hand's skin in the mirror, which looked like grain of wood, and once one row of it: streaks."""
    rest, before, _ = hands
    noise = 0.1 * torch.randn(len(before.colors), 1, generator=torch.Generator().manual_seed(0))
    rough = before._replace(colors=(before.colors * noise.exp()).clamp(max=1))
    after, other = (close_wrist(hand, rough, rest, seed=seed) for seed in (0, 1))
    assert not torch.equal(after.colors, other.colors)
    axis, arm = rim_axis(rest, hand.rim), arm_of(hand, rest, after)
    at = centers(hand, rest, after)[arm] - rest[hand.rim].mean(0)
    height, logs = at @ axis, after.colors[arm].log().mean(1)
    out = at - height[:, None] * axis
    chosen = (height > 0.055) & (out.norm(dim=1) > 0.02)
    across = normalize(rest[hand.rim[0]] - rest[hand.rim].mean(0), dim=0)
    angle = torch.atan2(out @ torch.linalg.cross(axis, across), out @ across)[chosen]
    sector, logs = ((angle / math.pi + 1) * 32).long().clamp(0, 63), logs[chosen]
    count = torch.bincount(sector, minlength=64).clamp_min(1)
    means = torch.bincount(sector, logs, minlength=64) / count
    assert float((logs - means[sector]).var() / logs.var()) > 0.6


def test_the_hand_beyond_the_fade_keeps_its_bits_and_the_arm_goes_with_the_wrist(hand, hands):
    rest, before, after = hands
    arm = arm_of(hand, rest, after)
    own = torch.ones(len(after.opacities), dtype=torch.bool).index_fill(0, arm, False)
    changed = RIM_FADE + SHADE_FADE + 0.004  # a face wide
    beyond = [torch.cdist(centers(hand, rest, g), rest[hand.rim]).amin(1) > changed for g in hands[1:]]
    for name in ("quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(before, name)[beyond[0]], getattr(after, name)[beyond[1] & own])
    fist = HandPose(named_pose(hand, "fist"), torch.eye(3), torch.zeros(3))
    posed = skin(hand, rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1])), fist).vertices
    still, moved = (pose_gaussians(after, hand.faces, rest, to).means for to in (rest, posed))
    assert (moved - still)[arm].norm(dim=1).max() < 1e-3  # its end swayed by 14 mm, when the rim moved with the thumb


def test_the_arm_fades_from_the_rim_on(hand, hands):
    """A hand that ended at once looked sawn off, in all of 52 sheets."""
    rest, _, after = hands
    axis, middle, arm = rim_axis(rest, hand.rim), rest[hand.rim].mean(0), arm_of(hand, rest, after)
    arm = arm[after.scales[arm].std(dim=1) > 1e-6]  # without the balls inside
    height = (centers(hand, rest, after)[arm] - middle) @ axis
    end = 0.9 * ARM_LENGTH
    assert 0 < height.min() < 0.004 and end < height.max() < ARM_LENGTH
    assert after.opacities[arm][height < 0.005].min() > 0.6 and after.opacities[arm][height > end].max() < 0.06
    camera = orbit_camera(torch.cat([rest, rest + ARM_LENGTH * axis]), 0.0, size=128)
    alpha = render(pose_gaussians(after, hand.faces, rest, rest), camera).alpha
    seen = []
    for share in (0.3, 0.7, 0.95):
        x, y = project(camera, (middle + share * ARM_LENGTH * axis)[None])[0][0].long()
        seen.append(float(alpha[y, x]))
    assert seen[0] > 0.95 and 0.5 < seen[1] < 0.98 and seen[2] < 0.3


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
    on_rim = torch.isin(after.vertex_index, hand.rim)
    on_rim[arm_of(hand, rest, after)] = False
    second = torch.cdist(at[on_rim], at[on_rim]).topk(3, largest=False).values[:, 2]  # after itself and one side
    assert (second < 1.8 * after.scales[: len(on_rim), 0][on_rim]).all()


def test_two_colours_of_the_arm_meet_gradually_in_its_middle(hand, hands):
    """With one width of averaging its middle was cut in two: far from all skin, the nearest alone counted."""
    rest, before, _ = hands
    side = (rest[:, 1] > rest[hand.rim, 1].mean()).float()[:, None]
    two = before._replace(colors=torch.where(vertex_to_gaussians(side, hand.faces, before) > 0.5, SKIN, PALM))
    after = close_wrist(hand, two, rest)
    arm = arm_of(hand, rest, after)
    arm = arm[after.scales[arm].std(dim=1) < 1e-6]  # the balls inside
    at = centers(hand, rest, after)[arm]
    near = torch.cdist(at, at) < 0.0045
    steps = (after.colors[arm][:, None] - after.colors[arm][None]).abs().amax(-1)[near]
    assert steps.max() < 0.25 * (SKIN - PALM).abs().max()


def test_the_arm_has_no_shade(hand, hands):
    rest, before, _ = hands
    shaded = before._replace(shade=torch.full_like(before.colors, 0.4))
    after = close_wrist(hand, shaded, rest)
    assert after.shade is not None and after.shade.min() == pytest.approx(0.4)
    assert after.shade[arm_of(hand, rest, after)].min() > 0.999


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


def test_the_arm_goes_half_way_from_the_rims_normal_to_the_skins_direction(hand):
    """Along the normal of a rim that is cut aslant, the arm turned back from the palm and stood on it with a step."""
    normal, along = rim_axis(hand.template, hand.rim), arm_axis(hand.template, hand.rim)
    assert 7 < math.degrees(math.acos(float(normal @ along))) < 10  # half of 17
    assert along[1] < normal[1]  # towards the palm


def test_the_arm_leaves_the_rim_as_the_skin_reaches_it(hand):
    """Straight from the rim on, it turned by up to 24 degrees, a step in outlines at the wrist."""
    rest, rim = hand.template, hand.rim
    axis, middle = arm_axis(rest, rim), rest[rim].mean(0)
    index, offsets, *_ = fading_arm(rest, rim)
    outside = offsets.norm(dim=1) < 0.006  # of the balls inside none is near
    arm, skin = (rest[index] + offsets)[outside], rest[torch.cdist(rest, rest[rim]).amin(1) < BEFORE_RIM]

    def outlines(points):
        """Where they lie around the axis, along it, and how far from it."""
        along = (points - middle) @ axis
        away = points - middle - along[:, None] * axis
        return away / away.norm(dim=1, keepdim=True), along, away.norm(dim=1)

    turns = []
    for at in outlines(rest[rim])[0]:
        slopes = []
        for around, along, radius in map(outlines, (skin, arm)):
            near = (around @ at > math.cos(0.2)).double()
            rows = torch.stack([torch.ones_like(near), along.double()], 1)
            line = torch.linalg.lstsq(rows * near[:, None], (radius.double() * near)[:, None]).solution
            slopes.append(math.degrees(math.atan(float(line[1]))))
        turns.append(abs(slopes[1] - slopes[0]))
    assert sorted(turns)[int(0.9 * len(turns))] < 11  # of 15 along one axis
