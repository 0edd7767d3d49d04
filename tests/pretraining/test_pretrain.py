"""Pretraining: it learns, stops and goes on, and several processes are one."""

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

from oasis_warp.core.errors import InputError
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, trained_state
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import (
    CHECKPOINT,
    METRICS,
    SHEET,
    WEIGHTS,
    PretrainConfig,
    learning_rate,
    pretrain,
)
from oasis_warp.pretraining.prior_trainer import PriorTrainer

ALONE = ProcessInfo(0, 1, torch.device("cpu"))
SMALL = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
CONFIG = PretrainConfig(steps=4, warmup=2, precision="float32", checkpoint_every=2, log_every=1)


def small_network(hand, **switches):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return HandNetwork(replace(SMALL, **switches), hand)


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
    config = replace(CONFIG, steps=80, warmup=5, learning_rate=2e-3)
    trainer = PriorTrainer(small_network(hand, width=32, head_width=32, image_size=64), config, ALONE)
    test = PaintedHands(hand, hands=2, targets=2, size=48).batch(10**6)
    with torch.no_grad():
        before = trainer.evaluate(test)
    for batch in islice(source(0, 0, 1), config.steps):
        trainer.advance(batch)
    with torch.no_grad():
        after = trainer.evaluate(test)
    assert float(after.metrics["psnr"]) > float(before.metrics["psnr"]) + 0.5
    assert float(after.loss) < 0.95 * float(before.loss)


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
