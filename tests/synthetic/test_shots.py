"""Sampled shots: gestures without self-collisions, views, light, and pictures of one capture."""

import numpy as np
import pytest
import torch

from oasis_warp.core.types import HandPose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.contact import bundled_skeleton, overlaps, separate
from oasis_warp.synthetic.gestures import GESTURE_NAMES, GESTURES, sample_gesture
from oasis_warp.synthetic.picture import render_batch, render_capture
from oasis_warp.synthetic.shot_table import arm_rotations, tabulate
from oasis_warp.synthetic.shots import (
    EVERYBODY,
    PHOTOS,
    PICTURES_EACH,
    SceneConfig,
    capture_shots,
    sample_shot,
    sample_shots,
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
    turned, directions = rotate_light(light, rotation), sphere(50)
    np.testing.assert_allclose(seen(turned, directions @ rotation.T), seen(light, directions), atol=1e-9)
    np.testing.assert_allclose(turned.directions, light.directions @ rotation.T)
    back = rotate_light(turned, rotation.T)
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
    random, turned = np.random.default_rng(0), 0
    for _ in range(300):
        bend = np.array([0.0, random.normal(0, 0.15), random.normal(0, 0.3)])
        drawn = sample_view(random, "even", closed=False)
        view = avoid_forearm(drawn, bend)
        assert toward_elbow(view, bend) < np.cos(ARM_CONE)
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) > 0
        turned += view is not drawn
        assert (view is drawn) == (toward_elbow(drawn, bend) < np.cos(ARM_CONE))
    assert 10 < turned < 60  # of a cone of 35 degrees round the arm 9 %
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
