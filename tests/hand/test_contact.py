"""Fingers and palm of a posed hand give way to each other instead of passing through."""

import math

import pytest
import torch
from hand_build.quality import self_crossings
from synthetic import avatar_of, crop_of

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.core import rotation, surface
from oasis_warp.core.mirror import mirror_points
from oasis_warp.core.processes import using_threads
from oasis_warp.core.types import HandPose
from oasis_warp.hand.contact import LIMIT, giving_way
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin_surface


def posed(hand, name, seed):
    """The surface of a hand of random shape."""
    shape = torch.randn(40, generator=torch.Generator().manual_seed(seed))
    pose = HandPose(named_pose(hand, name), torch.eye(3), torch.zeros(3))
    return skin_surface(hand, rest_hand(hand, shape), pose)


@pytest.fixture(scope="module")
def fist(hand):
    """Its fingers pass through each other and the palm: 1153 edges cross."""
    return posed(hand, "fist", 104)


@pytest.fixture(scope="module")
def led_out(hand, fist):
    return giving_way(hand, fist)


def test_a_fist_of_another_shape_crosses_itself_ten_times_less(hand, fist, led_out):
    before, after = (self_crossings(each.numpy(), hand.faces.numpy()) for each in (fist, led_out))
    assert before > 1000
    assert after < before / 10


def test_no_vertex_moves_farther_than_the_limit_and_nails_do_not_move(hand, fist, led_out):
    shift = (led_out - fist).norm(dim=1)
    assert 0.001 < float(shift.max()) <= LIMIT * (1 + 1e-4)
    assert float(shift[hand.nail > 0.5].max()) == 0


def test_flesh_is_dented_without_spikes(hand, fist, led_out):
    """Without the mean over neighbours, the ends of some edges of 2 mm moved apart by more than that."""
    a, b = (led_out - fist)[surface.mesh_edges(hand.faces)].unbind(1)
    steps = (a - b).norm(dim=1)
    assert float(steps.max()) < 0.0015


def test_what_no_contact_reaches_stays_to_the_bit(hand, fist, led_out):
    still = (led_out == fist).all(1)
    assert still[hand.rim].all()
    assert 0.5 < float(still.float().mean()) < 0.95
    opened = posed(hand, "open", 103)
    assert torch.equal(giving_way(hand, opened), opened)


def test_a_left_hand_gives_way_as_its_mirror_image(hand, fist, led_out):
    mirrored = giving_way(hand, mirror_points(fist), "left")
    torch.testing.assert_close(mirrored, mirror_points(led_out), rtol=0, atol=1e-6)


def test_a_hand_that_moves_as_a_whole_gives_way_alike(hand, fist, led_out, device):
    turn = rotation.from_axis_angle(torch.tensor([0.6, 0.0, 0.8]), torch.tensor(1.9))
    shift = torch.tensor([0.1, -0.2, 0.4])
    moved = giving_way(hand.to(device), (fist @ turn.T + shift).to(device)).cpu()
    off = (moved - (led_out @ turn.T + shift)).norm(dim=1)
    assert float((off > 1e-5).float().mean()) < 0.003  # of two vertices equally near it may take the other


def test_many_poses_and_threads_give_the_same_bits(hand, fist, led_out):
    with using_threads(3):
        both = giving_way(hand, torch.stack([posed(hand, "open", 103), fist]))
    assert torch.equal(both[1], led_out)


def test_the_shift_is_a_constant_to_derivatives(hand, fist):
    vertices = fist.double().requires_grad_()
    (slope,) = torch.autograd.grad(giving_way(hand, vertices).sum(), vertices)
    assert slope.eq(1).all()


def test_an_avatar_is_posed_out_of_its_own_flesh_but_in_the_photos_pose(hand):
    """There colours were learned on skin that passes through other skin: moved apart it showed dark dots."""
    crop, truth, source = crop_of(hand, 0.8 * region_colors(label_regions(hand), 0.03), pose_name="fist", size=48)
    avatar = avatar_of(hand, truth, source, crop.camera, None)

    def surfaces(degrees):
        angles = source.angles.clone()
        angles[0, 0] -= math.radians(degrees)
        pose = source._replace(angles=angles)
        plain = skin_surface(avatar.parts.hand, avatar.parts.rest, pose)
        return avatar.pose(pose).means[: len(truth.vertex_index)], avatar.mesh(pose).vertices, plain

    _, made, plain = surfaces(0)
    assert torch.equal(made, plain)
    means, made, plain = surfaces(11)
    assert torch.equal(made, giving_way(hand, plain)) and not torch.equal(made, plain)
    torch.testing.assert_close(means, made[truth.vertex_index])
    _, made, plain = surfaces(5)
    torch.testing.assert_close(made - plain, (giving_way(hand, plain) - plain) / 2, rtol=1e-3, atol=1e-7)


@pytest.mark.gpu
def test_giving_way_is_recorded_in_a_graph(hand, fist):
    hand, vertices = hand.to("cuda"), fist.to("cuda")
    expected = giving_way(hand, vertices)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        made = giving_way(hand, vertices)
    graph.replay()
    assert torch.equal(made, expected)
