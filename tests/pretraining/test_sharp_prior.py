"""Training against a discriminator: what it judges, what it does not see, and that it stops and goes on."""

from itertools import islice

import pytest
import torch
from painted_hands import PaintedHands
from small_training import ALONE, CONFIG, small_network

from oasis_warp.pretraining.pretrain import CHECKPOINT, WEIGHTS, pretrain
from oasis_warp.pretraining.prior_trainer import true_pictures
from oasis_warp.pretraining.sharp_prior import (
    ADVERSARY,
    SharpConfig,
    SharpPriorTrainer,
    hidden_skin,
    patches_of,
    wide_difference,
)


def new_trainer(hand, **options):
    return SharpPriorTrainer(small_network(hand), CONFIG, ALONE, **options)


@pytest.fixture(scope="module")
def source(hand):
    return PaintedHands(hand, hands=1, targets=2, size=64)


def test_a_training_that_was_stopped_ends_with_the_same_bits(hand, source, tmp_path):
    """The discriminator and its moments are part of what a checkpoint holds."""
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    for folder in (whole, halves):
        folder.mkdir()
    pretrain(new_trainer(hand), source, whole)
    stops = iter([False, True])
    assert pretrain(new_trainer(hand), source, halves, should_stop=lambda: next(stops)) == 2
    assert pretrain(new_trainer(hand, seed=1), source, halves) == 4
    for name in (CHECKPOINT, ADVERSARY, WEIGHTS):
        assert (halves / name).read_bytes() == (whole / name).read_bytes(), name


def test_only_skin_that_the_photo_hides_is_judged(hand, source):
    batch = next(islice(source(0, 0, 1), 1))
    trainer = new_trainer(hand)
    true = true_pictures(batch, trainer.network.faces, trainer.network.rim)
    hidden = hidden_skin(batch, true.alphas, trainer.network)
    assert float(hidden.share.max()) > 0.99
    photo = {name: getattr(batch, name)[:, None].expand(-1, 2, *getattr(batch, name).shape[1:])
             for name in ("posed", "viewmat", "K")}  # fmt: skip
    same = batch._replace(target_posed=photo["posed"], target_viewmats=photo["viewmat"], target_Ks=photo["K"])
    seen = hidden_skin(same, torch.ones_like(true.alphas), trainer.network)
    assert float(seen.judged.mean()) < 0.01 < 0.03 < float(hidden.judged.mean())


def test_the_discriminator_does_not_see_tone(hand):
    random = torch.Generator().manual_seed(0)
    image, judged = 0.4 + 0.1 * torch.rand(1, 64, 64, 3, generator=random), torch.zeros(1, 64, 64)
    judged[:, 10:50, 10:50] = 1
    seen, darker = patches_of(image, judged), patches_of(image - 0.3, judged)
    assert torch.allclose(seen, darker, atol=1e-5)
    assert float(seen[:, :3].abs().amax()) > 0.1 and float(seen[:, :, :10].abs().amax()) == 0


def test_wide_means_ignore_detail_and_notice_tone():
    random = torch.Generator().manual_seed(0)
    image, weight = torch.full((1, 64, 64, 3), 0.5), torch.ones(1, 64, 64)
    detail = 0.1 * torch.randn(1, 64, 64, 3, generator=random)
    assert float(wide_difference(image + detail, image, weight)) < 0.01
    assert float(wide_difference(image + 0.1, image, weight)) == pytest.approx(0.1, rel=1e-5)


def test_detail_of_hidden_skin_is_learned_only_without_its_place(hand, source):
    """The terms that ask for the mean must not see hidden skin, or they would blur what the discriminator wants."""
    batch = next(islice(source(0, 0, 1), 1))
    trainer = new_trainer(hand, sharp=SharpConfig(adversarial=0.0, features=0.0))
    true = true_pictures(batch, trainer.network.faces, trainer.network.rim)
    hidden = hidden_skin(batch, true.alphas, trainer.network)
    noise = 0.2 * torch.randn(batch.target_images.shape, generator=torch.Generator().manual_seed(0))
    noise = noise * hidden.judged.unflatten(0, batch.target_images.shape[:2])[..., None]
    noisy = batch._replace(target_images=batch.target_images + noise)
    before, after = (trainer.evaluate(each).metrics for each in (batch, noisy))
    for name in ("rgb", "perceptual"):
        assert float(after[name].detach()) == pytest.approx(float(before[name].detach()), rel=0.02), name
    assert float(after["hidden_contrast"]) < 0.8 * float(before["hidden_contrast"])
