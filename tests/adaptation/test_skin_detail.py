"""What is fine on skin lies where it belongs: maps of real hands, drawn lines, nails and grain."""

import pytest
import torch

from oasis_warp.adaptation.skin_detail import sample_detail
from oasis_warp.adaptation.skin_grain import CELL, skin_grain
from oasis_warp.adaptation.unseen_skin import _skin_detail
from oasis_warp.avatar.appearance import label_regions, skin_regions
from oasis_warp.avatar.folds import _joint_skin
from oasis_warp.core import surface
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.hand.template import bundled_hand


def at_places(vertices, faces, barycentrics):
    """Gaussians of which only the places count."""
    count = len(vertices) + len(faces)
    ones = torch.ones(count, 3)
    return CanonicalGaussians(
        vertices, torch.zeros(len(vertices), 3), faces, barycentrics, torch.ones(count, 4), ones, ones[:, 0], ones
    )


def on_all_faces(hand):
    """A Gaussian in the middle of every face."""
    faces = torch.arange(len(hand.faces))
    return at_places(faces[:0], faces, torch.full(hand.faces.shape, 1 / 3))


def test_nails_are_where_the_hand_model_has_them(hand):
    index = torch.arange(len(hand.template))
    detail = sample_detail(hand, at_places(index, index[:0], torch.zeros(0, 3)), 0)
    assert float(detail.plate[hand.nail > 0.95].mean()) > 0.8
    assert float(detail.plate[label_regions(hand).palm > 0.9].max()) < 0.1


def test_palm_lines_are_one_persons_and_take_turns_with_the_seed(hand):
    """Mixed place by place as the skin is, a line ended where another person's began."""
    index = torch.arange(len(hand.template))
    lines = [sample_detail(hand, at_places(index, index[:0], torch.zeros(0, 3)), seed).fold for seed in range(4)]
    torch.testing.assert_close(lines[0], lines[2])
    torch.testing.assert_close(lines[1], lines[3])
    palm = (hand.segment == 0) & (skin_regions(hand).palm > 0.95)
    dark = [line[palm] > 0.3 for line in lines[:2]]
    assert all(0.01 < float(where.float().mean()) < 0.2 for where in dark)
    assert not torch.equal(*dark)


def test_folds_of_straight_fingers_are_no_darker_than_the_skin_around(hand):
    """Folds without ridges between them made a brown patch of a joint, and short ones were scratches."""
    fold = sample_detail(hand, on_all_faces(hand), 0).fold
    segment = hand.segment[hand.faces[:, 0]]
    palm, along, around = (
        values[hand.faces].mean(1) for values in (skin_regions(hand).palm, hand.bone_t, hand.bone_theta.cos())
    )
    for bone in (2, 5, 8, 11):  # the second of each finger
        joint = (segment == bone) & (palm < 0.05) & (along < 0.25) & (around > 0.3)
        assert abs(float(fold[joint].mean())) < 0.04
        assert float(fold[joint].amin()) < -0.15
        assert float(fold[joint & (around < 0.7)].std()) > 0.02


def test_folds_of_fingers_lie_in_skin_that_opens(hand):
    """The outermost folds of middle joints lay beyond it and stayed as brown spots on bent fingers."""
    skin = _joint_skin(hand)
    share = torch.zeros(len(hand.template)).index_copy(0, skin.vertex, skin.fold)
    opens, palm = (values[hand.faces].mean(1) for values in (share, skin_regions(hand).palm))
    on_finger = torch.isin(hand.segment[hand.faces[:, 0]], torch.tensor([1, 2, 4, 5, 7, 8, 10, 11])) & (palm < 0.05)
    for seed in range(2):
        fold = sample_detail(hand, on_all_faces(hand), seed).fold
        folded = on_finger & (fold > 0.3)
        assert int(folded.sum()) > 50 and float(opens[folded].quantile(0.05)) > 0.8, seed


def test_lines_of_the_palm_fade_towards_the_wrist(hand):
    """The line around the ball of the thumb ended as a slit in the middle of a fist."""
    middles, palm = hand.template[hand.faces].mean(1), skin_regions(hand).palm[hand.faces].mean(1)
    for seed in range(2):
        fold = sample_detail(hand, on_all_faces(hand), seed).fold
        clear, faded = (
            float(fold[(palm > 0.95) & (middles[:, 0] > low) & (middles[:, 0] < high)].quantile(0.99))
            for low, high in ((-0.095, -0.07), (-0.045, -0.02))
        )
        assert clear > 0.6 and faded < 0.5 * clear, (seed, clear, faded)


def test_the_same_place_has_the_same_detail_as_a_vertex_and_on_a_face(hand):
    """A wrong corner of the texture coordinates would show another place's skin; islands' rims have two."""
    index = torch.arange(len(hand.template))
    faces = torch.arange(0, len(hand.faces), 7)
    corner = torch.tensor([[1.0, 0.0, 0.0]]).repeat(len(faces), 1)
    detail = sample_detail(hand, at_places(index, faces, corner), 0).skin
    apart = (detail[len(index) :] - detail[hand.faces[faces, 0]]).abs().amax(1)
    assert float((apart < 1e-5).float().mean()) > 0.97


def test_no_finger_has_dark_bars_on_its_palm_side():
    """One of the maps' hands has dark skin, in whose creases pigment lies: to .75 of the skin around, on one finger."""
    hand = bundled_hand()
    palm = label_regions(hand).palm[hand.faces].mean(1)
    bones = hand.segment[hand.faces[:, 0]]
    for seed in range(3):
        added = _skin_detail(sample_detail(hand, on_all_faces(hand), seed), palm[:, None]).mean(1)
        darkest = [float(added[(bones == bone) & (palm > 0.7)].quantile(0.05)) for bone in range(1, 16)]
        assert -0.23 < min(darkest) < -0.05, seed  # thin creases have up to .21


def test_fingers_have_no_frames_on_their_palm_side():
    """The maps' red pads in a frame of paint, and creases as wide as bars, were nails and rings on straight fingers."""
    hand = bundled_hand()
    palm, vertices = label_regions(hand).palm, torch.arange(len(hand.template))
    pads = (palm > 0.95) & (hand.segment > 0)
    for seed in range(3):
        detail = sample_detail(hand, at_places(vertices, vertices[:0], torch.zeros(0, 3)), seed)
        added = _skin_detail(detail, palm[:, None]).mean(1, keepdim=True)
        wide = surface.smooth_over_mesh(added, surface.mesh_edges(hand.faces), 6)[pads]  # over 5 mm
        assert 0.005 < float(wide.std()) < 0.025, seed  # it was .037


def test_grain_is_cells_of_skin_that_are_a_seeds_own(hand):
    """White noise on each Gaussian was finer on finer ones, until nothing of it was left."""
    faces = torch.arange(len(hand.faces)).repeat_interleave(8)
    weights = torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(0))
    places = at_places(faces[:0], faces, weights / weights.sum(1, keepdim=True))
    grain, again, other = (skin_grain(hand, places, seed) for seed in (0, 0, 1))
    assert torch.equal(grain, again)
    palm, nail = (part[hand.faces[faces]].mean(1) for part in (skin_regions(hand).palm, skin_regions(hand).nail))
    back = (palm < 0.01) & (nail < 0.01)
    assert abs(float(torch.corrcoef(torch.stack([grain, other]))[0, 1])) < 0.02
    assert 0.017 < float(grain[back].std()) < 0.023 and abs(float(grain.mean())) < 0.002
    assert float(grain[palm > 0.99].std() / grain[back].std()) == pytest.approx(1.5, abs=0.05)
    assert float(grain[nail > 0.9999].abs().max()) < 1e-4
    points = (hand.template[hand.faces[faces]] * places.barycentrics[..., None]).sum(1)[back].double()
    chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(1))[:500]
    apart, values = torch.cdist(points[chosen], points), grain[back].double()
    alike = [
        float((values[chosen, None] * values)[(apart > low * CELL) & (apart < high * CELL)].mean() / values.var())
        for low, high in ((0.0, 0.2), (1.5, 3.0))
    ]
    assert alike[0] > 0.5 and abs(alike[1]) < 0.05, alike
