"""Training of the dense network: its batches, its loss, and that it resumes."""

import json

import numpy as np
import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.network.dense_network import (
    HEADS,
    DenseNetwork,
    DensePrediction,
    load_dense_network,
    save_dense_network,
)
from oasis_warp.pretraining.dense_source import DensePhotos, detected
from oasis_warp.pretraining.dense_trainer import DenseTrainer, dense_loss
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import CHECKPOINT, METRICS, WEIGHTS, PretrainConfig, pretrain
from oasis_warp.synthetic.dense_pictures import moved
from oasis_warp.synthetic.sensor import srgb

CPU = torch.device("cpu")
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


def test_the_truth_has_no_loss_but_its_own_uncertainty(batch):
    """A head compared with another field, or a field in another unit, would leave a loss."""
    sure = -6.0
    said = DensePrediction(
        classes=(batch.classes + 1e-9).log(),
        surface=batch.surface,
        log_scale=torch.full_like(batch.surface[:, 0], sure),
        normal=batch.normal,
        albedo=srgb(batch.albedo),
        finger=50 * torch.nn.functional.one_hot(batch.finger, HEADS["finger"]).permute(0, 3, 1, 2).float(),
    )
    terms = dense_loss(said, batch)
    entropy = -(batch.classes * (batch.classes + 1e-9).log()).sum(1).mean()
    assert terms["classes"] == pytest.approx(float(entropy), abs=1e-4)
    assert terms["surface"] == pytest.approx(3 * sure, abs=1e-4)
    for name in ("normal", "albedo", "edges", "finger"):
        assert abs(float(terms[name])) < 1e-5, name


def test_surface_points_of_a_photo_lie_on_the_resting_hand_and_show_its_fingers(batch, hand):
    rest = hand.template
    for surface, finger, skin in zip(batch.surface, batch.finger, batch.skin, strict=True):
        points = 0.1 * surface[:, skin].T
        assert torch.cdist(points, rest).amin(1).max() < 0.006  # metres; a pixel at a crease is a mean of both sides
        tips = torch.cdist(points, hand.tips)
        near = tips.amin(1) < 0.012
        assert (finger[skin][near] == tips.argmin(1)[near] + 1).float().mean() > 0.95


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
