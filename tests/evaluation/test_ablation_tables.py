"""Tables of ablations, the page that shows them, and the tools that train and adapt without one part."""

import argparse
import copy
import json
import sys
from dataclasses import replace

import ablate_one_shot
import ablate_prior
import probe_prior
import pytest
import torch
import write_evaluation
from safetensors.torch import load_file

from oasis_warp.evaluation.ablation import COLUMNS, ablation_table, as_markdown, heading
from oasis_warp.evaluation.methods import METHODS, Method
from oasis_warp.evaluation.metrics import MEASURES
from oasis_warp.evaluation.summary import summarise
from oasis_warp.network.config import COMPACT, PROFILES
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import save_network
from oasis_warp.pretraining.pretrain import CHECKPOINT, WEIGHTS

TINY = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
VARIANTS = {"full": ("full model", Method("full", "raw")), "less": ("w/o a part", Method("less", "raw"))}


def picture(method, person, target, psnr, light="studio", colors="raw", noise=1.0):
    return {
        "group": "ordinary", "light": light, "noise": noise, "colors": colors, "person": person, "target": target,
        **method._asdict(), **dict.fromkeys(MEASURES, 0.5), "lpips": None, "psnr": psnr,
    }  # fmt: skip


@pytest.fixture
def tables():
    full, less = (method for _, method in VARIANTS.values())
    records = [
        picture(full, 1, 0, 24.0), picture(full, 1, 1, 26.0), picture(full, 2, 0, 30.0),
        picture(less, 1, 0, 23.0), picture(less, 1, 1, 25.0), picture(less, 2, 0, 27.0),
        picture(full, 1, 0, 99.0, light="wild"), picture(full, 1, 0, 20.0, light="wild", colors="matched"),
    ]  # fmt: skip
    return {
        light: ablation_table(records, light, colors, "raw", VARIANTS, "full")
        for light, colors in (("studio", "raw"), ("wild", "matched"))
    }


def test_a_part_is_worth_what_is_lost_without_it_on_the_same_pictures(tables):
    full, less = tables["studio"]["rows"]
    assert full["psnr"] == pytest.approx(80 / 3) and full["people"] == 2
    assert less["change"]["psnr"] == {"mean": -2.0, "error": pytest.approx(1.0), "better": 0.0}
    assert less["change"]["psnr_hidden"]["mean"] == 0
    assert less["change"]["lpips"] is None


def test_what_is_gained_everywhere_is_no_gain_of_one_part():
    (_, full), (_, less) = VARIANTS.values()
    records = [
        picture(full, person, 0, 20.0) | {"psnr_hidden": 20.0 + person, "psnr_visible": 25.0, "psnr_stretched": None}
        for person in (1, 2)
    ] + [
        picture(less, person, 0, 19.0) | {"psnr_hidden": 18.0 + person, "psnr_visible": 24.0} for person in (1, 2)
    ]  # fmt: skip
    full, less = ablation_table(records, "studio", "raw", "raw", VARIANTS, "full")["rows"]
    assert full["hidden_more"] == pytest.approx(-3.5) and full["stretched_more"] is None
    assert less["change"]["hidden_more"] == {"mean": -1.0, "error": 0.0, "better": 0.0}
    assert less["change"]["psnr_hidden"]["mean"] == -2 and less["change"]["stretched_more"] is None


def test_a_table_is_of_one_light_and_says_so(tables):
    (full,) = tables["wild"]["rows"]
    assert full["psnr"] == 20
    assert heading(tables["wild"]).endswith("targets in even light, colours matched; raw, 1 people")
    assert heading(tables["studio"]) == "Photo and targets in even light; raw, 2 people"


def test_a_table_shows_differences_and_leaves_out_what_was_not_measured(tables):
    names, _, full, less = as_markdown(tables["studio"]).splitlines()
    assert names.count("|") == 2 + len(COLUMNS) - 1 and "LPIPS" not in names
    assert full.startswith("| full model | 26.67 |")
    assert less.startswith("| w/o a part | -2.00 ± 1.00 | +0.00 ± 0.00 |")


def test_the_page_is_filled_with_what_is_there(tables, tmp_path):
    methods = [method for method in METHODS if method.prior == "mean"]
    records = [
        picture(method, person, 0, 20.0 + k, light, colors, noise)
        for k, method in enumerate(methods) for person in (1, 2) for light in ("studio", "wild")
        for colors in ("raw", "matched") for noise in (0.0, 1.0, 2.0)
    ]  # fmt: skip
    settings = {
        "groups": ["ordinary"], "lights": ["studio", "wild"], "noise": [0.0, 1.0], "curve": [2.0], "people": 2,
        "shoot": {"targets": 1, "size": 64}, "priors": {"mean": None}, "lpips": False,
    }  # fmt: skip
    (tmp_path / "evaluation").mkdir()
    found = {"settings": settings, "summary": summarise(records)}
    (tmp_path / "evaluation" / "metrics.json").write_text(json.dumps(found))
    (tmp_path / "ablation").mkdir()
    made = {"settings": {"steps": 7}, "tables": [tables["studio"]]}
    (tmp_path / "ablation" / "ablation.json").write_text(json.dumps(made))
    page = "".join(f"before\n<!-- {name} -->\nold\n<!-- end of {name} -->\n" for name in write_evaluation.SECTIONS)
    filled = write_evaluation.fill(page, tmp_path)
    assert filled.count("old") == 4 and filled.count("before") == 7  # same-hand, probe, one-shot and curve have no file
    assert "| mean one-shot | true pose | 21.00 | +1.00 | 0.00 | 100% |" in filled
    assert "| method | true pose | estimated | errors x 2 |" in filled
    assert "| mean calibrated | 20.00 | 20.00 | 20.00 |" in filled
    assert "| w/o a part | -2.00 ± 1.00 |" in filled and "Settings: steps 7." in filled
    assert write_evaluation.fill(filled, tmp_path) == filled


def test_a_probe_changes_its_part_alone(hand):
    network = HandNetwork(TINY, hand)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter)
    before = {name: value.clone() for name, value in network.named_parameters()}
    touched = {
        "full": set(), "no_bias": {"fusion.log_beta"}, "twice": {"fusion.log_beta"},
        "mixing": {"feature_on_mesh.logits"}, "places": {"face_head.last.weight", "face_head.last.bias"},
        "colors": {"face_head.last.weight", "face_head.last.bias"},
    }  # fmt: skip
    assert list(touched) == list(probe_prior.PROBES)
    for name, probe in probe_prior.PROBES.items():
        changed = copy.deepcopy(network)
        probe.change(changed)
        after = dict(changed.named_parameters())
        assert {key for key, value in before.items() if not torch.equal(value, after[key])} == touched[name]
        still = (after["face_head.last.weight"] == 0).all(1).sum()
        assert int(still) == {"places": 3, "colors": 3}.get(name, 0)


def run(monkeypatch, tool, *arguments):
    monkeypatch.setitem(PROFILES, "compact", TINY)
    monkeypatch.setattr(sys, "argv", ["tool", *map(str, arguments)])
    tool.main()


def test_networks_are_trained_with_and_without_point_evidence():
    options = argparse.Namespace(profile="compact", evidence="both")
    names = ablate_prior.networks_of(options)
    assert len(names) == len(set(names)) == 2 * len(ablate_prior.VARIANTS)
    configs = [ablate_prior.config_of(name, options) for name in names]
    assert [config.point_evidence for config in configs] == ["off"] * 9 + ["on"] * 9
    assert len(set(configs)) == len(configs) and configs[9] == COMPACT
    without, having = (ablate_prior.rows_of(names, end) for end in ("", ablate_prior.WITH))
    assert list(without.values())[0::9] == ["full model", "with point evidence"] and len(having) == 9
    assert set(without) | set(having) == set(names)


@pytest.mark.slow
def test_variants_are_trained_alike_and_go_on_where_they_were_stopped(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ablate_prior, "VARIANTS", {k: ablate_prior.VARIANTS[k] for k in ("full", "no_bias", "vet_off")})
    monkeypatch.setattr(ablate_prior, "CHECKPOINT_EVERY", 1)
    few = ("--steps", 3, "--hands", 1, "--people", 1, "--views", 1, "--size", 32, "--device", "cpu", "--workers", 0,
           "--precision", "float32", "--held-out", 1, "--evidence", "off")  # fmt: skip
    run(monkeypatch, ablate_prior, tmp_path / "whole", *few)
    said = capsys.readouterr().out
    assert "w/o bias" in said and "full model" in said
    tables = json.loads((tmp_path / "whole" / "ablation.json").read_text())["tables"]
    kinds = [(table["light"], table["colors"], len(table["rows"])) for table in tables]
    assert kinds == [("studio", "raw", 3), ("studio", "matched", 3), ("wild", "matched", 3)]

    advance = ablate_prior.Trainer.advance

    def until_stopped(trainer, batch):
        if trainer.step == 2 and trainer.network.config.vet == "off":
            raise KeyboardInterrupt
        return advance(trainer, batch)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ablate_prior.Trainer, "advance", until_stopped)
        run(monkeypatch, ablate_prior, tmp_path / "parts", *few, "--only", "full,vet_off")
    run(monkeypatch, ablate_prior, tmp_path / "parts", *few, "--only", "no_bias", "--minutes", 0)
    assert "the same command goes on" in capsys.readouterr().err
    assert (tmp_path / "parts" / "no_bias" / CHECKPOINT).exists()
    assert not (tmp_path / "parts" / "no_bias" / WEIGHTS).exists()
    run(monkeypatch, ablate_prior, tmp_path / "parts", *few, "--only", "vet_off")
    run(monkeypatch, ablate_prior, tmp_path / "parts", *few, "--only", "full,no_bias")
    for name in ablate_prior.VARIANTS:
        ours, theirs = (load_file(tmp_path / folder / name / CHECKPOINT) for folder in ("whole", "parts"))
        assert all(torch.equal(ours[key], theirs[key]) for key in ours), name
        assert (tmp_path / "parts" / name / WEIGHTS).exists()


@pytest.mark.slow
def test_adaptation_is_measured_without_its_parts(tmp_path, monkeypatch, capsys, hand):
    assert ablate_one_shot.TITLES.keys() == ablate_one_shot.SETTINGS.keys() | {"prior"}
    shown = ("full", "prior", "light")
    monkeypatch.setattr(ablate_one_shot, "TITLES", {name: ablate_one_shot.TITLES[name] for name in shown})
    monkeypatch.setattr(
        ablate_one_shot, "SETTINGS",
        {
            name: replace(made, texture_steps=1, calibration_steps=1)
            for name, made in ablate_one_shot.SETTINGS.items() if name in shown
        },
    )  # fmt: skip
    save_network(tmp_path / "network.safetensors", HandNetwork(TINY, hand))
    options = ("--prior", tmp_path / "network.safetensors", "--people", 1, "--device", "cpu")
    run(monkeypatch, ablate_one_shot, tmp_path / "out", *options)
    said = capsys.readouterr().out
    assert all(title in said for title in ablate_one_shot.TITLES.values())
    tables = json.loads((tmp_path / "out" / "ablation.json").read_text())["tables"]
    assert [table["light"] for table in tables] == ["same", "studio", "wild"]
    for table in tables:
        assert [row["variant"] for row in table["rows"]] == list(ablate_one_shot.TITLES)
