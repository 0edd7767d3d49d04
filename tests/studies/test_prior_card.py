"""What the prior's page is filled with: its file, its training and measurements of it."""

import json
from dataclasses import replace

import pytest

from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, save_network
from studies import photos, timing
from studies.evaluation import METHODS, measurements
from studies.prior_card import file_table, gaussian_table, training_text

NOTES = {
    "step": 1234, "steps": 2000, "hands": 16, "people": 512, "seed": 3, "precision": "bfloat16", "profile": "compact",
    "hold_out": ["tattoo", "ring"], "losses": {"rgb": 10.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def weights(hand, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "network.safetensors"
    small = replace(COMPACT, width=32, heads=2, n_tokens=16, n_coarse=64, refine_layers=1, head_width=16)
    save_network(path, HandNetwork(small, hand), notes=json.dumps(NOTES))
    return path


def row(method, **changes):
    about = {"group": "ordinary", "light": "wild", "noise": 1.0, "colors": "matched", "people": 4, "pictures": 16}
    found = {"psnr": 20.0, "psnr_visible": 21.0, "psnr_hidden": None, "ssim_mask": 0.9, "gain": 3.25, "better": 0.75,
             "gain_error": 0.5}  # fmt: skip
    return {**about, "prior": method[0], "stage": method[1], **found, **changes}


def test_the_file_and_its_training_are_told_from_its_header(weights):
    text = file_table(weights)
    assert "12,337 vertices, 24,608 faces" in text and "32 channels, 16 tokens" in text
    trained = training_text(weights)
    assert "| step | 1,234 |" in trained and "| losses | rgb 10.0 |" in trained
    command = "oasis pretrain prior --steps 2000 --hands 16 --people 512 --seed 3 --precision bf16 --profile compact"
    assert f"{command} --hold-out tattoo ring\n" in trained


def test_the_command_that_retrains_is_one_that_the_command_line_takes(weights):
    import tyro

    from oasis_warp.cli.options import Pretrain

    line = next(line for line in training_text(weights).splitlines() if line.startswith("oasis pretrain"))
    options = tyro.cli(Pretrain, args=line.split()[2:])
    assert (options.steps, options.seed, options.precision) == (2000, 3, "bf16")
    assert options.hold_out == ("tattoo", "ring")


def test_measurements_are_those_with_estimated_poses_and_matched_colours():
    rows = [row(method, psnr=20.0 + number) for number, method in enumerate(METHODS)]
    others = [row(("learned", "raw"), psnr=99.0, **other) for other in ({"noise": 0.0}, {"colors": "raw"})]
    text = measurements({"summary": rows + others})
    assert "4 people, 16 pictures" in text and "99" not in text
    assert "| the prior, one-shot | 26.00 | +3.25 | 0.50 | 75% | 21.00 |  | 0.9000 |" in text
    assert text.count("| no prior") == 2


def test_speed_names_the_device():
    row = {"case": "prior on cpu", "device": "CPU, 2 threads", "torch": "2.9", "load_s": 0.5, "fastest_ms": 600,
           "median_ms": 700, "cpu_ms": 550, "gib": 0.3}  # fmt: skip
    text = timing.SECTIONS[-1].text([row, {"case": "pictures on cpu", "stage": "room", "ms": 154.2}])
    assert "| CPU, 2 threads | 0.50 s | 600.0 ms | 700.0 ms | 550.0 ms | 0.30 GiB | 2.9 |" in (text or "")


def test_an_untrained_prior_has_the_gaussians_of_the_mean_hand(weights, hand):
    lines = gaussian_table(load_network(weights, hand).eval(), 1).splitlines()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines}
    assert [float(cell) for cell in rows["on vertices: opacity"]] == [0.95] * 3
    assert [float(cell) for cell in rows["on vertices: under the skin, mm"]] == [0.8] * 3
    assert [float(cell) for cell in rows["on faces: from the middle of the face, mm"]] == [0.0] * 3
    assert [float(cell) for cell in rows["on faces: largest share of a corner in a face's features"]] == [0.33] * 3
    low, middle, high = (float(cell) for cell in rows["on faces: largest deviation, mm"])
    assert 0.1 < low < middle < high < 2


def test_real_photos_are_compared_where_both_priors_made_an_avatar():
    def rows(prior, *found):
        return [
            {"photo": photo, "folder": "photos", "prior": prior, "result": "ok" if numbers else "found no hand",
             **dict(zip(("input_psnr_db", "coverage_worst", "render_mask_iou"), numbers, strict=False))}
            for photo, *numbers in found
        ]  # fmt: skip

    none = rows("none", ("a", 30, 1, 0.9), ("b", 34, 0.98, 0.94), ("c", 99, 1, 1))
    text = photos.SECTIONS[-1].text(none + rows("learned", ("a", 31, 1, 0.92), ("b", 32, 1, 0.96), ("c",))) or ""
    assert "| no prior | 32.0 | 0.990 | 0.920 |" in text and "| the prior | 31.5 | 1.000 | 0.940 |" in text
    assert text.endswith("2 photos, medians.")
    assert photos.SECTIONS[-1].text(none) is None
