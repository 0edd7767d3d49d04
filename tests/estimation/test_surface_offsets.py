"""Moving the surface until its outline is the mask's: by pairs of points, and by a rendered outline."""

import cv2
import numpy as np
import pytest
import torch
from synthetic import crop_of

from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.estimation.fit_problem import mirrored_fit
from oasis_warp.estimation.fit_quality import iou_above_wrist
from oasis_warp.estimation.hand_crop import crop_hand
from oasis_warp.estimation.outline import silhouette
from oasis_warp.estimation.surface_offsets import (
    BEYOND,
    LONGEST,
    OF_FINGER,
    crossing,
    outline_offsets,
    rendered_outline_offsets,
)
from oasis_warp.hand.contact import flesh_thickness
from oasis_warp.network.prior import choose_prior
from oasis_warp.render import render

RIGHT, LEFT = "victory_right_09.jpg", "ok_sign_left_10.jpg"


@pytest.fixture(scope="module")
def offsets(hand, fitted):
    done = {}

    def get(name):
        if name not in done:
            done[name] = outline_offsets(hand, fitted(name)[2])
        return done[name]

    return get


def posed(kinematics, fit, shift):
    view = mirrored_fit(kinematics, fit)
    rest = kinematics.rest_surface(view.state.shape) + kinematics.correctives(view.angles) + shift
    return view.state, rest, kinematics.pose_surface(kinematics.pose_all_joints(view.angles, view.state.shape), rest)


def iou(kinematics, fit, shift):
    state, _, vertices = posed(kinematics, fit, shift)
    drawn = silhouette(state.project(vertices), kinematics.faces, (fit.camera.width, fit.camera.height)) > 0
    view = mirrored_fit(kinematics, fit)
    return iou_above_wrist(drawn, view.mask > 0.5, view.xy)


@pytest.mark.parametrize("name", [RIGHT, LEFT])
def test_the_outline_comes_to_lie_on_the_masks(kinematics, fitted, offsets, name):
    fit = fitted(name)[2]
    before, after = iou(kinematics, fit, 0.0), iou(kinematics, fit, offsets(name).numpy())
    assert after > 0.975
    assert 1 - after < 0.4 * (1 - before)


@pytest.mark.parametrize("name", [RIGHT, LEFT])
def test_displacements_are_small_and_smooth(hand, kinematics, fitted, offsets, name):
    shift = offsets(name).numpy().astype(float)
    assert shift.shape == kinematics.template.shape
    length = np.linalg.norm(shift, axis=1)
    assert length.max() <= LONGEST + 1e-6
    assert (length <= OF_FINGER * flesh_thickness(hand) + 1e-6).all()  # infinite on the palm
    a, b, c = kinematics.faces.T
    step = np.linalg.norm(np.concatenate([shift[a] - shift[b], shift[b] - shift[c]]), axis=1)
    _, rest, _ = posed(kinematics, fitted(name)[2], 0.0)
    edge = np.linalg.norm(np.concatenate([rest[a] - rest[b], rest[b] - rest[c]]), axis=1)
    # A spike would move one end of an edge as far as the edge is long.
    assert (step / edge).max() < 0.7
    assert np.percentile(step / edge, 99) < 0.3


@pytest.mark.parametrize("name", [RIGHT, LEFT])
def test_the_surface_does_not_fold(kinematics, fitted, offsets, name):
    _, rest, _ = posed(kinematics, fitted(name)[2], 0.0)
    before, after = (kinematics.vertex_normals(rest + shift) for shift in (0, offsets(name).numpy()))
    assert (before * after).sum(1).min() > 0.5


def test_the_wrist_stays(kinematics, offsets):
    at_wrist = np.abs(kinematics.template[:, 0] - kinematics.template[kinematics.rim, 0].mean()) < 0.01
    assert at_wrist.any()
    assert torch.linalg.norm(offsets(RIGHT)[torch.from_numpy(at_wrist)], dim=1).max() < 0.0015


def test_a_fit_that_covers_its_mask_is_left_as_it_is(hand, kinematics, fitted):
    fit = fitted(RIGHT)[2]
    state, _, vertices = posed(kinematics, fit, 0.0)
    drawn = silhouette(state.project(vertices), kinematics.faces, (fit.camera.width, fit.camera.height))
    shift = outline_offsets(hand, fit._replace(mask=torch.from_numpy(drawn).float() / 255))
    # Half a pixel of the photo is 0.3 mm.
    assert torch.linalg.norm(shift, dim=1).max() < 0.0007


def test_a_mask_that_is_wrong_somewhere_does_no_harm_there(hand, kinematics, fitted, offsets):
    fit = fitted(RIGHT)[2]
    xy = fit.landmarks.xy.numpy()
    mask = fit.mask.clone()
    x, y = xy[8]
    mask[int(y) - 30 : int(y) + 35, int(x) - 40 : int(x) + 40] = 1.0  # a patch around the tip of the index finger
    shift = outline_offsets(hand, fit._replace(mask=mask))
    tip = torch.linalg.norm(hand.template - hand.tips[1], dim=1) < 0.012
    assert torch.linalg.norm(shift[tip], dim=1).mean() < 0.004
    assert iou(kinematics, fit, shift.numpy()) > 0.85
    # Away from the patch the outline is followed as before.
    little = torch.linalg.norm(hand.template - hand.tips[4], dim=1) < 0.012
    torch.testing.assert_close(shift[little], offsets(RIGHT)[little], atol=0.0005, rtol=0)


def test_an_empty_mask_moves_nothing(hand, fitted):
    fit = fitted(RIGHT)[2]
    assert not outline_offsets(hand, fit._replace(mask=torch.zeros_like(fit.mask))).any()


def test_a_left_hands_offsets_are_those_of_the_mirrored_photo(hand, fitted, offsets):
    fit = fitted(LEFT)[2]
    mirror = torch.tensor([-1.0, 1, 1])
    xy = fit.landmarks.xy * mirror[:2] + torch.tensor([fit.camera.width, 0])
    mirrored = fit._replace(
        side="right",
        pose=fit.pose._replace(orientation=mirror[:, None] * fit.pose.orientation * mirror,
                               translation=mirror * fit.pose.translation),
        mask=fit.mask.flip(1),
        landmarks=fit.landmarks._replace(xy=xy, side="right"),
    )  # fmt: skip
    torch.testing.assert_close(outline_offsets(hand, mirrored), offsets(LEFT), atol=1e-4, rtol=0)


def test_offsets_are_the_same_bits_again(hand, fitted, offsets):
    assert torch.equal(outline_offsets(hand, fitted(RIGHT)[2]), offsets(RIGHT))


def test_two_photos_share_one_surface_between_their_outlines(hand, kinematics, fitted, offsets):
    """The second is the first with a mask that is thinner all round; both count alike."""
    fit = fitted(RIGHT)[2]
    thin = fit._replace(mask=torch.from_numpy(cv2.erode(fit.mask.numpy(), np.ones((7, 7)))))
    alone, thinner = offsets(RIGHT).numpy(), outline_offsets(hand, thin).numpy()
    shared = outline_offsets(hand, fit, thin).numpy()
    _, rest, _ = posed(kinematics, fit, 0.0)
    normals = kinematics.vertex_normals(rest)
    out = [(shift * normals).sum(1) for shift in (thinner, shared, alone)]
    chosen = np.flatnonzero(out[2] - out[0] > 5e-4)
    assert len(chosen) > 500
    assert np.all(np.diff([part[chosen].mean() for part in out]) > 1e-4)
    assert iou(kinematics, fit, shared) > iou(kinematics, fit, thinner)
    assert iou(kinematics, thin, shared) > iou(kinematics, thin, alone)


def test_a_hand_of_so_few_pixels_that_no_vertex_is_on_its_outline_has_no_crossings():
    nowhere = np.zeros((0, 2))
    assert crossing(np.ones((64, 64), np.float32), nowhere, nowhere, 3.0).shape == (0,)


SIZE = 256


@pytest.fixture(scope="module")
def case(hand):
    """A photo, and Gaussians too large for its outline on a surface that is too thin at the fingers."""
    crop, truth, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=SIZE)
    too_large = truth._replace(scales=1.4 * truth.scales)
    return moved(hand, crop, -0.001 * (hand.template[:, :1] < -0.09)), too_large


def moved(hand, crop, outwards):
    normals = [surface.vertex_normals(part.vertices, hand.faces) for part in (crop.rest, crop.posed)]
    rest, posed = (
        part._replace(vertices=part.vertices + outwards * along)
        for part, along in zip((crop.rest, crop.posed), normals, strict=True)
    )
    return crop._replace(rest=rest, posed=posed)


@pytest.fixture(scope="module")
def rendered_offsets(hand, case):
    crop, gaussians = case
    return rendered_outline_offsets(hand, [gaussians], [crop])


def moved_by(hand, crop, rendered_offsets):
    along = surface.vertex_normals(crop.rest.vertices, hand.faces)
    return moved(hand, crop, (rendered_offsets * along).sum(1, keepdim=True))


def drawn(hand, gaussians, crop):
    posed = pose_gaussians(gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices)
    return render(posed, crop.camera).alpha


def away(alpha, mask):
    """Mean way from the mask's outline to the drawn one at the fingers, outwards [px]."""
    solid = (mask > 0.5).float().numpy()[: SIZE // 2]
    length = cv2.morphologyEx(solid, cv2.MORPH_GRADIENT, np.ones((3, 3))) / 2  # of the outline's two sides, half each
    return ((alpha > 0.5).float().numpy()[: SIZE // 2] - solid).sum() / length.sum()


def test_the_drawn_outline_comes_to_lie_just_outside_the_masks(hand, case, rendered_offsets):
    crop, gaussians = case
    assert away(drawn(hand, gaussians, crop), crop.mask) < 0
    settled = moved_by(hand, crop, rendered_offsets)
    assert away(drawn(hand, gaussians, settled), crop.mask) == pytest.approx(BEYOND, abs=0.25)


def test_a_slit_that_the_photo_does_not_have_is_closed(hand):
    crop, gaussians, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=SIZE)
    solid = (crop.mask > 0.5).numpy().astype(np.uint8)
    closed = torch.from_numpy(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((6, 6)))).float()
    slit = (closed > 0.5) & (crop.mask < 0.5)
    assert slit.sum() >= 30
    without = crop._replace(mask=closed)
    closer = moved_by(hand, crop, rendered_outline_offsets(hand, [gaussians], [without]))
    before, after = (drawn(hand, gaussians, e)[slit].mean() for e in (crop, closer))
    assert before < 0.2
    assert after > 0.5  # .41 where only outlines are met


def test_a_slit_that_has_closed_stays_closed(hand, fitted, offsets):
    photo, _, fit = fitted(LEFT)
    crop = crop_hand(photo, fit, offsets(LEFT), ReconstructConfig(), 384)
    guess = choose_prior("learned")(crop)
    inside = inner_mask((crop.mask > 0.5).float()) * crop.above_wrist > 0.5
    closer = moved_by(hand, crop, rendered_outline_offsets(hand, [guess], [crop]))
    before, after = (int((drawn(hand, guess, e)[inside] < 0.5).sum()) for e in (crop, closer))
    assert before > 50
    assert after < 10  # 17 where the sides of a closed slit lose their targets
    twice = closer._replace(camera=crop_camera(closer.camera, 0.0, 0.0, 384.0, 768))
    thin = int((drawn(hand, guess, twice)[inside.repeat_interleave(2, 0).repeat_interleave(2, 1)] < 0.85).sum())
    assert thin < 200  # 368 where only slits of less than half the opacity are closed


def test_what_lies_off_the_outline_stays(hand, rendered_offsets):
    length = rendered_offsets.norm(dim=1)
    assert 0.0003 < length.max() < 0.004
    along, _, across = hand.template.T
    palm = (along > -0.08) & (along < -0.05) & ((across - across[along > -0.08].mean()).abs() < 0.01)
    assert length[palm].max() < 0.1 * length.max()


def test_a_photo_without_an_outline_says_nothing(hand, case, rendered_offsets):
    crop, gaussians = case
    nothing = crop._replace(mask=torch.zeros_like(crop.mask))
    assert not rendered_outline_offsets(hand, [gaussians], [nothing]).any()
    assert torch.equal(rendered_outline_offsets(hand, [gaussians] * 2, [nothing, crop]), rendered_offsets)
