"""What the prior's page is filled with: its file, its training and measurements of it."""

import json
from dataclasses import replace

import pytest
import torch
from synthetic import crop_of

from oasis_warp.avatar.observation import batch_of_crop
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, save_network
from studies.prior_card import file_table, gaussian_table, training_text

NOTES = {
    "step": 1234, "steps": 2000, "hands": 16, "people": 512, "seed": 3, "precision": "bfloat16", "profile": "compact",
    "hold_out": ["tattoo", "ring"], "losses": {"rgb": 10.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def weights(hand, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "network.safetensors"
    small = replace(COMPACT, image_size=32, width=32, heads=2, n_tokens=16, n_coarse=64, refine_layers=1, head_width=16)
    save_network(path, HandNetwork(small, hand), notes=json.dumps(NOTES))
    return path


def test_the_file_and_its_training_are_told_from_its_header(weights):
    text = file_table(weights)
    assert "12,337 vertices, 24,608 faces" in text and "32 channels, 16 tokens" in text
    trained = training_text(weights)
    assert "| step | 1,234 |" in trained and "| losses | rgb 10.0 |" in trained
    command = "oasis pretrain prior --steps 2000 --hands 16 --people 512 --seed 3 --precision bf16 --profile compact"
    assert f"{command} --hold-out tattoo ring\n" in trained


def test_the_command_that_retrains_is_one_that_the_command_line_takes(weights):
    import tyro

    from oasis_warp.cli.developer_options import Pretrain

    line = next(line for line in training_text(weights).splitlines() if line.startswith("oasis pretrain"))
    options = tyro.cli(Pretrain, args=line.split()[2:])
    assert (options.steps, options.seed, options.precision) == (2000, 3, "bf16")
    assert options.hold_out == ("tattoo", "ring")


def test_an_untrained_prior_has_the_gaussians_of_the_mean_hand(weights, hand):
    crop, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=32)
    lines = gaussian_table(load_network(weights, hand).eval(), [batch_of_crop(crop)]).splitlines()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines}
    assert [float(cell) for cell in rows["on vertices: opacity"]] == [0.95] * 3
    assert [float(cell) for cell in rows["on vertices: under the skin, mm"]] == [0.8] * 3
    assert [float(cell) for cell in rows["on faces: from the middle of the face, mm"]] == [0.0] * 3
    assert [float(cell) for cell in rows["on faces: largest share of a corner in a face's features"]] == [0.33] * 3
    low, middle, high = (float(cell) for cell in rows["on faces: largest deviation, mm"])
    assert 0.1 < low < middle < high < 2
