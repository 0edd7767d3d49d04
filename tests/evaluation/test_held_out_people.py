"""Who is photographed for an evaluation, which pixels count as hidden or stretched, and tables of the numbers."""

import math

import pytest
import torch
from synthetic import posed_hand

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import TrainingBatch
from oasis_warp.evaluation.held_out import (
    FIRST_PERSON,
    HELD_OUT_SEED,
    POPULATIONS,
    STRETCH,
    CaptureConfig,
    capture_person,
    estimated_batch,
    target_truths,
)
from oasis_warp.evaluation.methods import BASELINE, METHODS, Method, method_name
from oasis_warp.evaluation.metrics import MEASURES
from oasis_warp.evaluation.summary import difference, mean, select, summarise
from oasis_warp.ops import depth_map
from oasis_warp.synthetic.identity import sample_identity

CPU = torch.device("cpu")
CAPTURE = CaptureConfig(targets=2, size=64)


def seen_from(hand, azimuths, target_vertices=None, size=96):
    """An open hand photographed from the palm, and its targets from these sides."""
    rest, _, posed = posed_hand(hand)
    vertices = posed.vertices if target_vertices is None else target_vertices
    photo, *cameras = (orbit_camera(posed.vertices, azimuth, size=size) for azimuth in (0.0, *azimuths))
    n, plane = len(azimuths), torch.ones(1, len(azimuths), size, size)
    return TrainingBatch(
        image=torch.zeros(1, size, size, 3), mask=torch.ones(1, size, size), posed=posed.vertices[None],
        viewmat=photo.viewmat[None], K=photo.K[None], rest=rest.vertices[None],
        target_images=0.5 * plane[..., None].expand(-1, -1, -1, -1, 3), target_masks=plane, target_known=plane,
        target_posed=vertices.expand(1, n, -1, -1), target_viewmats=torch.stack([c.viewmat for c in cameras])[None],
        target_Ks=torch.stack([c.K for c in cameras])[None],
    )  # fmt: skip


def labels(hand, batch):
    """Pixels of the hand in each target; hidden, stretched and squeezed ones."""
    size, vertices = batch.target_images.shape[2], batch.target_posed[0]
    ids = depth_map(vertices, hand.faces, batch.target_viewmats[0], batch.target_Ks[0], size, size).face_ids
    truths = target_truths(batch, hand)
    return [
        tuple(int(part.sum()) for part in (seen >= 0, truth.hidden, truth.stretched, truth.squeezed))
        for seen, truth in zip(ids, truths, strict=True)
    ]


def test_from_the_photos_own_side_nothing_is_hidden_and_from_behind_nearly_all_is(hand):
    (area, hidden, *_), (area_behind, hidden_behind, *_) = labels(hand, seen_from(hand, (0.0, math.pi)))
    assert hidden < 0.02 * area
    assert hidden_behind > 0.95 * area_behind


@pytest.mark.parametrize("growth", [1.02, 1.2, 1 / 1.2])
def test_skin_is_stretched_or_squeezed_from_a_ratio_of_areas_on(hand, growth):
    vertices = posed_hand(hand, pose_name="rest")[2].vertices
    middle = vertices.mean(0)
    ((area, _, stretched, squeezed),) = labels(hand, seen_from(hand, (0.0,), middle + growth * (vertices - middle)))
    assert stretched == (area if growth**2 > STRETCH else 0)
    assert squeezed == (area if growth**2 < 1 / STRETCH else 0)


@pytest.fixture(scope="module")
def person():
    return capture_person(CAPTURE, "ordinary", FIRST_PERSON, CPU)


def test_both_photos_show_the_same_hand_in_the_same_pose(person):
    studio, wild = person.photos["studio"], person.photos["wild"]
    for name in ("angles", "orientation", "shape", "left", "person"):
        assert torch.equal(getattr(studio, name), getattr(wild, name)), name
    torch.testing.assert_close(studio.translation, wild.translation)
    assert not torch.allclose(studio.image, wild.image, atol=0.05)
    for targets in person.targets.values():
        assert targets.image.shape == (2, 80, 80, 3)
        assert torch.equal(targets.shape[0], wild.shape[0])


def test_targets_of_one_capture_are_the_even_ones_in_other_light(person):
    same, even = person.targets["same"], person.targets["studio"]
    for name in ("angles", "orientation", "translation", "mask", "depth"):
        torch.testing.assert_close(getattr(same, name), getattr(even, name), atol=1e-4, rtol=1e-4, msg=name)
    hand, black = same.mask[..., None] > 0.99, same.alpha == 0
    assert float(same.image[black].abs().max()) == 0
    assert float((same.image - even.image)[hand.expand_as(same.image)].std()) > 0.02


def test_a_studios_wall_is_plain_and_the_hand_before_it_lit_as_its_targets(person):
    studio = person.photos["studio"]
    wall = studio.image[studio.alpha == 0]
    assert len(wall) > 500 and torch.equal(wall, wall[:1].expand_as(wall))


def test_the_same_picture_comes_again(person):
    again = capture_person(CAPTURE, "ordinary", FIRST_PERSON, CPU)
    for light, photo in person.photos.items():
        assert torch.equal(photo.image, again.photos[light].image)


def test_groups_are_the_same_people_with_one_thing_more(hand):
    number = FIRST_PERSON + 3
    bare, tattooed, ringed = (
        sample_identity(hand, HELD_OUT_SEED, number, POPULATIONS[group]) for group in ("ordinary", "tattoo", "ring")
    )
    assert (bare.tattoo, bare.ring_finger) == (0, -1)
    assert tattooed.tattoo > 0 and tattooed._replace(tattoo=0).ring_finger == -1
    assert ringed.ring_finger >= 0 and ringed.tattoo == 0
    assert bare.melanin == tattooed.melanin == ringed.melanin and bare.seed == ringed.seed


def test_estimated_poses_are_off_by_as_much_as_the_factor_says(hand, person):
    def posed(factor):
        return estimated_batch(hand, person, "studio", CAPTURE, factor)

    true, once, twice = posed(0.0), posed(1.0), posed(2.0)
    near, far = ((batch.posed - true.posed).norm(dim=-1).mean() for batch in (once, twice))
    assert 0 < float(near) < float(far)
    assert torch.equal(true.target_images, twice.target_images) and torch.equal(true.rest, twice.rest)
    assert torch.equal(once.posed, posed(1.0).posed)
    assert 0 <= float(posed(4.0).mask.min()) and float(posed(4.0).mask.max()) <= 1


def picture(person, target, psnr, method=BASELINE, **more):
    about = {"group": "ordinary", "light": "studio", "noise": 1.0, "colors": "raw", "person": person, "target": target}
    return about | method._asdict() | dict.fromkeys(MEASURES) | {"psnr": psnr} | more


def test_a_person_counts_once_however_many_pictures_there_are():
    before = [picture(1, 0, 20.0), picture(1, 1, 20.0), picture(1, 2, 20.0), picture(2, 0, 30.0)]
    after = [picture(1, 0, 23.0), picture(1, 1, 21.0), picture(1, 2, 23.5), picture(2, 0, 29.5)]
    found = difference(after, before, "psnr")
    assert found is not None
    assert found.mean == pytest.approx((2.5 - 0.5) / 2)
    assert found.error == pytest.approx(1.5)  # standard deviation 1.5 sqrt 2 of two people
    assert found.better == 0.5


def test_only_pictures_that_both_have_are_compared():
    assert difference([picture(1, 0, 20.0)], [picture(2, 0, 10.0)], "psnr") is None
    assert difference([picture(1, 0, None)], [picture(1, 0, 10.0)], "psnr") is None
    found = difference([picture(1, 0, 21.0), picture(1, 1, 99.0)], [picture(1, 0, 20.0)], "psnr")
    assert found == (1.0, None, 1.0)


def test_means_leave_out_what_was_not_measured():
    assert mean([picture(1, 0, 20.0), picture(1, 1, None), picture(1, 2, 22.0)], "psnr") == 21.0
    assert mean([picture(1, 0, 20.0)], "lpips") is None


def test_a_row_for_every_method_and_condition_with_its_gain_over_the_baseline():
    one_shot = Method("learned", "one_shot")
    records = [
        picture(1, 0, 24.0, one_shot), picture(1, 0, 20.0), picture(1, 0, 19.0, light="wild"),
        picture(2, 0, 25.0, one_shot), picture(2, 0, 22.0),
    ]  # fmt: skip
    rows = summarise(records)
    assert [(row["light"], row["prior"], row["stage"]) for row in rows] == [
        ("studio", "mean", "calibrated"), ("studio", "learned", "one_shot"), ("wild", "mean", "calibrated"),
    ]  # fmt: skip
    assert rows[0]["gain"] == 0 and rows[1]["gain"] == 3.5 and rows[1]["better"] == 1
    assert rows[1]["gain_error"] == pytest.approx(0.5)
    assert (rows[1]["people"], rows[1]["pictures"], rows[1]["psnr"]) == (2, 2, 24.5)
    assert select(rows, light="wild") == rows[2:]


def test_without_the_baseline_there_is_no_gain():
    (row,) = summarise([picture(1, 0, 20.0, Method("learned", "raw"))])
    assert row["psnr"] == 20 and row["gain"] is None


def test_methods_have_names_of_their_own():
    assert len({method_name(method) for method in METHODS}) == len(METHODS)
    assert method_name(METHODS[-1]) == "learned one-shot"
