"""Tables of ablations and of the kernels' pages, and studies that train and adapt without one part."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from gpu_rows import KERNELS, SPEED, STUDY
from pretraining.painted_hands import PaintedHands

from oasis_warp.bench import tables as bench_tables
from oasis_warp.bench.rows import json_text
from oasis_warp.core.config import PAPER_ADAPTATION
from oasis_warp.evaluation.methods import Method
from oasis_warp.evaluation.metrics import MEASURES
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import COMPACT, PAPER, PROFILES
from oasis_warp.network.encoders import SIZES, Size
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import save_network
from studies import kernels, network_parts, paper_profile, parts
from studies.__main__ import render
from studies.harness import ROWS, read_rows
from studies.paper_profile import Options, run
from studies.parts import COLUMNS, ablation_rows, ablation_text, heading

TINY = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
VARIANTS = {"full": ("full model", Method("full", "raw")), "less": ("w/o a part", Method("less", "raw"))}
TINY_PAPER = replace(
    PAPER, backbone="dinov2-small", image_size=28, width=16, heads=2, n_tokens=8, n_coarse=64, head_width=8
)


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
        light: ablation_rows(records, light, colors, "raw", VARIANTS, "full")
        for light, colors in (("studio", "raw"), ("wild", "matched"))
    }


def test_a_part_is_worth_what_is_lost_without_it_on_the_same_pictures(tables):
    full, less = tables["studio"]
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
    full, less = ablation_rows(records, "studio", "raw", "raw", VARIANTS, "full")
    assert full["hidden_more"] == pytest.approx(-3.5) and full["stretched_more"] is None
    assert less["change"]["hidden_more"] == {"mean": -1.0, "error": 0.0, "better": 0.0}
    assert less["change"]["psnr_hidden"]["mean"] == -2 and less["change"]["stretched_more"] is None


def test_a_table_is_of_one_light_and_says_so(tables):
    (full,) = tables["wild"]
    assert full["psnr"] == 20
    assert heading(full).endswith("targets in even light, colours matched; raw, 1 people")
    assert heading(tables["studio"][0]) == "Photo and targets in even light; raw, 2 people"


def test_a_table_shows_differences_and_leaves_out_what_was_not_measured(tables):
    _, _, names, _, full, less = (ablation_text(tables["studio"]) or "").splitlines()
    assert names.count("|") == 2 + len(COLUMNS) - 1 and "LPIPS" not in names
    assert full.startswith("| full model | 26.67 |")
    assert less.startswith("| w/o a part | -2.00 ± 1.00 | +0.00 ± 0.00 |")


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setitem(PROFILES, "compact", TINY)


def test_every_variant_is_another_network(tiny):
    options = network_parts.Options()
    configs = [network_parts.network_config(name, options) for name in network_parts.VARIANTS]
    assert len(set(configs)) == len(configs) and configs[0] == replace(TINY, point_evidence="off")


@pytest.mark.slow
def test_variants_are_trained_on_the_same_batches_until_time_is_up_and_then_evaluated(
    tiny, tmp_path, monkeypatch, capsys
):
    few = {name: network_parts.VARIANTS[name] for name in ("full", "vet_off")}
    monkeypatch.setattr(network_parts, "VARIANTS", few)
    met, advance = [], network_parts.PriorTrainer.advance
    monkeypatch.setattr(
        network_parts.PriorTrainer, "advance", lambda self, batch: (met.append(batch.image), advance(self, batch))[1]
    )
    options = network_parts.Options(
        steps=2, hands=1, people=1, views=1, size=32, precision="float32", held_out=1, targets=1,
        out=tmp_path,
    )  # fmt: skip
    assert network_parts.run(replace(options, only=("vet_off",))) == []
    assert network_parts.run(replace(options, minutes=0)) == []
    assert "the same command continues" in capsys.readouterr().err and len(met) == 3
    rows = network_parts.run(options)
    assert len(met) == 4 and torch.equal(met[0], met[2]) and torch.equal(met[1], met[3])
    kinds = dict.fromkeys((row["light"], row["colors"]) for row in rows)
    assert list(kinds) == [("studio", "raw"), ("studio", "matched"), ("wild", "matched")] and len(rows) == 6
    text = ablation_text(rows) or ""
    assert "w/o VETs" in text and "full model" in text and "Settings: " in text


@pytest.mark.slow
def test_adaptation_is_measured_without_its_parts(tiny, tmp_path, monkeypatch, hand):
    assert parts.TITLES.keys() == parts.ADAPTATIONS.keys() | {"prior"}
    shown = ("full", "prior", "light")
    monkeypatch.setattr(parts, "TITLES", {name: parts.TITLES[name] for name in shown})
    few = {
        name: replace(made, texture_steps=1, calibration_steps=1)
        for name, made in parts.ADAPTATIONS.items() if name in shown
    }  # fmt: skip
    monkeypatch.setattr(parts, "ADAPTATIONS", few)
    save_network(tmp_path / "network.safetensors", HandNetwork(TINY, hand))
    weights = str(tmp_path / "network.safetensors")
    rows = parts.run(parts.Options(prior=weights, people=1, targets=1, size=64, out=tmp_path / "out"))
    assert read_rows(tmp_path / "out" / "parts" / ROWS) == rows
    assert list(dict.fromkeys(row["light"] for row in rows)) == ["same", "studio", "wild"]
    assert [row["variant"] for row in rows] == 3 * list(parts.TITLES)
    (one_shot,) = parts.SECTIONS
    assert all(title in (one_shot.text(rows) or "") for title in parts.TITLES.values())


DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def out(tmp_path):
    (tmp_path / "gpu").mkdir()
    (tmp_path / "gpu" / "kernels.json").write_text(json_text(SPEED))
    (tmp_path / "gpu" / "scaling.json").write_text(json_text(STUDY))
    (tmp_path / "gpu" / "roofline.json").write_text(json_text(KERNELS))
    return tmp_path


@pytest.fixture
def docs(tmp_path):
    folder = tmp_path / "docs"
    (folder / "_static").mkdir(parents=True)
    for name in ("gpu.md", "kernels.md"):
        shutil.copy(DOCS / name, folder)
    return folder


def test_every_table_of_the_page_is_filled(out, docs):
    pytest.importorskip("matplotlib")
    render(["kernels"], out, docs, out / "kept")
    text = (docs / "gpu.md").read_text()
    assert "Not measured yet." not in text
    assert "| 37k at 512 x 512 | forward + backward | 0.25 | 0.1 | 0.11 |" in text
    assert "No graph holds avatar at 512 x 512, pose + draw: operation not permitted" in text
    assert "Cliffs: 512 x 512, forward; 512 x 512, forward + backward." in text
    assert "`blend_tiles_backward_3` | 1 | 50 |" in text
    assert "Memset" not in text  # a thousandth of the time, and no formula
    pictures = {p.name for p in (docs / "_static").iterdir()}
    assert pictures == {"gpu_kernels.png", "gpu_scaling.png", "gpu_roofline.png"}
    assert all(f"(_static/{name})" in text for name in pictures)
    render(["kernels"], out, docs, out / "kept")
    assert (docs / "gpu.md").read_text() == text


def test_what_was_not_measured_stays_on_the_page(monkeypatch, out, docs):
    (out / "gpu" / "scaling.json").unlink()
    (out / "gpu" / "roofline.json").unlink()
    monkeypatch.setattr(kernels, "draw", lambda rows, static: None)
    part = re.compile(r"(<!-- (?!end of)[a-z]+ -->\n).*?(<!-- end)", re.DOTALL)
    blank = part.sub(r"\1Not measured yet.\n\2", (docs / "gpu.md").read_text())
    (docs / "gpu.md").write_text(blank)
    render(["kernels"], out, docs, out / "kept")
    assert blank.count("Not measured yet.") == 5
    assert (docs / "gpu.md").read_text().count("Not measured yet.") == 3


def test_without_matplotlib_no_picture_is_drawn(monkeypatch, out):
    monkeypatch.setattr(bench_tables, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="matplotlib is not installed"):
        kernels.draw(kernels.load(out), out)
    assert not list(out.glob("*.png"))


def test_no_step_is_called_a_cliff_where_none_is():
    calm = [replace(row, busy_ms=0.001 * row.amount) for row in STUDY]
    assert "No step is a cliff." in kernels.growth_text(calm)


def test_measuring_writes_what_the_page_is_written_from(monkeypatch, tmp_path):
    monkeypatch.setattr(kernels.scaling, "measure_scaling", lambda points, device, **_: STUDY)
    monkeypatch.setattr(kernels.scaling, "points", lambda quick: [])
    (row,) = kernels.measure_gpu(kernels.Options(out=tmp_path, parts=("scaling",)))
    assert {p.name for p in (tmp_path / "gpu").iterdir()} == {"scaling.json"}
    assert row == {"part": "scaling", "rows": STUDY}


def test_times_of_the_cpu_stand_beside_those_of_more_threads(tmp_path):
    ours = {"op": "skin", "pass": "forward", "way": "warp", "cpu_ms": 1.5, "fastest_ms": 1.0, "over_yardstick": 0.1,
            "rel_l2": 7e-8, "gradient_rel_l2": None, "threads": 1, "device": "a CPU", "versions": "v", "commit": "c",
            "gaussians": 20_000, "width": 256, "height": 256, "repeats": 30}  # fmt: skip
    peer = {**ours, "way": "torch", "over_warp": 3.7}
    (tmp_path / "speed.json").write_text(json.dumps([ours, peer]))
    (tmp_path / "speed_threads.json").write_text(json.dumps([{**ours, "threads": 2}]))
    text = kernels.speed_text(kernels.load(tmp_path)) or ""
    assert "| `skin` | forward | 1.50 | 0.100 |  | 3.7x | 7e-8 |  | 1.00 |" in text and "ms, 2 threads" in text


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_papers_network_learns_people_by_heart_from_random_weights(monkeypatch, tmp_path):
    monkeypatch.setitem(PROFILES, "paper", TINY_PAPER)
    monkeypatch.setitem(SIZES, "dinov2-small", Size(32, 2, 2))
    made = lambda hands, options, planners=0: PaintedHands(bundled_hand(), hands, 1, options.size)(0, 0, 1)  # noqa: E731
    monkeypatch.setattr(paper_profile, "batches", made)  # people of the synthetic world take long to bake
    monkeypatch.setattr(paper_profile, "PEOPLE", 2)
    few = replace(PAPER_ADAPTATION, calibration_steps=2, texture_steps=20, reference_views=1)
    monkeypatch.setattr(paper_profile, "PAPER_ADAPTATION", few)
    options = Options(
        out=tmp_path, device="cpu", profiles=("paper",), hands=(1,), steps=6, learning_rate=0.02, warmup=1, timed=1,
        size=32, precision="float32", planners=0,
    )  # fmt: skip
    rows = run(options)
    first, last = (next(row for row in rows if row.get("step") == step) for step in (0, 6))
    assert last["psnr"] > first["psnr"] + 0.5 and last["loss"] < 0.95 * first["loss"]
    costs = [row for row in rows if row["kind"] == "cost"]
    assert [row["lpips"] for row in costs] == [False, True] and all(row["step_s"] > 0 for row in costs)
    adapted = next(row for row in rows if row["kind"] == "adaptation")
    assert adapted["steps"] == "2 + 20" and adapted["last"] < adapted["first"]
    assert all(section.text(rows) for section in paper_profile.SECTIONS)
