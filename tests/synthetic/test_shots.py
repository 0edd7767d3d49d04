"""Sampled shots: gestures without self-collisions, views, light; and the operators that draw them."""

import numpy as np
import pytest
import torch
import trimesh

from oasis_warp.core import surface
from oasis_warp.core.types import HandPose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.ops import depth_map
from oasis_warp.ops.smoothing import smooth_over_faces
from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.contact import GESTURE_NAMES, GESTURES, bundled_skeleton, overlaps, sample_gesture, separate
from oasis_warp.synthetic.illumination import look_at
from oasis_warp.synthetic.ops.batched_lbs import batched_lbs
from oasis_warp.synthetic.ops.room_tracing import PATTERNS, SHAPES, SOLID_WORDS, trace_rooms
from oasis_warp.synthetic.ops.skin_shading import sky_transfer, surface_state
from oasis_warp.synthetic.ops.surface_patterns import NoiseField, pixel_noise, point_grid, surface_dabs, surface_noise
from oasis_warp.synthetic.ops.views import Lamps
from oasis_warp.synthetic.picture import render_batch, render_capture
from oasis_warp.synthetic.shots import (
    EVERYBODY,
    PHOTOS,
    PICTURES_EACH,
    SceneConfig,
    arm_rotations,
    capture_shots,
    sample_shot,
    sample_shots,
    tabulate,
)
from oasis_warp.synthetic.view_and_light import (
    ARM_CONE,
    View,
    avoid_forearm,
    diffuse_light,
    rotate_light,
    rotation_about,
    sample_light,
    sample_view,
    sphere,
)


@pytest.fixture(scope="module")
def drawn():
    """Two hundred gestures, before and after their fingers are kept apart; mean hands."""
    hand = bundled_body().hand
    rng = np.random.default_rng(0)
    names, angles = zip(*(sample_gesture(rng, hand) for _ in range(200)), strict=True)
    joints = np.repeat(hand.joints.double().numpy()[None] * 1e3, len(angles), 0)
    return names, np.stack(angles), joints


def test_gestures_stay_inside_the_joint_limits_before_and_after_they_are_kept_apart(drawn):
    _, angles, joints = drawn
    low, high = bundled_body().hand.pose_limits.double().numpy()[1:].transpose(2, 0, 1)
    for a in (angles, separate(angles, joints)[0]):
        assert (a[:, 1:] >= low - 1e-9).all() and (a[:, 1:] <= high + 1e-9).all()
        assert not a[:, 0].any()


def test_sunk_fingers_are_drawn_apart_to_within_half_a_millimetre(drawn):
    _, angles, joints = drawn
    before = overlaps(angles, joints).max(1)
    after, depth = separate(angles, joints)
    assert (before > 2).mean() > 0.2  # the grammar alone does sink fingers in
    assert depth.max() < 0.7
    np.testing.assert_allclose(overlaps(after, joints).max(1), depth)


def test_a_pose_that_touches_nothing_is_left_alone(drawn):
    _, angles, joints = drawn
    free = overlaps(angles, joints).max(1) == 0
    assert free.sum() > 40
    np.testing.assert_array_equal(separate(angles, joints)[0][free], angles[free])


def test_a_pose_does_not_depend_on_its_batch(drawn):
    _, angles, joints = drawn
    together, _ = separate(angles[:12], joints[:12])
    alone = np.concatenate([separate(angles[k : k + 1], joints[k : k + 1])[0] for k in range(12)])
    np.testing.assert_array_equal(together, alone)


def test_every_gesture_of_the_grammar_is_drawn():
    hand = bundled_body().hand
    rng = np.random.default_rng(1)
    seen = {sample_gesture(rng, hand)[0] for _ in range(1200)}
    assert seen == set(GESTURE_NAMES) == set(GESTURES)


def test_the_skeleton_of_a_batch_moves_bones_as_the_hand_model_does():
    hand = bundled_body().hand
    _, angles = sample_gesture(np.random.default_rng(3), hand)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))
    pose = HandPose(torch.from_numpy(angles[1:]).float(), torch.eye(3), torch.zeros(3))
    wanted = skin(hand, rest, pose).joints
    joints = hand.joints.double().numpy()
    rotation, shift = bundled_skeleton().transforms(angles[None], joints[None])
    found = (rotation[0] @ joints[..., None])[..., 0] + shift[0]
    np.testing.assert_allclose(found, wanted.numpy(), atol=1e-6)


SEED, SIZE = 13, 48  # the people of test_picture.py, who are baked once


def seen(light, directions):
    """The sky's light from each direction, linear RGB."""
    x, y, z = directions.T
    return np.stack([
        0 * x + 0.2820948, 0.4886025 * y, 0.4886025 * z, 0.4886025 * x, 1.0925484 * x * y, 1.0925484 * y * z,
        0.3153916 * (3 * z * z - 1), 1.0925484 * x * z, 0.5462742 * (x * x - y * y),
    ], 1) @ light.sky  # fmt: skip


@pytest.fixture(scope="module")
def light():
    return sample_light(np.random.default_rng(3), "photo")


def test_a_turned_camera_sees_the_same_light_from_turned_directions(light):
    rotation = rotation_about([1, 2, -1], 1.1)
    rotated, directions = rotate_light(light, rotation), sphere(50)
    np.testing.assert_allclose(seen(rotated, directions @ rotation.T), seen(light, directions), atol=1e-9)
    np.testing.assert_allclose(rotated.directions, light.directions @ rotation.T)
    back = rotate_light(rotated, rotation.T)
    np.testing.assert_allclose(back.sky, light.sky, atol=1e-9)


def test_softened_light_is_as_much_of_the_same_colour(light):
    soft = diffuse_light(light, 0.25)
    for found in (light, soft):
        np.testing.assert_allclose(0.2820948 * found.sky[0] + 0.65 * found.colors.sum(0), light.incident)
    directions = sphere(200)
    np.testing.assert_allclose(seen(soft, directions).std(0), 0.25 * seen(light, directions).std(0), rtol=1e-9)
    np.testing.assert_allclose(soft.colors, 0.25 * light.colors)


def toward_elbow(view, bend):
    """Cosine of the angle at which the camera looks down the forearm."""
    return -(view.rotation @ arm_rotations(bend[None])[0, -1] @ np.array([1.0, 0.0, 0.0]))[2]


def test_no_view_is_blocked_by_the_forearm():
    random, rotated = np.random.default_rng(0), 0
    for _ in range(300):
        bend = np.array([0.0, random.normal(0, 0.15), random.normal(0, 0.3)])
        drawn = sample_view(random, "even", closed=False)
        view = avoid_forearm(drawn, bend)
        assert toward_elbow(view, bend) < np.cos(ARM_CONE)
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) > 0
        rotated += view is not drawn
        assert (view is drawn) == (toward_elbow(drawn, bend) < np.cos(ARM_CONE))
    assert 10 < rotated < 60  # of a cone of 35 degrees round the arm 9 %
    shots = [sample_shot(SEED, index, SceneConfig(look="even")) for index in range(100)]
    assert max(toward_elbow(shot.view, shot.bend) for shot in shots) < np.cos(ARM_CONE)


def test_a_view_of_a_straight_arm_turns_round_the_upright_axis():
    down_the_arm = View(np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), 0.5, 0.8, np.zeros(2))
    view = avoid_forearm(down_the_arm, np.array([0.0, 0.0, 1e-9]))
    np.testing.assert_allclose(view.rotation, np.diag([-1, 1, -1]) @ down_the_arm.rotation)


@pytest.fixture(scope="module")
def capture():
    (photo,) = sample_shots(SEED, [0], PHOTOS)
    others = capture_shots(SEED, photo, sample_shots(SEED, [0, 1], SceneConfig(look="even")))
    plans = [tabulate(SEED, shots, PHOTOS) for shots in ([photo], others)]
    return photo, others, render_capture(SEED, *plans, SIZE, "cpu", scene=PHOTOS)


def test_the_photo_of_a_capture_is_the_picture_that_it_would_be_alone(capture):
    _, _, (photo, _) = capture
    alone = render_batch(SEED, [0], SIZE)
    for found, wanted in zip(photo, alone, strict=True):
        assert found == wanted if isinstance(found, tuple) else torch.equal(found, wanted)


def test_pictures_of_a_capture_show_the_hand_alone_by_the_photos_sensor(capture):
    photo, others, (_, pictures) = capture
    assert all(shot.sensor is photo.sensor and shot.room is None for shot in others)
    assert float(pictures.image[pictures.alpha == 0].abs().max()) == 0
    assert float(pictures.image[pictures.alpha > 0.99].mean()) > 0.05


def test_twice_the_light_is_the_same_picture_since_the_photo_was_exposed_for_it(capture):
    photo = capture[0]
    bright = photo._replace(light=photo.light._replace(
        sky=2 * photo.light.sky, colors=2 * photo.light.colors, incident=2 * photo.light.incident
    ), sensor=photo.sensor._replace(metering=0.0))  # fmt: skip
    plain = photo._replace(sensor=bright.sensor)
    goals = sample_shots(SEED, [1], SceneConfig(look="even"))
    made = []
    for shot in (plain, bright):
        plans = [tabulate(SEED, shots, PHOTOS) for shots in ([shot], capture_shots(SEED, shot, goals))]
        made.append(render_capture(SEED, *plans, SIZE, "cpu", scene=PHOTOS)[1].image)
    torch.testing.assert_close(*made, atol=2e-3, rtol=0)


def test_a_capture_of_one_person_comes_again(capture):
    photo, others, _ = capture
    assert {shot.person for shot in (photo, *others)} == {0} and PICTURES_EACH > 1
    again = capture_shots(SEED, photo, sample_shots(SEED, [0, 1], SceneConfig(population=EVERYBODY, look="even")))
    for one, two in zip(others, again, strict=True):
        np.testing.assert_array_equal(one.light.sky, two.light.sky)


def test_a_wall_that_is_turned_away_stays_before_the_camera():
    shot = sample_shot(1000, 289656, SceneConfig(people=1024))  # its yaw is drawn beyond a right angle
    assert shot.room is not None and np.isfinite(shot.room.solids).all()


UNIFORM_SKY = torch.zeros(9, 3)
UNIFORM_SKY[0] = 0.5 / 0.2820948  # light of .5 from everywhere


def _ball(device, radius=0.1):
    mesh = trimesh.creation.icosphere(3, radius)
    vertices = torch.tensor(mesh.vertices, dtype=torch.float32, device=device)
    return vertices + torch.tensor([0.0, 0, 0.5], device=device), torch.tensor(np.array(mesh.faces), device=device)


def _no_lamps(device, batch=1):
    far = torch.full((batch, 1, 4, 4), torch.inf, device=device)
    ones, eye = torch.ones(batch, 1, device=device), torch.eye(4, device=device).expand(batch, 1, 4, 4)
    zeros = torch.zeros(batch, 1, 3, device=device)
    return Lamps(zeros, zeros, ones, ones, eye.contiguous(), ones, far)


def _sky_of(vertices, faces, n=64):
    normals = surface_state(vertices[None], faces).normals
    directions = torch.from_numpy(sphere(n)).float().to(vertices.device)
    center = torch.tensor([0.0, 0, 0.5], device=vertices.device)
    radius = float((vertices - center).norm(dim=1).max()) * 1.02
    away = center + directions * 20 * radius
    views = look_at(away, center.expand_as(away))
    size, focal = 96, 20 * 96 / 2
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]], device=vertices.device)
    depths = depth_map(vertices.expand(n, -1, -1), faces, views, K.expand(n, 3, 3), size, size).depth
    focals = torch.tensor([float(focal)], device=vertices.device)
    return normals, sky_transfer(vertices[None], normals, directions, views[None], focals, depths[None], lift=0.003)


def test_normals_are_those_of_the_surface(device):
    vertices, faces = _ball(device)
    state = surface_state(vertices[None], faces)
    torch.testing.assert_close(state.normals[0], surface.vertex_normals(vertices, faces), atol=1e-5, rtol=0)
    areas = surface.vertex_areas(vertices, faces)
    torch.testing.assert_close(state.areas[0], 6 * areas, atol=1e-7, rtol=1e-4)


def test_smoothing_keeps_a_constant_and_the_order_of_a_batch(device):
    vertices, faces = _ball(device)
    values = torch.stack([torch.ones_like(vertices), vertices])
    out = smooth_over_faces(values, faces)
    torch.testing.assert_close(out[0], values[0])
    torch.testing.assert_close(smooth_over_faces(values[1:], faces)[0], out[1])


def test_a_ball_sees_half_the_sky_everywhere(device):
    _, transfer = _sky_of(*_ball(device))
    assert float(transfer[0, :, 9].min()) > 0.93
    irradiance = transfer[0, :, :9] @ UNIFORM_SKY.to(device)
    torch.testing.assert_close(irradiance, torch.full_like(irradiance, 0.5), atol=0.03, rtol=0)


def test_the_inside_of_a_bowl_is_darker_than_its_outside(device):
    vertices, faces = _ball(device)
    bowl = faces[(vertices[faces][:, :, 1] > 0).all(1)]  # open towards -y, which is up
    inner, outer = vertices.clone(), vertices.clone()
    center = torch.tensor([0.0, 0, 0.5], device=device)
    inner = center + 0.9 * (inner - center)
    both = torch.cat([outer, inner])
    walls = torch.cat([bowl, bowl.flip(1) + len(vertices)])  # the inner wall looks inwards
    _, transfer = _sky_of(both, walls)
    bottom = int(vertices[:, 1].argmax())
    outside, inside = transfer[0, bottom, 9], transfer[0, bottom + len(vertices), 9]
    assert float(outside) > 0.9
    assert float(inside) < 0.75


def test_a_wall_in_even_light_shows_its_own_colour(device):
    wall = torch.zeros(1, 1, SOLID_WORDS, device=device)
    wall[0, 0, :6] = torch.tensor([SHAPES.index("box"), PATTERNS.index("paint"), 0.1, 0, 0, 1])
    wall[0, 0, 6:12] = torch.tensor([0, 0, 2.0, 5, 5, 0.05])
    wall[0, 0, 12:21] = torch.eye(3).flatten()
    wall[0, 0, 21:] = torch.tensor([0.6, 0.3, 0.1]).repeat(2)
    hidden = torch.zeros(1, 24, 24, device=device)
    hidden[0, :8] = 1
    one = torch.ones(1, device=device)
    light = trace_rooms(wall, 30 * one, UNIFORM_SKY[None].to(device), _no_lamps(device), hidden, 0.5 * one, 0.0 * one)
    assert float(light[0, :8].abs().max()) == 0
    seen = light[0, 8:].mean((0, 1)).cpu()
    torch.testing.assert_close(seen, 0.5 * torch.tensor([0.6, 0.3, 0.1]), rtol=0.08, atol=0)


@pytest.mark.parametrize("flat", [False, True])
def test_a_dab_is_seen_where_it_is_the_strongest_of_its_kind(device, flat):
    rng = np.random.default_rng(0)
    points, centers = rng.uniform(0, 10, (300, 3)), rng.uniform(-1, 11, (200, 3))
    widths, strengths, kinds = rng.uniform(0.4, 0.9, 200), rng.uniform(-0.1, 1, 200), rng.integers(0, 3, 200)
    q = ((points[:, None] - centers) ** 2).sum(-1) / widths**2
    each = np.where(q < 8, strengths * np.exp(-(q**2 if flat else q)), 0).clip(0)
    wanted = np.stack([each[:, kinds == k].max(1) for k in range(3)])
    t = lambda a: torch.from_numpy(a).float().to(device)  # noqa: E731
    grid = point_grid(t(points), 0.7)
    found = surface_dabs(grid, t(centers), t(widths), t(strengths), torch.from_numpy(kinds).to(device), 3, flat=flat)
    np.testing.assert_allclose(found.cpu(), wanted, atol=1e-5)


def test_no_dabs_leave_no_trace(device):
    none = torch.zeros(0, device=device)
    grid = point_grid(torch.zeros(4, 3, device=device), 1.0)
    out = surface_dabs(grid, torch.zeros(0, 3, device=device), none, none, none.int(), 2)
    assert out.shape == (2, 4) and not bool(out.any())


def test_noise_depends_on_its_seed_and_hardly_leaves_one(device):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).to(device) * 40
    a, b, c = surface_noise(points, [NoiseField(5.0, 1), NoiseField(5.0, 2), NoiseField(5.0, 1)])
    assert torch.equal(a, c) and not torch.equal(a, b)
    assert 0.2 < float(a.std()) < 0.8 and float(a.abs().max()) < 1.6


def test_pixel_noise_is_normal_and_each_seeds_own(device):
    seeds = torch.tensor([3, 4], dtype=torch.int32, device=device)
    noise = pixel_noise(seeds, 3, 40, 40)
    assert abs(float(noise.mean())) < 0.05 and abs(float(noise.std()) - 1) < 0.05
    assert torch.equal(pixel_noise(seeds[1:], 3, 40, 40)[0], noise[1])


def test_wrong_arguments_are_named(as_shipped):
    grid = point_grid(torch.zeros(1, 3), 1.0)
    with pytest.raises(ValueError, match="kinds"):
        surface_dabs(grid, torch.zeros(2, 3), torch.ones(2), torch.ones(2), torch.tensor([0, 1]), 1)
    with pytest.raises(ValueError, match="widths"):
        surface_dabs(grid, torch.zeros(2, 3), torch.ones(3), torch.ones(2), torch.zeros(2).int(), 1)
    with pytest.raises(ValueError, match="points"):
        point_grid(torch.zeros(0, 3), 1.0)
    with pytest.raises(ValueError, match="normals"):
        sky_transfer(torch.zeros(1, 5, 3), torch.zeros(1, 4, 3), torch.zeros(2, 3), torch.zeros(1, 2, 4, 4),
                     torch.ones(1), torch.ones(1, 2, 8, 8))  # fmt: skip
    with pytest.raises(ValueError, match="solids"):
        trace_rooms(torch.zeros(1, 2, 5), torch.ones(1), torch.zeros(1, 9, 3), _no_lamps("cpu"), torch.zeros(1, 8, 8),
                    torch.ones(1), torch.ones(1))  # fmt: skip


def _case(device, batch=3, n=50, joints=4, correctives=6, knuckles=5):
    random = torch.Generator().manual_seed(0)
    sizes = [(batch, n, 3), (n, 3, correctives), (batch, correctives), (n, 3), (n, knuckles), (batch, knuckles),
             (n, joints), (batch, joints, 3, 3), (batch, joints, 3)]  # fmt: skip
    case = [torch.randn(*size, generator=random).to(device) for size in sizes]
    case[6][:, 1] = 0  # a bone that moves nobody
    return case


def test_flesh_is_displaced_then_carried_by_its_bones(device):
    case = _case(device)
    rest, displacements, strengths, normals, rises, knuckles, weights, rotations, shifts = (t.double() for t in case)
    moved = rest + torch.einsum("vdc,bc->bvd", displacements, strengths)
    moved = moved + torch.einsum("vk,bk->bv", rises, knuckles)[..., None] * normals
    carried = torch.einsum("bjde,bve->bvjd", rotations, moved) + shifts[:, None]
    wanted = torch.einsum("vj,bvjd->bvd", weights, carried)
    torch.testing.assert_close(batched_lbs(*case).double(), wanted, atol=1e-4, rtol=1e-5)


def test_a_hand_has_the_same_bits_in_any_batch(device):
    case = _case(device)
    alone = [t[2:] if k in (0, 2, 5, 7, 8) else t for k, t in enumerate(case)]
    assert torch.equal(batched_lbs(*alone), batched_lbs(*case)[2:])


def test_wrong_shapes_are_named(as_shipped):
    case = _case("cpu")
    case[5] = case[5][:, :2]
    with pytest.raises(ValueError, match="knuckles"):
        batched_lbs(*case)
