"""Posed skin touches skin without passing through it, and named poses touch alike on hands of all shapes."""

import math
from statistics import median

import numpy as np
import pytest
import torch
from hand_build.quality import self_crossings
from scipy.ndimage import binary_fill_holes
from synthetic import avatar_of, crop_of

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.core import rotation, surface
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.mirror import mirror_points
from oasis_warp.core.processes import using_threads
from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.hand.contact import CREVICE, LIMIT, resolve_contact
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import rest_hand, skin, skin_surface
from oasis_warp.ops import depth_map


def posed(hand, name, seed):
    """The surface of a hand of random shape."""
    rest = rest_hand(hand, torch.randn(40, generator=torch.Generator().manual_seed(seed)))
    return skin_surface(hand, rest, HandPose(named_pose(hand, name, rest).float(), torch.eye(3), torch.zeros(3)))


@pytest.fixture(scope="module")
def fist(hand):
    """Its fingers pass through each other and the palm: 1040 edges cross."""
    return posed(hand, "fist", 105)


@pytest.fixture(scope="module")
def led_out(hand, fist):
    return resolve_contact(hand, fist).vertices


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
    assert float(steps.max()) < 0.0025


def test_what_no_contact_reaches_stays_to_the_bit(hand, fist, led_out):
    still = (led_out == fist).all(1)
    assert still[hand.rim].all()
    assert 0.5 < float(still.float().mean()) < 0.95
    opened = posed(hand, "open", 103)
    assert torch.equal(resolve_contact(hand, opened).vertices, opened)


def test_a_left_hand_gives_way_as_its_mirror_image(hand, fist, led_out):
    mirrored = resolve_contact(hand, mirror_points(fist), "left").vertices
    torch.testing.assert_close(mirrored, mirror_points(led_out), rtol=0, atol=1e-6)


def test_a_hand_that_moves_as_a_whole_gives_way_alike(hand, fist, led_out, device):
    turn = rotation.from_axis_angle(torch.tensor([0.6, 0.0, 0.8]), torch.tensor(1.9))
    shift = torch.tensor([0.1, -0.2, 0.4])
    moved = resolve_contact(hand.to(device), (fist @ turn.T + shift).to(device)).vertices.cpu()
    off = (moved - (led_out @ turn.T + shift)).norm(dim=1)
    assert float((off > 1e-5).float().mean()) < 0.003  # of two vertices equally near it may take the other


def test_near_the_photos_pose_skin_gives_way_in_part(hand, fist, led_out, device):
    changes = torch.tensor([0.01, math.radians(-5), 0.0], device=device)
    made = resolve_contact(hand.to(device), fist.to(device), changes=changes).vertices.cpu()
    off = (made - torch.lerp(fist, led_out, 0.5)).norm(dim=1)
    assert float((off > 1e-5).float().mean()) < 0.003


def test_closeness_is_that_to_skin_that_faces(hand, fist, led_out, device):
    """Against every vertex of other bones."""
    closeness = resolve_contact(hand.to(device), fist.to(device)).closeness
    assert closeness is not None
    closeness = closeness.cpu()
    near = closeness > 0
    assert 0.1 < float(near.float().mean()) < 0.6
    gaps = -CREVICE * closeness[near].log()
    normals = surface.vertex_normals(led_out, hand.faces)
    other = (normals[near] @ normals.T < 0) & (hand.segment[near, None] != hand.segment)
    away = torch.cdist(led_out[near], led_out).where(other, math.inf).amin(1)
    assert float((gaps - away).abs().quantile(0.9)) < 0.0025
    touches, apart = (away > 0.001) & (away < 0.002), away > 0.004
    assert float(gaps[touches].median()) < 0.0015 < 0.003 < float(gaps[apart].median())


def test_closeness_begins_at_the_photos_pose(hand, fist, device):
    """In the photo's pose skin shows its own dark lines; a step there would be seen in motion."""
    model, surfaces = hand.to(device), torch.stack([fist] * 3).to(device)
    changes = torch.tensor([[0.0], [math.radians(0.1)], [math.radians(10)]], device=device)
    closeness = resolve_contact(model, surfaces, changes=changes).closeness
    assert closeness is not None
    none, little, whole = closeness.cpu()
    assert float(none.amax()) == 0 and 0 < float(little.amax()) <= 0.01001 and float(whole.amax()) > 0.6
    assert resolve_contact(hand, fist, changes=torch.zeros(1)).closeness is None


def test_many_poses_and_threads_give_the_same_bits(hand, fist, led_out):
    with using_threads(3):
        both = resolve_contact(hand, torch.stack([posed(hand, "open", 103), fist]))
    assert torch.equal(both.vertices[1], led_out)


def test_the_shift_is_a_constant_to_derivatives(hand, fist):
    vertices = fist.double().requires_grad_()
    (slope,) = torch.autograd.grad(resolve_contact(hand, vertices).vertices.sum(), vertices)
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
    assert torch.equal(made, resolve_contact(hand, plain).vertices) and not torch.equal(made, plain)
    torch.testing.assert_close(means, made[truth.vertex_index])
    _, made, plain = surfaces(5)
    torch.testing.assert_close(made - plain, (resolve_contact(hand, plain).vertices - plain) / 2, rtol=1e-3, atol=1e-7)


@pytest.mark.gpu
def test_resolving_contact_is_recorded_in_a_graph(hand, fist):
    hand, vertices = hand.to("cuda"), fist.to("cuda")
    expected = resolve_contact(hand, vertices)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        made = resolve_contact(hand, vertices)
    graph.replay()
    assert torch.equal(made.vertices, expected.vertices) and torch.equal(made.closeness, expected.closeness)


@pytest.fixture(scope="module")
def rests(hand):
    """Hands of other shapes."""
    shapes = np.random.default_rng(3).normal(size=(6, len(hand.shape_names)))
    return [rest_hand(hand, torch.from_numpy(shape).float()) for shape in shapes]


@pytest.fixture(scope="module")
def mean_rest(hand):
    return rest_hand(hand, torch.zeros(len(hand.shape_names)))


def gap(hand, rest, angles, *bones):
    """Distance between the skin of two bones."""
    vertices = skin(hand, rest, HandPose(angles, torch.eye(3), torch.zeros(3))).vertices
    one, other = (vertices[hand.segment == hand.joint_names.index(bone)] for bone in bones)
    return float(torch.cdist(one, other).min())


@pytest.mark.parametrize("name", POSE_NAMES)
def test_the_mean_hand_takes_named_poses_as_they_stand_in_the_table(hand, mean_rest, name):
    torch.testing.assert_close(named_pose(hand, name, mean_rest), named_pose(hand, name), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["pinch", "ok"])
def test_thumb_and_index_meet_on_hands_of_other_shapes(hand, rests, mean_rest, name):
    tips = "thumb3", "index3"
    expected = gap(hand, mean_rest, named_pose(hand, name), *tips)
    plain = [gap(hand, rest, named_pose(hand, name), *tips) for rest in rests]
    made = [gap(hand, rest, named_pose(hand, name, rest), *tips) for rest in rests]
    assert max(plain) > expected + 0.003  # the table's angles leave them apart
    assert max(made) < expected + 0.001


def test_fingers_of_a_fist_lie_as_close_as_on_the_mean_hand(hand, rests, mean_rest):
    for pair in [("index2", "middle2"), ("middle2", "ring2"), ("ring2", "little2")]:
        expected = gap(hand, mean_rest, named_pose(hand, "fist"), *pair)
        made = [gap(hand, rest, named_pose(hand, "fist", rest), *pair) for rest in rests]
        assert median(made) < expected + 0.0005 and max(made) < expected + 0.002, pair


def test_little_can_be_seen_through_a_fist(hand, rests, mean_rest):
    """Fingers that were bent alike formed a tube: from a side, all of 32 fists showed what is behind."""
    upright = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    away, size = torch.tensor([0, 0, 0.5]), 128
    sides = [(math.radians(a), math.radians(b)) for a in (60, 90, 120, 240, 270, 300) for b in (-25, 0, 25)]
    holes = []
    for rest in [mean_rest, *rests]:
        held = HandPose(named_pose(hand, "fist", rest).float(), upright, away)
        vertices = resolve_contact(hand, skin_surface(hand, rest, held)).vertices
        cameras = [orbit_camera(vertices, *side, size) for side in sides]
        shown = [depth_map(vertices, hand.faces, c.viewmat, c.K, size, size).face_ids >= 0 for c in cameras]
        holes.append(sum(int((binary_fill_holes(mask) & ~mask.numpy()).sum()) for mask in shown))
    assert holes[0] < 60 and sum(holes) < 500  # 184 and 962 before


@pytest.mark.parametrize("name", ["fist", "victory", "ok"])
def test_angles_stay_within_limits_and_near_the_table(hand, rests, name):
    table, limits = named_pose(hand, name), hand.pose_limits[1:]
    for rest in rests:
        angles = named_pose(hand, name, rest)
        assert 0 < (angles - table).abs().max().rad2deg() < 30
        assert (angles >= torch.minimum(limits[..., 0], table) - 1e-6).all()
        assert (angles <= torch.maximum(limits[..., 1], table) + 1e-6).all()


def test_straight_fingers_stay_as_they_are(hand, rests):
    table = named_pose(hand, "open")
    assert all(torch.equal(named_pose(hand, "open", rest), table) for rest in rests)


def test_a_hand_of_mano_touches_as_the_bundled_one(mano):
    rest = rest_hand(mano, torch.zeros(mano.shape_basis.shape[2]))
    tips = "thumb3", "index3"
    assert gap(mano, rest, named_pose(mano, "ok", rest), *tips) < 0.002


@pytest.mark.gpu
def test_a_hand_on_the_device_takes_the_same_pose(hand, rests):
    there = named_pose(hand.to("cuda"), "ok", PosedHand(*(part.cuda() for part in rests[0])))
    torch.testing.assert_close(there.cpu(), named_pose(hand, "ok", rests[0]))
