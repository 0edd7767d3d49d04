"""studies/write_model_card.py: numbers go where they belong, and nowhere else."""

import json
from dataclasses import replace

import pytest
import write_model_card
from write_model_card import (
    METHODS,
    SECTIONS,
    file_table,
    gaussian_table,
    measurement_tables,
    photo_table,
    put,
    speed_table,
    training_text,
)

from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, save_network

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


def test_measurements_are_those_with_estimated_poses_and_matched_colours(tmp_path):
    rows = [row(method, psnr=20.0 + number) for number, method in enumerate(METHODS)]
    others = [row(("learned", "raw"), psnr=99.0, **other) for other in ({"noise": 0.0}, {"colors": "raw"})]
    (tmp_path / "metrics.json").write_text(json.dumps({"summary": rows + others}))
    text = measurement_tables(tmp_path / "metrics.json")
    assert "4 people, 16 pictures" in text and "99" not in text
    assert "| the prior, one-shot | 26.00 | +3.25 | 0.50 | 75% | 21.00 |  | 0.9000 |" in text
    assert text.count("| no prior") == 2


def test_speed_names_the_device(tmp_path):
    found = {"device": "CPU, 2 threads", "torch": "2.9", "load_cpu_seconds": 0.5, "encode_seconds_fastest": 0.6,
             "encode_seconds_median": 0.7, "encode_cpu_seconds_fastest": 0.55, "grown_gib": 0.3,
             "device_gib": None}  # fmt: skip
    (tmp_path / "cpu.json").write_text(json.dumps(found))
    line = "| CPU, 2 threads | 0.50 s | 600.0 ms | 700.0 ms | 550.0 ms | 0.30 GiB | 2.9 |"
    assert line in speed_table([tmp_path / "cpu.json"])


def test_an_untrained_prior_has_the_gaussians_of_the_mean_hand(weights, hand):
    lines = gaussian_table(load_network(weights, hand).eval(), 1).splitlines()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines}
    assert [float(cell) for cell in rows["on vertices: opacity"]] == [0.95] * 3
    assert [float(cell) for cell in rows["on vertices: under the skin, mm"]] == [0.8] * 3
    assert [float(cell) for cell in rows["on faces: from the middle of the face, mm"]] == [0.0] * 3
    assert [float(cell) for cell in rows["on faces: largest share of a corner in a face's features"]] == [0.33] * 3
    low, middle, high = (float(cell) for cell in rows["on faces: largest deviation, mm"])
    assert 0.1 < low < middle < high < 2


def test_real_photos_are_compared_where_both_priors_made_an_avatar(tmp_path):
    heading = "photo,result,input_psnr_db,coverage_worst,render_mask_iou\n"
    (tmp_path / "none.csv").write_text(heading + "a,ok,30,1,0.9\nb,ok,34,0.98,0.94\nc,ok,99,1,1\n")
    (tmp_path / "learned.csv").write_text(heading + "a,ok,31,1,0.92\nb,ok,32,1,0.96\nc,found no hand,,,\n")
    text = photo_table(tmp_path / "none.csv", tmp_path / "learned.csv")
    assert "| no prior | 32.0 | 0.990 | 0.920 |" in text and "| the prior | 31.5 | 1.000 | 0.940 |" in text
    assert text.endswith("2 photos, medians.")


def test_a_section_is_replaced_and_the_prose_stays():
    page = "".join(f"prose {name}\n<!-- {name} -->\nold\n<!-- end of {name} -->\n" for name in SECTIONS)
    once = put(page, "training", "new")
    assert once == page.replace("<!-- training -->\nold", "<!-- training -->\nnew")
    assert put(once, "training", "new") == once
    with pytest.raises(SystemExit, match="expected <!-- speed --> and <!-- end of speed --> in the page"):
        put("no markers", "speed", "text")


def test_the_card_has_every_section():
    card = (write_model_card.Path(__file__).parents[1] / "docs" / "prior.md").read_text()
    assert all(put(card, name, "x") for name in SECTIONS)
