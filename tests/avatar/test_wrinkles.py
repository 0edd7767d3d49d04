"""Skin has wrinkles where a pose compresses it more than in the photo."""

import numpy as np
import pytest
import torch
from synthetic import as_left_hand, avatar_of, crop_of, with_invented
from torch.nn.functional import normalize

from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.sky import studio_light
from oasis_warp.avatar.wrinkles import DEPTH_UNIT, HUE, PHASE_UNIT, STRENGTH, _wrinkles, wrinkle_logs


@pytest.fixture(scope="module")
def plain(hand):
    """An avatar of one colour, from a photo of an open hand."""
    crop, truth, source = crop_of(hand, torch.full_like(hand.template, 0.5), size=48)
    return avatar_of(hand, truth, source, crop.camera, None).in_light(studio_light())


def logs_of_wrinkles(avatar, pose):
    """What wrinkles add to the logarithms of colours in a pose."""
    smooth = avatar.with_looks(avatar.gaussians, avatar.light)
    smooth._creases = smooth._creases._replace(wrinkles=torch.zeros_like(smooth._creases.wrinkles))
    return (avatar.pose(pose).colors / smooth.pose(pose).colors).log()


def test_a_bent_thumb_bunches_the_skin_of_its_ball(hand, plain):
    """A fist made of an open hand had a palm as smooth as rubber."""
    at = torch.cat([plain.gaussians.vertex_index, hand.faces[plain.gaussians.face_index, 0].long()])
    palm = (skin_regions(hand).palm[at] > 0.5) & ((hand.segment[at] == 0) | ((hand.segment[at] - 1) % 3 == 0))
    logs = logs_of_wrinkles(plain, "fist")
    dark = logs[:, 1] < -0.1
    assert int(dark.sum()) > 200 and float(palm[dark].float().mean()) > 0.8
    assert abs(float(logs[palm, 1].mean())) < 0.05  # ridges between them are paler
    assert logs[dark].mean(0).tolist() == sorted(logs[dark].mean(0).tolist(), reverse=True)  # redder
    tips = (hand.bone_t > 0.5)[at] & (hand.nail > 0.5)[at]
    assert float(logs[tips].abs().max()) == 0


def test_the_photos_pose_has_no_wrinkles_but_its_own(plain):
    """The photo's view is matched to the photo: paint over it would be seen twice."""
    assert float(logs_of_wrinkles(plain, plain.source_pose).abs().max()) < 1e-6


def test_painted_skin_has_them_even_in_the_photos_pose(hand):
    """A palm that a fist's photo hides is painted as that of an open hand."""
    crop, truth, source = crop_of(hand, torch.full_like(hand.template, 0.5), size=48, pose_name="fist")
    seen = avatar_of(hand, truth, source, crop.camera, None).in_light(studio_light())
    assert float(logs_of_wrinkles(seen, source).abs().max()) < 1e-6
    painted = with_invented(seen, torch.ones(len(hand.template)))
    assert float(logs_of_wrinkles(painted, source)[:, 1].min()) < -0.1


def test_both_sides_have_the_same(plain):
    left = as_left_hand(plain)
    torch.testing.assert_close(left.pose("fist").colors, plain.pose("fist").colors, rtol=0, atol=2e-3)


def test_wrinkles_run_across_the_compression(hand, plain):
    """Along it they would be stretch marks."""
    phase, depth = _wrinkles()
    flat, fist = (plain.mesh(name).vertices[hand.faces.long()] for name in ("open", "fist"))
    sides = flat[:, 1:] - flat[:, :1]
    steps = (phase[0, hand.faces[:, 1:].long()] - phase[0, hand.faces[:, :1].long()])[..., None]
    uphill = normalize((torch.linalg.pinv(sides) @ steps)[..., 0], dim=1)
    level = normalize(torch.linalg.cross(uphill, torch.linalg.cross(sides[:, 0], sides[:, 1])), dim=1)
    growth = []
    for direction in (uphill, level):  # as a mix of two sides of the face, which the pose takes along
        mix = torch.linalg.pinv(sides.transpose(1, 2)) @ direction[..., None]
        growth.append((mix * (fist[:, 1:] - fist[:, :1])).sum(1).norm(dim=1))
    pressed = growth[0] * growth[1] < 0.6
    wrinkled = pressed & (depth[0, hand.faces.long()].amin(1) > 0.3)
    assert int(wrinkled.sum()) > 300
    assert float(growth[0][wrinkled].median()) < 0.7 * float(growth[1][wrinkled].median())


def test_wrinkles_are_dark_lines_of_a_millimetre(hand, plain):
    """Blurred they would be a stain; their mean hardly changes the skin."""
    logs = wrinkle_logs(hand, plain.gaussians)
    some = logs[(logs[:, 1].abs() > 0.01)]
    assert len(some) > 2000
    assert float(logs.min()) > -1.6 * sum(STRENGTH) * HUE[2]
    assert float((some[:, 1] < -0.05).float().mean()) < 0.3
    assert -0.05 < float(some.mean()) < 0.01


def test_the_file_is_the_one_that_its_tool_builds(hand):
    from build_wrinkles import wrinkles

    phase, depth = _wrinkles()
    built = wrinkles(hand)
    np.testing.assert_allclose(built["phase"] * PHASE_UNIT, phase, atol=0.02)
    np.testing.assert_allclose(built["depth"] * DEPTH_UNIT, depth, atol=0.02)
