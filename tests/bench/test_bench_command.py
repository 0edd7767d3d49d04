import csv
import json
from functools import partial

import pytest

from oasis_warp.bench import error_time, knobs, pareto, speed
from oasis_warp.bench.operators import OPERATORS
from oasis_warp.bench.rows import KEYS
from oasis_warp.bench.scenes import layered
from oasis_warp.cli import main


@pytest.fixture
def short(monkeypatch, small):
    """A plan of one small scene and few settings."""
    monkeypatch.setattr(error_time, "standard_plan", lambda *_: ((small, "rasterization"),))
    few = partial(error_time.Sweep, settings=lambda *_: (knobs.DEFAULT, knobs.FLOAT64))
    monkeypatch.setattr(error_time, "Sweep", few)


def test_error_time_writes_tables_and_says_that_plots_need_matplotlib(short, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(pareto, "find_spec", lambda name: None)
    assert main(["bench", "error-time", "-o", str(tmp_path / "out"), "--repeats", "2"]) == 0
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"error_time.csv", "error_time.json"}
    records = list(csv.DictReader((tmp_path / "out" / "error_time.csv").read_text().splitlines()))
    assert tuple(records[0]) == KEYS
    assert [r["knob"] for r in records] == ["default", "default", "precision", "precision"]
    captured = capsys.readouterr()
    assert captured.err.count("matplotlib is not installed") == 1
    assert "oasis-warp[bench]" in captured.err
    assert "rasterization on layered, forward" in captured.out
    assert "Fastest single knob within an error budget" in captured.out


def test_error_time_draws_a_picture_an_operator(short, tmp_path):
    pytest.importorskip("matplotlib")
    assert main(["bench", "error-time", "-o", str(tmp_path / "out"), "--repeats", "2"]) == 0
    assert (tmp_path / "out" / "rasterization.png").exists()


def test_an_interrupted_measurement_leaves_nothing(short, monkeypatch, tmp_path, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(error_time, "make_row", interrupt)
    assert main(["bench", "error-time", "-o", str(tmp_path / "out"), "--repeats", "2"]) == 130
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.endswith("oasis: stopped, nothing written.\n")


def test_kernels_prints_a_table_and_writes_json(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(speed, "OPERATORS", {"rasterization": OPERATORS["rasterization"]})
    monkeypatch.setattr(speed, "surfels", lambda n, size, seed: layered(n=n, size=size, seed=seed))
    file = tmp_path / "speed.json"
    arguments = ["--repeats", "2", "--size", "16", "--gaussians", "200", "--json", str(file)]
    assert main(["bench", "kernels", *arguments]) == 0
    records = json.loads(file.read_text())
    assert [(r["way"], r["gaussians"]) for r in records] == [("warp", 200), ("scalar", 200), ("torch", 200)] * 2
    out = capsys.readouterr().out
    assert "/ yardstick" in out
    assert "torch" in out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["error-time", "-o", "{}/no/folder"], "expected the folder"),
        (["error-time", "-o", "{}/o", "--repeats", "1"], "--repeats: expected 2 or more, got 1"),
        (["error-time", "-o", "{}/o", "--size", "30"], "--size: expected a multiple of 4 from 16 to 4096"),
        (["error-time", "-o", "{}/o", "--threads", "0"], "--threads: expected 1 to"),
        (["kernels", "--size", "5000"], "--size: expected 16 to 4096"),
        (["kernels", "--gaussians", "40000"], "--gaussians: expected 1 to 36881, as many as the hand has, got 40000"),
        (["kernels", "--json", "{}/no/k.json"], "expected the folder"),
        (["kernels", "--peer", "gsplat"], "--peer gsplat: "),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_sentence(arguments, sentence, tmp_path, capsys):
    assert main(["bench", *(a.format(tmp_path) for a in arguments)]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert captured.err.splitlines()[-1].startswith("oasis: ")
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []
