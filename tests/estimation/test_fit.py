from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.estimation.fit import Fitter, OutlinePairs, SurfacePoints
from oasis_warp.estimation.fit_problem import FitState, fit_target
from oasis_warp.estimation.fit_quality import (
    FitQuality,
    draw_silhouette,
    framing_warnings,
    iou_above_wrist,
    keeps_quality,
    with_pose,
)
from oasis_warp.estimation.outline import MaskOutline, wrist_line

SIZE = (480, 400)
ANGLE_SIGMA = np.array([1.0, 0.25, 0.10])
"""Deviations of flexion, abduction and twist of ordinary poses [rad]."""


def posed_hand(kinematics, seed):
    """A right hand in an ordinary pose before a camera: palm or back, tilted a little."""
    rng = np.random.default_rng(seed)
    fitter = Fitter(kinematics, fit_target(np.zeros((21, 2)), None, SIZE, 500.0))
    spread = 0.25 * ANGLE_SIGMA[kinematics.dofs[:, 1]]
    angles = np.clip(fitter.relaxed + spread * rng.normal(size=26), fitter.low, fitter.high)
    shape = fitter.shape_mean + 0.7 * fitter.shape_sigma * rng.normal(size=40)
    facing = cv2.Rodrigues(np.array([np.pi / 2 + np.pi * rng.integers(2), 0, 0]))[0]
    tilt = cv2.Rodrigues(rng.normal(size=3) * 0.3)[0]
    rotation = tilt @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))[0]
    state = FitState(rotation @ facing, np.array([0, 0, np.log(0.45)]), angles, shape, 500.0, np.array(SIZE) / 2)
    middle = state.project(landmarks(kinematics, state)).mean(0)
    return replace(state, position=state.position - np.array([*((middle - state.centre) / state.focal), 0]))


def landmarks(kinematics, state):
    return kinematics.landmarks(kinematics.pose_joints(state.angles, state.shape))[0]


def seen(kinematics, state, **kwargs):
    points = landmarks(kinematics, state)
    return fit_target(state.project(points), state.in_camera(points), SIZE, **kwargs)


def error(kinematics, fitter, state):
    """Mean distance of the points, share of the box."""
    gaps = np.linalg.norm(state.project(landmarks(kinematics, state)) - fitter.target.xy, axis=1)
    return gaps.mean() / fitter.target.box


def pixels(kinematics, truth, count, *, seed=0):
    """What pixels show of a hand in a known state, its hidden side included."""
    vertex = np.random.default_rng(seed).integers(0, len(kinematics.template), count)
    joints = kinematics.pose_joints(truth.angles, truth.shape)
    normals = kinematics.normals(joints, vertex)[0] @ truth.rotation.T
    xy, still = truth.project(kinematics.surface(joints)[vertex]), np.zeros((count, 3))
    return SurfacePoints(vertex, still, still, xy, np.full(count, 0.0008 * truth.pixels_per_metre()), normals)


def test_derivatives_of_all_terms_are_those_of_differences(kinematics):
    state = posed_hand(kinematics, 0)
    fitter = Fitter(kinematics, seen(kinematics, posed_hand(kinematics, 1)))
    rng = np.random.default_rng(0)
    index = rng.integers(0, len(kinematics.template), 30)
    normal = np.stack([np.cos(index), np.sin(index)], 1)
    target = rng.uniform(100, 300, (30, 2))
    pairs = OutlinePairs(index, target, normal, np.ones(30), np.zeros((30, 3)))
    terms = {"pairs": pairs, "surface": pixels(kinematics, posed_hand(kinematics, 1), 50)}
    _, slope, _ = fitter.system(state, **terms)
    # Reweighting makes the gradient of the robust cost 2 J^T r, whatever the loss.
    residual = fitter.system(state, **terms)[0]
    gradient = 2 * slope.T @ residual
    step = 1e-6
    free = fitter.everything
    eye = np.eye(slope.shape[1])
    differences = [
        (fitter.system(state.moved(step * eye[k]), **terms)[2]
         - fitter.system(state.moved(-step * eye[k]), **terms)[2]) / (2 * step)
        for k in free
    ]  # fmt: skip
    np.testing.assert_allclose(gradient[free], differences, rtol=1e-4, atol=1e-4 * np.abs(gradient[free]).max())


@pytest.mark.parametrize("seed", range(4))
def test_perfect_landmarks_are_explained(kinematics, seed):
    truth = posed_hand(kinematics, seed)
    fitter = Fitter(kinematics, seen(kinematics, truth))
    found = fitter.fit_landmarks().state
    assert error(kinematics, fitter, found) < 0.0075, "what the priors cost"
    aligned = landmarks(kinematics, found) @ found.rotation.T
    true = landmarks(kinematics, truth) @ truth.rotation.T
    aligned, true = aligned - aligned[0], true - true[0]
    scale = (true * aligned).sum() / (aligned**2).sum()
    assert np.linalg.norm(scale * aligned - true, axis=1).mean() < 0.008, "metres, up to the size no photo shows"


@pytest.mark.parametrize("seed", range(3))
def test_landmarks_without_world_points_are_explained(kinematics, seed):
    truth = posed_hand(kinematics, seed)
    fitter = Fitter(kinematics, fit_target(seen(kinematics, truth).xy, None, SIZE))
    found = fitter.fit_landmarks()
    assert error(kinematics, fitter, found.state) < 0.01


def test_one_wild_landmark_does_not_carry_the_hand_away(kinematics):
    truth = posed_hand(kinematics, 2)
    target = seen(kinematics, truth)
    spoilt = target.xy.copy()
    spoilt[8] += 0.3 * target.box
    fitter = Fitter(kinematics, replace(target, xy=spoilt))
    found = fitter.fit_landmarks().state
    others = np.delete(np.arange(21), [5, 6, 7, 8])
    gaps = np.linalg.norm(found.project(landmarks(kinematics, found)) - target.xy, axis=1)[others] / target.box
    assert gaps.mean() < 0.02


def test_joints_stay_near_their_limits(kinematics):
    target = seen(kinematics, posed_hand(kinematics, 3))
    wild = target.xy + np.random.default_rng(0).normal(size=(21, 2)) * 0.1 * target.box
    fitter = Fitter(kinematics, replace(target, xy=wild))
    angles = fitter.fit_landmarks().state.angles
    assert np.maximum(angles - fitter.high, fitter.low - angles).max() < np.radians(15)


def test_a_known_focal_length_and_shape_are_kept(kinematics):
    truth = posed_hand(kinematics, 1)
    shape = np.linspace(-1, 1, 40)
    fitter = Fitter(kinematics, seen(kinematics, truth, focal=777.0), shape=shape)
    found = fitter.fit_landmarks().state
    assert found.focal == 777.0
    np.testing.assert_allclose(found.shape, shape, atol=1e-5)


def test_principal_components_that_no_photo_shows_stay_zero(kinematics):
    found = Fitter(kinematics, seen(kinematics, posed_hand(kinematics, 0))).fit_landmarks().state
    np.testing.assert_allclose(found.shape[6:10], 0, atol=1e-5)


def test_the_outline_brings_the_mesh_onto_the_mask(kinematics):
    truth = posed_hand(kinematics, 0)
    mask = (draw_silhouette(kinematics, truth, SIZE) > 0).astype(np.float32)
    target = seen(kinematics, truth)
    noisy = target.xy + np.random.default_rng(1).normal(size=(21, 2)) * 0.008 * target.box
    fitter = Fitter(kinematics, replace(target, xy=noisy))
    start = fitter.fit_landmarks()
    outline = MaskOutline(mask, noisy)
    found = fitter.refine(start.state, lambda state: outline.match(kinematics, state), 4)
    drawn = [draw_silhouette(kinematics, solution.state, SIZE) > 0 for solution in (start, found)]
    before, after = (iou_above_wrist(silhouette, mask > 0, noisy) for silhouette in drawn)
    assert 1 - after < min(0.7 * (1 - before), 0.035)


def test_pixels_that_say_where_they_are_on_the_surface_bring_a_bad_start_to_the_truth(kinematics):
    truth = posed_hand(kinematics, 0)
    target = seen(kinematics, truth, focal=truth.focal)
    wild = target.xy + np.random.default_rng(1).normal(size=(21, 2)) * 0.04 * target.box
    fitter = Fitter(kinematics, replace(target, xy=wild))
    start = fitter.fit_landmarks().state
    points = pixels(kinematics, truth, 600)
    points.xy[::5] += np.random.default_rng(2).normal(size=(120, 2)) * 0.2 * target.box  # outliers

    def gap(state):
        surfaces = [kinematics.surface(kinematics.pose_joints(s.angles, s.shape)) for s in (state, truth)]
        return np.linalg.norm(state.project(surfaces[0]) - truth.project(surfaces[1]), axis=1).mean() / target.box

    found = fitter.fit_surface(fitter.fit_surface(start, points).state, points).state
    assert gap(start) > 0.02
    assert gap(found) < 0.006
    assert np.abs(found.angles - truth.angles).mean() < 0.5 * np.abs(start.angles - truth.angles).mean()


def test_a_finger_that_landmarks_have_straight_folds_where_its_pixels_say_so(kinematics):
    """Robust residuals that are large have no slope: it stayed straight, and the hand bent around it."""
    joint, axis = kinematics.dofs.T
    straight = posed_hand(kinematics, 2)
    flexion = (joint >= 4) & (joint <= 12) & (axis == 0)
    folded = np.radians([80.0, 98.0, 62.0])[(joint - 1) % 3] - kinematics.rest_bend[joint]
    truth = replace(straight, angles=np.where(flexion, folded, straight.angles))
    fitter = Fitter(kinematics, seen(kinematics, straight, focal=straight.focal))
    start = fitter.fit_landmarks().state
    found = fitter.fit_surface(start, pixels(kinematics, truth, 600)).state
    off = np.abs(found.angles - truth.angles)[flexion]
    assert np.abs(start.angles - truth.angles)[flexion].mean() > np.radians(40)
    assert off.mean() < np.radians(6)


def test_no_pixels_leave_the_fit_to_the_landmarks(kinematics):
    fitter = Fitter(kinematics, seen(kinematics, posed_hand(kinematics, 1)))
    state, nothing = fitter.fit_landmarks().state, pixels(kinematics, posed_hand(kinematics, 1), 0)
    found = fitter.fit_surface(state, nothing).state
    assert error(kinematics, fitter, found) < 0.02


def test_the_wrist_line_separates_hand_from_arm(kinematics):
    xy = seen(kinematics, posed_hand(kinematics, 2)).xy
    line = wrist_line(xy)
    arm = xy[0] - (xy[9] - xy[0])
    np.testing.assert_array_equal(line.above(np.stack([xy[9], xy[5], xy[0], arm])), [True, True, False, False])
    where = line.above_mask(SIZE)
    for point in (xy[9], arm):
        x, y = np.clip(point.astype(int), 0, np.array(SIZE) - 1)
        assert where[y, x] == line.above(np.array([[x + 0.5, y + 0.5]]))[0]


def test_a_fit_is_repeatable(kinematics):
    target = seen(kinematics, posed_hand(kinematics, 1))
    first, second = (Fitter(kinematics, target).fit_landmarks() for _ in range(2))
    assert first.cost == second.cost
    np.testing.assert_array_equal(first.state.angles, second.state.angles)


@pytest.mark.parametrize("beyond", [-1, 1])
def test_a_pose_beyond_its_limits_costs_alike_on_both_sides(kinematics, beyond):
    truth = posed_hand(kinematics, 0)
    fitter = Fitter(kinematics, seen(kinematics, truth))
    bound = fitter.low if beyond < 0 else fitter.high
    flat = replace(fitter.settings, gesture=(1e6, 1e6, 1e6))  # of the priors, only the limits count

    def cost(angles):
        free = Fitter(kinematics, fitter.target, settings=replace(flat, landmark=1e6, bone=1e6), shape=truth.shape)
        return free.system(replace(truth, angles=angles, focal=free.focal))[2]

    for k in range(len(bound)):
        angles = np.clip(truth.angles, fitter.low, fitter.high)
        angles[k] = bound[k] + 0.1 * beyond
        assert cost(angles) == pytest.approx((0.1 / fitter.settings.limit) ** 2, rel=1e-3)


CUT = "the photo's border cuts the hand: the part outside is guessed"
FRAME = 401, 301
FINGERS = [[150.0 + 25 * finger, 200.0 - 35 * bone] for finger in range(5) for bone in range(4)]
FLAT = np.array([[200.0, 270.0], *FINGERS])
"""Landmarks of a hand that lies well inside of the photo."""


def warnings_with(*rows_and_columns):
    mask = np.zeros(FRAME[::-1], np.float32)
    mask[80:250, 140:270] = 1
    for part in rows_and_columns:
        mask[part] = 1
    return framing_warnings(fit_target(FLAT, None, FRAME), mask)


def test_a_hand_inside_of_the_photo_is_not_cut():
    assert warnings_with() == []


@pytest.mark.parametrize(
    "part",
    [
        (slice(0, 80), slice(150, 190)),
        (slice(100, 140), slice(0, 140)),
        (slice(100, 140), slice(270, None)),
    ],
    ids=["top", "left", "right"],
)
def test_a_hand_that_reaches_a_border_is_cut(part):
    assert warnings_with(part) == [CUT]


def test_an_arm_may_leave_the_photo():
    assert warnings_with((slice(270, None), slice(150, 260))) == []


@pytest.mark.parametrize("outside", [(-1.0, 100.0), (402.0, 100.0), (200.0, -1.0), (200.0, 302.0)])
def test_a_landmark_outside_of_the_photo_is_a_cut_hand(outside):
    xy = FLAT.copy()
    xy[8] = outside
    assert framing_warnings(fit_target(xy, None, FRAME), np.zeros(FRAME[::-1], np.float32)) == [CUT]


def test_a_left_hand_that_was_not_moved_is_worth_what_it_was(hand, fitted):
    _, _, fit = fitted("thumb_up_left_06.jpg")
    again = with_pose(hand, fit, fit.pose)
    assert abs(again.reprojection - fit.reprojection) < 0.05
    assert abs(again.mask_iou - fit.mask_iou) < 0.01
    assert keeps_quality(again, fit._replace(mask_iou=1.0, reprojection=0.0))


def test_a_hand_that_was_turned_away_misses_its_landmarks(hand, fitted):
    _, _, fit = fitted("thumb_up_left_06.jpg")
    turn = from_axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.3))
    moved = with_pose(hand, fit, fit.pose._replace(orientation=turn @ fit.pose.orientation))
    assert moved.reprojection > 3 * fit.reprojection
    assert not keeps_quality(moved, fit)
    assert keeps_quality(moved, moved)


def test_a_fit_with_wrong_landmarks_is_used_where_outline_and_pixels_agree_with_it():
    """Since pixels outweigh landmarks, good fits left wrong ones behind and were refused for them."""
    good = FitQuality(reprojection=8.8, worst_point=20.0, mask_iou=0.97, cost=150.0)
    assert good.refused(stray=0.05) == [] and any("reprojection" in words for words in good.warnings())
    assert len(good.refused(stray=0.15)) == 1 and len(replace(good, mask_iou=0.95).refused(stray=0.05)) == 1
    assert len(replace(good, cost=600.0).refused(stray=0.05)) == 1
    assert len(replace(good, reprojection=2.0).refused(stray=0.4)) == 1
