import math

import numpy as np
import pytest
import torch
from synthetic import PALM_TO_CAMERA

from oasis_warp.avatar.anchors import PRIOR_SIZE, inset_offsets, vertex_to_gaussians
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import Camera, HandCrop, HandPose
from oasis_warp.estimation.refine import _Problem, refine
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.render.render import render

pytestmark = pytest.mark.slow

SIZE = 160
LAMP = torch.tensor([-0.4, -0.5, -0.75])
WALL = (0.2, 0.5, 0.3)


@pytest.fixture(scope="module")
def rest(hand):
    bare = rest_hand(hand, torch.zeros(len(hand.shape_names)))
    return bare._replace(vertices=bare.vertices + inset_offsets(hand))


@pytest.fixture(scope="module")
def true_pose(hand):
    return HandPose(named_pose(hand, "relaxed"), PALM_TO_CAMERA, torch.tensor([0.0, 0.08, 0.5]))


@pytest.fixture(scope="module")
def photo(hand, rest, true_pose):
    """A lit hand before a wall, explained by its true surface, and what a prior says of it: even light."""
    posed = skin(hand, rest, true_pose)
    K = torch.tensor([[SIZE * 2.2, 0, SIZE / 2], [0, SIZE * 2.2, SIZE / 2], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, SIZE, SIZE)
    blank = torch.zeros(SIZE, SIZE)
    prior = MeanPrior(hand)
    crop = HandCrop(torch.zeros(SIZE, SIZE, 3), blank, blank + 1, camera, rest, posed)
    guess = prior(crop._replace(image=torch.full((SIZE, SIZE, 3), 0.6), mask=blank + 1))
    toward = surface.vertex_normals(posed.vertices, hand.faces) @ torch.nn.functional.normalize(LAMP, dim=0)
    lit = guess.colors * vertex_to_gaussians((0.4 + 0.8 * toward.clamp_min(0))[:, None], hand.faces, guess)
    with torch.no_grad():
        drawn = render(
            pose_gaussians(guess._replace(colors=lit), hand.faces, rest.vertices, posed.vertices), camera,
            background=WALL,
        )  # fmt: skip
    return crop._replace(image=drawn.image, mask=drawn.alpha), guess


@pytest.fixture(scope="module")
def astray(hand, rest, true_pose):
    """A pose as an estimator may find it: the hand turned a little, fingers bent too little or too much."""
    random = torch.Generator().manual_seed(3)
    axis = torch.nn.functional.normalize(torch.randn(3, generator=random), dim=0)
    angles = true_pose.angles.clone()
    angles[:, 0] += 0.3 * torch.randn(15, generator=random)
    turn = from_axis_angle(axis, torch.tensor(0.2))
    return skin(hand, rest, HandPose(angles, turn @ true_pose.orientation, true_pose.translation))


@pytest.fixture(scope="module")
def wrong(photo, astray):
    return photo[0]._replace(posed=astray)


@pytest.fixture(scope="module")
def refined(hand, photo, wrong):
    return refine(hand, photo[1], wrong)


def misplaced(crop, truth):
    """Median distance of the surface from the true one in the picture [px]."""
    a, b = (project(crop.camera, posed.vertices)[0] for posed in (crop.posed, truth.posed))
    return float((a - b).norm(dim=1).median())


def test_a_hand_that_is_a_little_off_comes_back(photo, wrong, refined):
    truth = photo[0]
    assert refined.accepted
    assert misplaced(refined.crop, truth) < 0.6 * misplaced(wrong, truth)
    assert refined.after.gap < refined.before.gap


def test_the_pose_that_is_returned_is_that_of_the_surface(hand, rest, refined):
    again = skin(hand, rest, refined.pose).vertices
    assert (again - refined.crop.posed.vertices).norm(dim=1).median() < 1e-3


def test_a_right_start_stays_where_it_is(hand, photo):
    truth, guess = photo
    assert misplaced(refine(hand, guess, truth).crop, truth) < 1


@pytest.mark.parametrize("mask", ["nothing", "everything else", "noise"])
def test_a_mask_without_the_hand_leaves_the_start(hand, photo, wrong, mask):
    noise = (torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0)) > 0.9).float()
    masks = {"nothing": torch.zeros(SIZE, SIZE), "everything else": 1 - wrong.mask, "noise": noise}
    kept = refine(hand, photo[1], wrong._replace(mask=masks[mask]))
    assert not kept.accepted
    assert torch.equal(kept.crop.posed.vertices, wrong.posed.vertices)
    assert kept.moved == kept.turned == kept.bent == 0


@pytest.mark.parametrize("level", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_photo_without_any_detail_gives_a_finite_answer(hand, photo, wrong, level):
    made = refine(hand, photo[1], wrong._replace(image=torch.full_like(wrong.image, level)))
    assert torch.isfinite(made.crop.posed.vertices).all()
    assert math.isfinite(made.after.gap)


def test_the_same_photo_gives_the_same_bits(hand, photo, wrong, refined):
    again = refine(hand, photo[1], wrong)
    assert torch.equal(again.crop.posed.vertices, refined.crop.posed.vertices)
    assert again.after == refined.after


def test_a_change_is_the_step_that_was_taken(hand, photo, wrong):
    problem = _Problem(hand, photo[1], wrong, None, PRIOR_SIZE)
    step = 0.05 * np.random.default_rng(0).normal(size=problem.n_unknowns)
    np.testing.assert_allclose(problem.change(problem.moved(problem.start, step)), step, atol=1e-12)
