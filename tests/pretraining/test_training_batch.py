"""Pictures of posed hands become training batches whose surfaces lie on their pictures."""

import math

import pytest
import torch

from oasis_warp.avatar.anchors import INSET, inset_offsets
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.core.surface import vertex_normals
from oasis_warp.core.types import HandPose
from oasis_warp.datasets.training_source import DatasetPictures
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.hand_batch import pose_hands
from oasis_warp.pretraining.training_batch import (
    CROP_MARGIN,
    EstimatorNoise,
    LabelledPictures,
    crop_to_mask,
    training_batch,
)

SIZE, CROP = 240, 160
CROP_OF_DOCS = 256
EXACT = EstimatorNoise(surface=0.0, mask=0.0)


def turned(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[0, s, c], [1.0, 0, 0], [0, c, -s]])  # fingers up


def photographed(hand, names, left):
    """Silhouettes of the hand; a left one drawn from the mirrored model, as its photo would show it."""
    K = torch.tensor([[375.0, 0, 125], [0, 375, 115], [0, 0, 1]])
    made = []
    for k, (name, is_left) in enumerate(zip(names, left, strict=True)):
        shape = 0.5 * torch.randn(len(hand.shape_names), generator=torch.Generator().manual_seed(k // 3))
        pose = HandPose(named_pose(hand, name), turned(0.4 * k), torch.tensor([0.01, 0.05, 0.4]))
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
