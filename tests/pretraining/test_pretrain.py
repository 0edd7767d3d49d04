"""Pretraining: its objective, that it learns, stops and goes on, and that several processes are one."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
import torch
from painted_hands import PaintedHands
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from small_training import ALONE, CONFIG, small_network

from oasis_warp.avatar.observation import source_photos
from oasis_warp.core.errors import InputError
from oasis_warp.core.processes import using_threads
from oasis_warp.core.types import Camera
from oasis_warp.losses import masked_dssim, masked_l1
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork, Prediction
from oasis_warp.network.weights_file import load_network, trained_state
from oasis_warp.pretraining.pretrain import CHECKPOINT, METRICS, SHEET, WEIGHTS, PretrainConfig, learning_rate, pretrain
from oasis_warp.pretraining.prior_trainer import (
    LossConfig,
    PriorTrainer,
    RenderBatch,
    draw_targets,
    objective,
    picture_psnr,
    position_loss,
    scaling_loss,
    true_pictures,
)
from oasis_warp.render import render


@pytest.fixture(scope="module")
def source(hand):
    return PaintedHands(hand, hands=1, targets=1, size=32)


@pytest.fixture(scope="module")
def unbroken(hand, source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    network = small_network(hand)
    pretrain(PriorTrainer(network, CONFIG, ALONE), source, folder)
    return folder, network


class Killed(Exception):
    pass


def test_a_training_that_was_killed_ends_with_the_same_bits(hand, source, unbroken, tmp_path):
    def until_killed(first_step, rank, world):
        yield from islice(source(first_step, rank, world), 3)
        raise Killed

    with pytest.raises(Killed):
        pretrain(PriorTrainer(small_network(hand), CONFIG, ALONE), until_killed, tmp_path)
    assert [json.loads(line)["step"] for line in (tmp_path / METRICS).read_text().splitlines()] == [1, 2, 3]
    with using_threads(3 - min(torch.get_num_threads(), 2)):  # another number than the unbroken one had
        pretrain(PriorTrainer(small_network(hand), CONFIG, ALONE), source, tmp_path)
    for name in (CHECKPOINT, WEIGHTS, SHEET):
        assert (tmp_path / name).read_bytes() == (unbroken[0] / name).read_bytes(), name


def test_a_training_killed_after_its_last_checkpoint_still_leaves_the_weights(hand, source, unbroken, tmp_path):
    shutil.copy(unbroken[0] / CHECKPOINT, tmp_path)
    lines = (unbroken[0] / METRICS).read_text()
    (tmp_path / METRICS).write_text(lines[:50] + "\n[]\n3\n\n" + "[" * 10_000 + "\n" + lines + lines[:20])
    assert pretrain(PriorTrainer(small_network(hand), CONFIG, ALONE), source, tmp_path) == 4
    assert (tmp_path / WEIGHTS).read_bytes() == (unbroken[0] / WEIGHTS).read_bytes()
    assert (tmp_path / METRICS).read_text() == lines


def test_what_is_left_in_the_folder_says_what_happened(hand, unbroken):
    folder, network = unbroken
    lines = [json.loads(line) for line in (folder / METRICS).read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    terms = {"rgb", "mask", "ssim", "perceptual", "position", "scaling"}
    assert {"loss", "psnr", "seconds_per_step", *terms} < set(lines[0])
    loaded = load_network(folder / WEIGHTS, hand)
    assert all(torch.equal(v.half().float(), trained_state(loaded)[k]) for k, v in trained_state(network).items())
    assert (folder / SHEET).stat().st_size > 1000
    assert sorted(path.name for path in folder.iterdir()) == sorted([CHECKPOINT, WEIGHTS, METRICS, SHEET])


def test_the_checkpoint_of_another_network_is_refused(hand, source, unbroken):
    with pytest.raises(InputError, match="the checkpoint of a network with other sizes or switches"):
        pretrain(PriorTrainer(small_network(hand, vpia="no_bias"), CONFIG, ALONE), source, unbroken[0])


@pytest.mark.parametrize(
    ("header", "tensors", "words"),
    [
        ({"step": -1}, {}, "its step is -1; remove it"), ({"step": 1.5}, {}, "its step is 1.5"),
        ({"step": "NaN"}, {}, "its step is 'NaN'"), ({"step": True}, {}, "its step is True"),
        (None, {}, "its header cannot be read"), ("[" * 100_000, {}, "its header cannot be read"),
        ({}, {"weights.vertex_head.last.bias": None}, "1 tensors do not fit"),
        ({}, {"exp_avg.vertex_head.last.bias": torch.zeros(3)}, "1 tensors do not fit"),
        ({}, {"more": torch.zeros(3)}, "1 tensors do not fit"),
        ({}, {"weights.vertex_head.last.bias": torch.nan}, "not finite"),
    ],
)  # fmt: skip
def test_a_damaged_checkpoint_is_refused_in_one_sentence(hand, source, unbroken, tmp_path, header, tensors, words):
    with safe_open(unbroken[0] / CHECKPOINT, framework="pt") as file:
        ((name, text),) = file.metadata().items()
        stored = {key: file.get_tensor(key) for key in file.keys()}
    for key, value in tensors.items():
        stored[key] = stored[key] * value if isinstance(value, float) else value
    stored = {key: value for key, value in stored.items() if value is not None}
    text = json.dumps(json.loads(text) | header) if isinstance(header, dict) else header or ""
    save_file(stored, tmp_path / CHECKPOINT, {name: text})
    with pytest.raises(InputError, match=words) as caught:
        pretrain(PriorTrainer(small_network(hand), CONFIG, ALONE), source, tmp_path)
    assert str(tmp_path / CHECKPOINT) in str(caught.value)


def test_the_learning_rate_rises_and_falls_or_stays():
    config = PretrainConfig(steps=1000, warmup=100)
    rates = [learning_rate(config, step) for step in range(1000)]
    assert rates[0] == pytest.approx(4e-6)
    assert max(rates) == pytest.approx(4e-4, rel=0.03)
    assert rates.index(max(rates)) in (98, 99, 100)
    assert rates[-1] < 1e-8
    flat = PretrainConfig(steps=1000, warmup=100, decay="none")
    assert learning_rate(flat, 100) == learning_rate(flat, 999) == 4e-4
    cooled = replace(flat, decay="cooldown")
    assert learning_rate(cooled, 100) == learning_rate(cooled, 800) == 4e-4
    assert learning_rate(cooled, 900) == pytest.approx(2e-4) and learning_rate(cooled, 1000) == 0


def test_a_loss_that_is_not_finite_ends_the_training(hand, source, tmp_path):
    def poisoned(first_step, rank, world):
        for batch in source(first_step, rank, world):
            yield batch._replace(target_images=batch.target_images * float("nan"))

    with pytest.raises(InputError, match="the loss is not finite at step 1; lower the learning rate"):
        pretrain(PriorTrainer(small_network(hand), CONFIG, ALONE), poisoned, tmp_path)
    assert not (tmp_path / CHECKPOINT).exists()


def test_a_gradient_that_is_not_finite_changes_nothing_and_is_counted(hand, source, tmp_path):
    def poisoned_once(first_step, rank, world):
        for step, batch in enumerate(source(first_step, rank, world), first_step):
            yield batch._replace(target_images=batch.target_images * torch.nan) if step == 1 else batch

    trainer = PriorTrainer(small_network(hand), replace(CONFIG, log_every=4, checkpoint_every=4), ALONE)
    assert pretrain(trainer, poisoned_once, tmp_path) == 4
    (line,) = [json.loads(line) for line in (tmp_path / METRICS).read_text().splitlines()]
    assert line["skipped"] == 1 and all(parameter.isfinite().all() for parameter in trainer.trained)


def test_half_precision_trains_too(hand, source):
    trainer = PriorTrainer(small_network(hand), replace(CONFIG, precision="bfloat16"), ALONE)
    exact = PriorTrainer(small_network(hand), CONFIG, ALONE)
    batch = source.batch(0)
    torch.testing.assert_close(trainer.evaluate(batch).loss, exact.evaluate(batch).loss, rtol=0.02, atol=0)
    trainer.advance(batch)
    assert all(bool(parameter.isfinite().all()) for parameter in trainer.network.parameters())
    assert all(parameter.dtype == torch.float32 for parameter in trainer.network.parameters())


@pytest.mark.parametrize("switch", [{"fom": "off"}, {"vpia": "off", "vet": "mlp"}])
def test_ablated_networks_train_too(hand, source, switch):
    trainer = PriorTrainer(small_network(hand, **switch), CONFIG, ALONE)
    before = [parameter.detach().clone() for parameter in trainer.network.vertex_head.parameters()]
    trainer.advance(source.batch(0))
    after = list(trainer.network.vertex_head.parameters())
    assert not torch.equal(before[-1], after[-1])


def test_a_part_that_a_switch_leaves_out_of_use_is_saved_and_read_too(hand, source, tmp_path):
    made = [PriorTrainer(small_network(hand, vet="off", point_evidence="off"), CONFIG, ALONE) for _ in range(2)]
    made[0].advance(source.batch(0))
    unused = [name for name, parameter in made[0].network.named_parameters() if parameter.grad is None]
    assert unused
    made[0].save(tmp_path / CHECKPOINT)
    made[1].resume(tmp_path / CHECKPOINT)
    for trainer in made:
        trainer.advance(source.batch(1))
    assert all(map(torch.equal, made[0].network.parameters(), made[1].network.parameters()))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_training_finds_the_paint(hand):
    source = PaintedHands(hand, hands=1, targets=1, size=48)
    config = replace(CONFIG, steps=50, warmup=5, learning_rate=2e-3)
    trainer = PriorTrainer(small_network(hand, width=32, head_width=32, image_size=64), config, ALONE)
    test = PaintedHands(hand, hands=2, targets=2, size=48).batch(10**6)
    with torch.no_grad():
        before = trainer.evaluate(test)
    for batch in islice(source(0, 0, 1), config.steps):
        trainer.advance(batch)
    with torch.no_grad():
        after = trainer.evaluate(test)
    assert float(after.metrics["psnr"]) > float(before.metrics["psnr"]) + 0.5
    assert float(after.loss) < 0.96 * float(before.loss)


@pytest.mark.slow
def test_two_processes_average_their_gradients(hand, source, tmp_path):
    script = Path(__file__).with_name("train_together.py")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*command, str(script), str(tmp_path)], capture_output=True, text=True, timeout=280, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    ours, theirs = (load_file(tmp_path / f"rank{rank}.safetensors") for rank in range(2))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    # one process with both batches: Adam's first moment after one step is a tenth of the mean gradient
    trainer = PriorTrainer(small_network(hand), replace(CONFIG, steps=1, clip=1e9), ALONE)
    loss = (trainer.evaluate(source.batch(0)).loss + trainer.evaluate(source.batch(1)).loss) / 2
    loss.backward()
    moments = load_file(tmp_path / CHECKPOINT)
    for name, parameter in trainer.network.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(moments[f"exp_avg.{name}"], 0.1 * parameter.grad, atol=1e-7, rtol=1e-3)


def prediction(**changed):
    still = Prediction(
        offsets=torch.zeros(1, 4, 3), barycentrics=torch.full((1, 2, 3), 1 / 3), quats=torch.rand(1, 6, 4),
        scales=torch.full((1, 6, 3), 1e-3), opacities=torch.ones(1, 6), colors=torch.rand(1, 6, 3),
        anchor_scales=torch.full((1, 6, 3), 1e-3),
    )  # fmt: skip
    return still._replace(**changed)


@pytest.fixture
def network_of(hand):
    """Draw the targets of a batch by an untrained network."""
    config = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)

    def draw(batch):
        network = HandNetwork(config, hand)
        with torch.no_grad():
            return draw_targets(network(source_photos(batch)), batch, network)

    return draw


@pytest.fixture
def pair():
    random = torch.Generator().manual_seed(0)
    true = RenderBatch(torch.rand(3, 24, 24, 3, generator=random), torch.zeros(3, 24, 24))
    true.alphas[:, 4:20, 4:20] = 1
    true = true._replace(images=true.images * true.alphas[..., None])
    noise = 0.1 * torch.randn(3, 24, 24, 3, generator=random)
    return RenderBatch(true.images + noise, (true.alphas + 0.1).clamp(0, 1)), true


def test_the_truth_costs_nothing(pair):
    _, true = pair
    loss, terms = objective(prediction(), true, true, LossConfig())
    assert float(loss) == pytest.approx(0, abs=1e-6)
    assert set(terms) == {"rgb", "mask", "ssim", "perceptual", "position", "scaling"}


def test_terms_are_means_over_pictures_and_add_up_with_the_papers_weights(pair):
    drawn, true = pair
    loss, terms = objective(prediction(), drawn, true, LossConfig())
    rgb = [masked_l1(a, b, m) for a, b, m in zip(drawn.images, true.images, true.alphas, strict=True)]
    ssim = [masked_dssim(a, b, m) for a, b, m in zip(drawn.images, true.images, true.alphas, strict=True)]
    torch.testing.assert_close(terms["rgb"], torch.stack(rgb).mean())
    torch.testing.assert_close(terms["ssim"], torch.stack(ssim).mean())
    outside = 24 * 24 - 16 * 16
    assert float(terms["mask"]) == pytest.approx(0.1 * outside / 256, rel=1e-5)
    weights = {"rgb": 10, "mask": 1, "ssim": 1, "perceptual": 5, "position": 1, "scaling": 0.5}
    torch.testing.assert_close(loss, sum(weights[name] * term for name, term in terms.items()))


def test_another_perceptual_term_takes_the_place_of_ours(pair):
    drawn, true = pair
    _, terms = objective(prediction(), drawn, true, LossConfig(), lambda a, b, m: 7 + 0 * a.mean((1, 2, 3)))
    assert float(terms["perceptual"]) == 7


def test_offsets_cost_beyond_the_limit_and_have_a_gradient_at_zero():
    offsets = torch.tensor([[0.0, 0, 0], [0.003, 0, 0], [0, 0.012, 0], [0, 0, -0.009]], requires_grad=True)
    loss = position_loss(offsets, 0.006)
    assert loss.item() == pytest.approx((1 + 0.5) / 4, rel=1e-5)
    loss.backward()
    assert offsets.grad is not None and bool(offsets.grad.isfinite().all())
    assert offsets.grad[:2].abs().sum() == 0


def test_needles_cost_what_they_exceed_the_limit_by():
    scales = torch.tensor([[1.0, 1, 1], [5, 1, 1], [1, 8, 1], [1, 1, 0.1]]) * 1e-3
    assert float(scaling_loss(scales, torch.ones(4, 3), 5.0)) == pytest.approx((3 + 5) / 4, rel=1e-5)


def test_an_anchor_may_stay_as_long_as_it_is():
    anchors = torch.tensor([[1.0, 1, 0.1], [2, 1, 1]]) * 1e-3
    assert not scaling_loss(anchors, anchors, 5.0).any()
    longer = anchors * torch.tensor([1.2, 1, 1])
    assert float(scaling_loss(longer, anchors, 5.0)) == pytest.approx(2 / 2, rel=1e-5)


def test_psnr_is_that_inside_the_masks(pair):
    drawn, true = pair
    error = ((drawn.images - true.images)[:, 4:20, 4:20] ** 2).mean((1, 2, 3))
    torch.testing.assert_close(picture_psnr(drawn, true), (-10 * error.log10()).mean())


def test_targets_fade_at_the_wrist_as_gaussians_do_and_nowhere_else(hand):
    batch = PaintedHands(hand, hands=1, targets=2, size=64).batch(0)
    full = batch._replace(
        target_images=torch.ones_like(batch.target_images), target_masks=torch.ones_like(batch.target_masks)
    )
    true = true_pictures(full, hand.faces, hand.rim)
    assert torch.equal(true.images[..., 0], true.alphas)
    assert float(true.alphas.amin()) < 0.2
    rim = batch.target_posed[0, :, hand.rim].mean(1)
    for target in range(2):
        viewmat, K = batch.target_viewmats[0, target], batch.target_Ks[0, target]
        local = viewmat[:3, :3] @ rim[target] + viewmat[:3, 3]
        place = (K @ (local / local[2]))[:2]
        faded = torch.nonzero(true.alphas[target] < 0.99).float().flip(1) + 0.5
        assert float((faded - place).norm(dim=1).max()) < 25  # pixels of a picture 64 wide
        assert float(true.alphas[target].mean()) > 0.9


def test_what_was_drawn_by_the_truth_costs_nearly_nothing(hand):
    """Faded Gaussians drawn over black are the faded target: no term asks for more than can be drawn."""
    from oasis_warp.avatar.anchors import place_anchors
    from oasis_warp.avatar.pose import pose_gaussians
    from oasis_warp.hand.skinning import rest_hand

    batch = PaintedHands(hand, hands=1, targets=1, size=64).batch(0)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))._replace(vertices=batch.rest[0])
    anchors = place_anchors(hand, rest)
    grey = anchors.with_colors(torch.full((len(anchors.opacities), 3), 0.5))
    posed = pose_gaussians(grey, hand.faces, batch.rest[0], batch.target_posed[0, 0])
    camera = Camera(batch.target_viewmats[0, 0], batch.target_Ks[0, 0], 64, 64)
    drawn = render(posed, camera)
    solid = batch._replace(
        target_images=torch.full_like(batch.target_images, 0.5) * (drawn.alpha > 0.02)[None, None, ..., None],
        target_masks=(drawn.alpha > 0.02).float()[None, None],
    )
    true = true_pictures(solid, hand.faces, hand.rim)
    inner = -torch.nn.functional.max_pool2d(-(drawn.alpha > 0.02).float()[None], 3, 1, 1)[0] > 0
    assert float((true.images[0] - drawn.image).abs().mean(-1)[inner].mean()) < 0.03


def test_what_a_sleeve_hides_is_neither_asked_for_nor_forbidden(hand, network_of):
    batch = PaintedHands(hand, hands=1, targets=1, size=32).batch(0)
    known = torch.ones_like(batch.target_known)
    known[..., :16] = 0
    half = batch._replace(target_known=known)
    true = true_pictures(half, hand.faces, hand.rim)
    assert not true.images[:, :, :16].any() and not true.alphas[:, :, :16].any()
    drawn = network_of(half)
    assert not drawn.images[:, :, :16].any() and not drawn.alphas[:, :, :16].any()
    assert drawn.alphas[:, :, 16:].any()
