import pytest
import torch
from synthetic import as_left_hand, avatar_of, crop_of

from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.creases import SHALLOW, find_creases, stretched_share
from oasis_warp.avatar.sky import studio_light
from oasis_warp.core import surface

DARK = -0.5
"""Logarithm by which a crease is darker."""


@pytest.fixture(scope="module")
def creased(hand):
    """An avatar of a fist's photo with a dark crease across the ball of the thumb."""
    ball = hand.template[hand.segment == hand.joint_names.index("thumb1")].mean(0)
    line = (hand.template[:, 0] - ball[0]).abs() < 0.002
    colors = 0.5 * torch.where(line, DARK, 0.0).exp()[:, None].expand(-1, 3)
    crop, truth, source = crop_of(hand, colors, size=48, pose_name="fist")
    return avatar_of(hand, truth, source, crop.camera, None).in_light(studio_light())


def creases_of(avatar, invented=None):
    flat = avatar._surface_in(avatar.held("open"))
    return find_creases(avatar.hand, avatar.gaussians, invented, avatar._photo_surface(), flat, avatar.parts.folds)


def without_wrinkles(creases):
    """Those that only go flat."""
    kept = creases.change.abs().amax(1) > 0
    return creases._replace(index=creases.index[kept], change=creases.change[kept], wrinkles=creases.wrinkles[kept])


def test_creases_of_the_palm_are_found_up_to_shallow_ones(hand, creased):
    creases = without_wrinkles(creases_of(creased))
    dark = creased.gaussians.colors[creases.index, 0] < 0.32
    most = creases.change[dark].median()
    assert -DARK - SHALLOW - 0.12 < float(most) < -DARK - SHALLOW + 0.01
    assert float(creases.change[creased.gaussians.colors[creases.index, 0] > 0.48].abs().median()) < 0.01
    at = torch.cat([creased.gaussians.vertex_index, hand.faces[:, 0]])[creases.index]
    assert float(skin_regions(hand).palm[at].quantile(0.02)) > 0
    assert not torch.isin(creases.index, creased.parts.folds.index).any()


def test_ink_on_a_palm_stays(hand, creased):
    """A word on a palm would fade as the hand opens."""
    dark = creased.gaussians.colors < 0.32
    colors = torch.where(dark, 0.08, creased.gaussians.colors)
    inked = creased.with_looks(creased.gaussians._replace(colors=colors), creased.light)
    of_lines, of_ink = (int(dark[without_wrinkles(creases_of(avatar)).index, 0].sum()) for avatar in (creased, inked))
    assert of_lines > 100 and of_ink < of_lines / 10


def test_skin_is_flat_where_it_is_stretched_and_as_in_the_photo_in_its_pose(creased):
    """Skin that a bent thumb had bunched was a lump of putty on an open hand."""
    creases, photo, opened = creases_of(creased), creased._photo_surface(), creased.mesh("open").vertices
    assert float(stretched_share(creases, photo).abs().amax()) == 0
    share = stretched_share(creases, opened)
    before, after = (surface.vertex_areas(vertices, creased.hand.faces) for vertices in (photo, opened))
    grown = surface.smooth_over_mesh((after / before).log()[:, None], surface.mesh_edges(creased.hand.faces), 6)[:, 0]
    assert float(share[grown > 0.35].mean()) > 0.9 and float(share[grown < -0.05].clamp_min(0).mean()) < 0.1
    torch.testing.assert_close(stretched_share(creases, torch.stack([photo, opened]))[1], share)
    turned = opened @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + 0.3
    torch.testing.assert_close(stretched_share(creases, turned), share, rtol=0, atol=1e-4)


def test_painted_palms_keep_theirs(hand, creased):
    """They are those of an open hand."""
    assert len(without_wrinkles(creases_of(creased, torch.ones(len(hand.template)))).index) == 0


def test_avatars_of_both_sides_are_posed_with_flat_creases(creased):
    plain = creased.with_looks(creased.gaussians, creased.light)
    plain._creases = None
    change = (creased.pose("open").colors / plain.pose("open").colors).log()[creased.parts.creases.index]
    assert float((change - creased.parts.creases.change).abs().median()) < 0.02
    assert float(change.amax()) > 0.1
    torch.testing.assert_close(
        as_left_hand(creased).pose("open").colors, creased.pose("open").colors, rtol=0, atol=2e-3
    )
