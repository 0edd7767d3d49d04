"""Batches to train on: their surfaces lie on their pictures, and which pictures come when is always the same."""

import itertools
import json
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from oasis_warp.avatar.anchors import INSET, inset_offsets
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.core.surface import vertex_normals
from oasis_warp.core.types import HandPose
from oasis_warp.datasets.training_source import DatasetPictures
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.network.dense_network import (
    HEADS,
    DenseNetwork,
    DensePrediction,
    load_dense_network,
    save_dense_network,
)
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.dense_trainer import DensePhotos, DenseTrainer, dense_loss, detected
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.hand_batch import pose_hands
from oasis_warp.pretraining.pretrain import CHECKPOINT, METRICS, WEIGHTS, BatchSource, PretrainConfig, pretrain
from oasis_warp.pretraining.synthetic_source import EVEN_EVERY, SyntheticHands
from oasis_warp.pretraining.training_batch import (
    CROP_MARGIN,
    EstimatorNoise,
    LabelledPictures,
    crop_to_mask,
    training_batch,
)
from oasis_warp.synthetic.dense_pictures import moved
from oasis_warp.synthetic.sensor import srgb
from oasis_warp.synthetic.shots import EVERYBODY, PICTURES_EACH

SIZE, CROP = 240, 160
CROP_OF_DOCS = 256
EXACT = EstimatorNoise(surface=0.0, mask=0.0)


def rotated(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[0, s, c], [1.0, 0, 0], [0, c, -s]])  # fingers up


def photographed(hand, names, left):
    """Silhouettes of the hand; a left one drawn from the mirrored model, as its photo would show it."""
    K = torch.tensor([[375.0, 0, 125], [0, 375, 115], [0, 0, 1]])
    made = []
    for k, (name, is_left) in enumerate(zip(names, left, strict=True)):
        shape = 0.5 * torch.randn(len(hand.shape_names), generator=torch.Generator().manual_seed(k // 3))
        pose = HandPose(named_pose(hand, name), rotated(0.4 * k), torch.tensor([0.01, 0.05, 0.4]))
        vertices = skin(hand, rest_hand(hand, shape), pose).vertices
        if is_left:
            vertices, pose = vertices * torch.tensor([-1.0, 1, 1]), mirror_pose(pose)
        mask = (depth_map(vertices, hand.faces, torch.eye(4), K, SIZE, SIZE).face_ids >= 0).float()
        image = torch.stack([mask, 0.5 * mask, 0.2 * mask], dim=-1)
        made.append((image, mask, mask, pose.angles, pose.orientation, pose.translation, shape, K))
    return DatasetPictures(*(torch.stack(parts) for parts in zip(*made, strict=True)), torch.tensor(left).int())


@pytest.fixture(scope="module")
def pictures(hand):
    names = ("open", "fist", "pinch")
    return photographed(hand, names, (0, 1, 1)), photographed(hand, names * 2, (0, 0, 1, 1, 0, 1))


def projected(batch):
    seen = batch.posed @ batch.K.transpose(1, 2)
    return seen[..., :2] / seen[..., 2:]


def overlap(hand, vertices, K, mask):
    vertices = vertices + INSET * vertex_normals(vertices, hand.faces)
    drawn = depth_map(vertices, hand.faces, torch.eye(4), K, mask.shape[1], mask.shape[0]).face_ids >= 0
    return float((drawn & (mask > 0.5)).sum() / (drawn | (mask > 0.5)).sum())


def test_many_hands_are_posed_as_one_by_one(hand, pictures):
    photos, _ = pictures
    assert isinstance(photos, LabelledPictures)
    out = pose_hands(hand, photos.shape, photos.angles, photos.orientation, photos.translation)
    for k in range(3):
        rest = rest_hand(hand, photos.shape[k])
        rest = rest._replace(vertices=rest.vertices + inset_offsets(hand))
        posed = skin(hand, rest, HandPose(photos.angles[k], photos.orientation[k], photos.translation[k]))
        torch.testing.assert_close(out.rest[k], rest.vertices, atol=1e-6, rtol=0)
        torch.testing.assert_close(out.posed[k], posed.vertices, atol=2e-6, rtol=0)
        torch.testing.assert_close(out.landmarks[k], hand21(posed, hand), atol=2e-6, rtol=0)


def test_surfaces_lie_on_their_pictures_left_hands_as_right_ones(hand, pictures):
    batch = training_batch(hand, *pictures, CROP, torch.Generator().manual_seed(0), EXACT)
    for k in range(3):
        assert overlap(hand, batch.posed[k], batch.K[k], batch.mask[k]) > 0.94
        for t in range(2):
            assert overlap(hand, batch.target_posed[k, t], batch.target_Ks[k, t], batch.target_masks[k, t]) > 0.94


def test_crops_frame_their_hands(hand, pictures):
    batch = training_batch(hand, *pictures, CROP, torch.Generator().manual_seed(0), EXACT)
    for mask in (*batch.mask, *batch.target_masks.flatten(0, 1)):
        rows, columns = torch.nonzero(mask > 0.5).unbind(1)
        extent = max(int(rows.max() - rows.min()), int(columns.max() - columns.min())) + 1
        assert abs(extent - CROP / CROP_MARGIN) < 2
        assert abs(float(rows.max() + rows.min() + 1) / 2 - CROP / 2) < 1.5


def test_targets_show_the_hand_alone(hand, pictures):
    photos, targets = pictures
    arm = targets.mask * (torch.arange(SIZE)[:, None] < 100)
    sleeved = targets._replace(mask=arm)
    batch = training_batch(hand, photos, sleeved, CROP, torch.Generator().manual_seed(0), EXACT)
    assert not batch.target_images[batch.target_masks == 0].any()
    covered = batch.target_known < 0.01
    assert covered.any() and not batch.target_masks[covered].any()
    inside = batch.target_masks > 0.99
    green = batch.target_images[inside][:, 1]
    torch.testing.assert_close(green, torch.full_like(green, 0.5), atol=0.01, rtol=0)


def test_errors_are_those_of_an_estimator_and_only_in_what_it_says(hand, pictures):
    def make(seed, noise):
        return training_batch(hand, *pictures, CROP, torch.Generator().manual_seed(seed), noise)

    exact, noise = make(0, EXACT), EstimatorNoise()
    noisy, again, other = make(1, noise), make(1, noise), make(2, noise)
    assert all(torch.equal(a, b) for a, b in zip(noisy, again, strict=True))
    assert not torch.equal(noisy.posed, other.posed)
    for field in ("rest", "target_images", "target_masks", "target_posed", "target_Ks"):
        assert torch.equal(getattr(noisy, field), getattr(exact, field))
    error = CROP_OF_DOCS / CROP * (projected(noisy) - projected(exact)).norm(dim=-1).median(1).values
    assert 1 < float(error.min()) and float(error.max()) < 40  # [px], docs/estimator.md: 3 to 11 for most hands
    for k in range(3):
        assert overlap(hand, noisy.posed[k], noisy.K[k], noisy.mask[k]) > 0.65


def test_errors_are_as_large_as_is_asked(hand, pictures):
    def projections(strength):
        noise = EstimatorNoise(surface=strength, mask=0.0)
        return projected(training_batch(hand, *pictures, CROP, torch.Generator().manual_seed(1), noise))

    none, some, all_ = projections(0.0), projections(0.3), projections(1.0)
    half, whole = (some - none).norm(dim=-1).mean(), (all_ - none).norm(dim=-1).mean()
    assert 0.15 * whole < half < 0.5 * whole


def test_an_empty_mask_keeps_the_picture():
    planes = torch.rand(1, 8, 8, 1)
    crop = crop_to_mask(planes, torch.zeros(1, 8, 8), torch.eye(3)[None], 8)
    assert bool(crop.planes.isfinite().all())
    assert float(crop.K[0, 0, 0]) == pytest.approx(1 / CROP_MARGIN)


CPU = torch.device("cpu")
BARE = replace(EVERYBODY, tattoo=0.0, ring=0.0)


def source(**changes):
    usual = {"seed": 13, "people": 1, "hands": 1, "views": 2, "size": 32, "device": CPU, "population": BARE}
    return SyntheticHands(**usual | changes)


def test_a_batch_is_the_same_wherever_training_is_taken_up():
    hands = source()
    assert isinstance(hands, BatchSource)
    from_start = hands(0, 0, 1)
    first, second = next(from_start), next(from_start)
    others = {
        "taken up": next(hands(1, 0, 1)),
        "of another process": next(hands(0, 1, 2)),
        "rendered with the one before": next(itertools.islice(source(ahead=2)(0, 0, 1), 1, None)),
        "rendered with the one after": next(source(ahead=2)(1, 0, 1)),
    }
    for name, value in second._asdict().items():
        for where, other in others.items():
            assert torch.equal(value, getattr(other, name)), (where, name)
        assert bool(value.isfinite().all()), name
    assert not torch.equal(first.image, second.image)
    assert second.image.shape == (1, 32, 32, 3)
    assert second.target_images.shape == (1, 2, 32, 32, 3)


def test_targets_show_the_hands_of_the_photos():
    hands = source(hands=3, views=2)
    photos, targets = hands.photo_indices(5), hands.target_indices(5)
    assert len(set(targets)) == 6
    assert [index // PICTURES_EACH for index in targets] == [p // PICTURES_EACH for p in photos for _ in range(2)]


def test_now_and_then_photos_are_in_the_even_light_of_their_targets_before_a_plain_wall():
    batches = source()(2 * EVEN_EVERY - 2, 0, 1)
    in_a_room, evenly_lit = next(batches), next(batches)

    def alike(batch):
        """Share of the border, part of which is the arm, in one colour."""
        image = batch.image[0]
        border = torch.cat([image[0], image[-1], image[:, 0], image[:, -1]])
        return float(((border - border.median(0).values).abs().amax(1) < 1e-3).float().mean())

    assert alike(evenly_lit) > 0.5 and alike(in_a_room) < 0.2
    hand = evenly_lit.mask[0] > 0.9
    shown, target = evenly_lit.image[0][hand].mean(0), evenly_lit.target_images[0, 0]
    goal = target[evenly_lit.target_masks[0, 0] > 0.9].mean(0)
    torch.testing.assert_close(shown, goal, atol=0.03, rtol=0)


def test_all_processes_together_see_every_picture_once():
    hands = source(hands=3)
    seen = Counter(p for step in range(4) for rank in range(2) for p in hands.photo_indices(2 * step + rank))
    assert sorted(seen) == [PICTURES_EACH * k for k in range(24)] and set(seen.values()) == {1}


@pytest.mark.parametrize(("people", "hands", "world", "steps"), [(12, 3, 2, 50), (7, 2, 3, 50), (100, 4, 2, 3)])
def test_each_process_meets_whom_its_batches_show(people, hands, world, steps):
    made = source(people=people, hands=hands)
    for rank in range(world):
        shown = {
            index // PICTURES_EACH % people
            for step in range(steps)
            for index in made.photo_indices(step * world + rank)
        }
        met = made.people_met(rank, world, steps)
        assert set(met) == shown and len(met) == len(shown)


def test_the_errors_of_an_estimator_differ_from_batch_to_batch_and_seed_to_seed():
    drawn = [float(torch.rand((), generator=s.errors(n))) for s in (source(), source(seed=14)) for n in (0, 1)]
    assert len(set(drawn)) == 4
    assert drawn[0] == float(torch.rand((), generator=source().errors(0)))


def test_a_kind_that_is_held_out_is_not_shown_and_nothing_else_changes():
    kinds = BARE, replace(BARE, ring=1.0)
    without, with_ring = (next(source(population=each, views=1)(0, 0, 1)) for each in kinds)
    assert torch.equal(without.rest, with_ring.rest) and torch.equal(without.target_posed, with_ring.target_posed)
    assert not torch.equal(without.target_images, with_ring.target_images)


CONFIG = PretrainConfig(steps=4, learning_rate=1e-3, warmup=1, decay="cooldown", precision="float32", log_every=1)


@pytest.fixture(scope="module")
def photos():
    return DensePhotos(seed=3, people=1, hands=2, size=64, device=CPU)


@pytest.fixture(scope="module")
def batch(photos):
    return next(photos(0, 0, 1))


def network():
    torch.manual_seed(0)
    return DenseNetwork()


SURE = -6.0
"""Logarithm of the scale that `truth_of` predicts."""


def truth_of(batch):
    return DensePrediction(
        classes=(batch.classes + 1e-9).log(),
        surface=batch.surface,
        log_scale=torch.full_like(batch.surface[:, 0], SURE),
        normal=batch.normal,
        albedo=srgb(batch.albedo),
        finger=50 * torch.nn.functional.one_hot(batch.finger, HEADS["finger"]).permute(0, 3, 1, 2).float(),
    )


def test_the_truth_has_no_loss_but_its_own_uncertainty(batch):
    """A head compared with another field, or a field in another unit, would leave a loss."""
    terms = dense_loss(truth_of(batch), batch)
    entropy = -(batch.classes * (batch.classes + 1e-9).log()).sum(1).mean()
    assert terms["classes"] == pytest.approx(float(entropy), abs=1e-4)
    assert terms["surface"] == pytest.approx(3 * SURE, abs=1e-4)
    for name in ("normal", "albedo", "edges", "contrast", "finger"):
        assert abs(float(terms[name])) < 1e-5, name


def test_surface_points_of_a_photo_lie_on_the_resting_hand_and_show_its_fingers(batch, hand):
    rest = hand.template
    for surface, finger, shown in zip(batch.surface, batch.finger, batch.skin, strict=True):
        points = 0.1 * surface[:, shown].T
        assert torch.cdist(points, rest).amin(1).max() < 0.006  # metres; a pixel at a crease is a mean of both sides
        tips = torch.cdist(points, hand.tips)
        near = tips.amin(1) < 0.012
        assert (finger[shown][near] == tips.argmin(1)[near] + 1).float().mean() > 0.95


def test_moved_photos_keep_what_each_surface_point_shows(batch):
    """A label that moves otherwise than the photo teaches the network a shift."""
    again = moved(batch, torch.Generator().manual_seed(2))
    before, after = (
        (b.surface[0][:, b.skin[0]].T, b.albedo[0][:, b.skin[0]].T, b.normal[0][:, b.skin[0]].T) for b in (batch, again)
    )
    distance, nearest = torch.cdist(after[0], before[0]).min(1)
    near = distance < 0.02
    assert near.float().mean() > 0.7
    assert (after[1] - before[1][nearest])[near].abs().mean() < 0.05
    assert (after[2][:, 2] - before[2][nearest, 2])[near].abs().mean() < 0.1
    pixels = again.landmarks[0].round().long().clamp(0, 63)
    on_hand = [float(again.classes[0, 1, y, x]) for x, y in pixels.tolist()]
    assert np.median(on_hand) > 0.5 or (again.landmarks[0] < 0).any() or (again.landmarks[0] > 64).any()


def test_detected_landmarks_scatter_about_the_true_ones_and_some_are_unknown():
    true = 40 * torch.rand(400, 21, 2, generator=torch.Generator().manual_seed(0))
    seen = detected(true, torch.Generator().manual_seed(1))
    unknown = seen.isnan().all(2)
    assert 0.15 < unknown.float().mean() < 0.25
    assert 0.1 < unknown.all(1).float().mean() < 0.2
    off = (seen - true)[~unknown]
    assert off.mean().abs() < 0.1 and 0.2 < off.std() < 2


def test_a_training_that_was_stopped_ends_with_the_same_bits(tmp_path, photos):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder in (whole, parts):
        folder.mkdir()
    here = ProcessInfo(0, 1, CPU)
    pretrain(DenseTrainer(network(), CONFIG, here), photos, whole)
    stops = iter([False, False, True])  # in the middle of the batches of one rendering
    pretrain(DenseTrainer(network(), CONFIG, here), photos, parts, should_stop=lambda: next(stops))
    pretrain(DenseTrainer(network(), CONFIG, here), photos, parts)
    for name in (WEIGHTS, CHECKPOINT):
        assert (whole / name).read_bytes() == (parts / name).read_bytes()
    lines = [[json.loads(line)["loss"] for line in (f / METRICS).read_text().splitlines()] for f in (whole, parts)]
    assert lines[0] == lines[1] and len(lines[0]) == CONFIG.steps
    assert lines[0][-1] < lines[0][0]


def test_a_landmark_changes_what_the_network_says_and_an_unknown_one_does_not_spread():
    net, image = network().eval(), torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))
    nowhere = torch.full((1, 21, 2), torch.nan)
    with torch.inference_mode():
        without, with_one = net(image, nowhere), net(image, nowhere.index_fill(1, torch.tensor([4]), 16.0))
    assert all(field.isfinite().all() for field in without)
    assert not torch.equal(without.classes, with_one.classes)
    assert without.surface.shape == (1, 3, 32, 48)


def test_weights_survive_a_file_and_damaged_files_are_refused(tmp_path):
    net, path = network().half().float(), tmp_path / "dense.safetensors"
    save_dense_network(path, net)
    assert path.stat().st_size < 8e6
    for name, tensor in load_dense_network(path).state_dict().items():
        assert torch.equal(tensor, net.state_dict()[name]), name
    whole = path.read_bytes()
    for damage in (whole[:-100], b"", whole.replace(b'\\"version\\": 1', b'\\"version\\": 9')):
        path.write_bytes(damage)
        with pytest.raises(InputError, match="dense"):
            load_dense_network(path)


def test_a_mean_of_the_albedo_costs_its_missing_contrast(batch):
    blurred = torch.nn.functional.avg_pool2d(srgb(batch.albedo), 9, 1, 4)
    assert dense_loss(truth_of(batch)._replace(albedo=blurred), batch)["contrast"] > 0.3
