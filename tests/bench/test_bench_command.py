"""`oasis bench`, and its rows: files, tables and pictures of them."""

import csv
import io
import json
import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from gpu_rows import FRAME, GPU, KERNELS, PEER, POINT, SPEED, STUDY

from oasis_warp.bench import error_time, knobs, roofline, rows, scaling, speed, tables
from oasis_warp.bench.error_time import SettingRow
from oasis_warp.bench.rows import csv_text, from_record, json_text, keys, read_json, to_record, write_rows
from oasis_warp.bench.scenes import layered
from oasis_warp.bench.speed import GpuRow, SpeedRow
from oasis_warp.cli import main
from oasis_warp.core.errors import InputError


@pytest.fixture
def short(monkeypatch, small):
    """A plan of one small scene and few settings."""
    monkeypatch.setattr(error_time, "standard_plan", lambda *_: ((small, "rasterization"),))
    few = partial(error_time.Sweep, settings=lambda *_: (knobs.DEFAULT, knobs.FLOAT64))
    monkeypatch.setattr(error_time, "Sweep", few)


@pytest.mark.slow
def test_error_time_writes_tables_and_says_that_plots_need_matplotlib(short, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    assert main(["bench", "error-time", "-o", str(tmp_path / "out"), "--repeats", "2"]) == 0
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"error_time.csv", "error_time.json"}
    records = list(csv.DictReader((tmp_path / "out" / "error_time.csv").read_text().splitlines()))
    assert tuple(records[0]) == keys(error_time.SettingRow)
    assert [r["knob"] for r in records] == ["default", "default", "precision", "precision"]
    (command,) = {row["command"] for row in json.loads((tmp_path / "out" / "error_time.json").read_text())}
    assert command.startswith("oasis bench error-time -o ")
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

    monkeypatch.setattr(error_time, "measure_settings_of", interrupt)
    assert main(["bench", "error-time", "-o", str(tmp_path / "out"), "--repeats", "2"]) == 130
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.endswith("oasis: stopped, nothing was written.\n")


@pytest.mark.slow
def test_kernels_prints_a_table_and_writes_json(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(speed, "surfels", lambda n, size, seed: layered(n=n, size=size, seed=seed))
    file = tmp_path / "speed.json"
    table = tmp_path / "speed.csv"
    arguments = ["--repeats", "2", "--size", "16", "--gaussians", "200", "--only", "rasterization"]
    arguments += ["--json", str(file), "--csv", str(table)]
    assert main(["bench", "kernels", *arguments]) == 0
    records = json.loads(file.read_text())
    assert [(r["way"], r["gaussians"]) for r in records] == [("warp", 200), ("scalar", 200), ("torch", 200)] * 2
    assert [r["way"] for r in csv.DictReader(table.read_text().splitlines())] == [r["way"] for r in records]
    out = capsys.readouterr().out
    assert "/ yardstick" in out
    assert "torch" in out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["error-time", "-o", "/dev/null/folder"], "expected the folder"),
        (["error-time", "-o", "{}/o", "--repeats", "1"], "--repeats: expected 2 or more, got 1"),
        (["error-time", "-o", "{}/o", "--size", "30"], "--size: expected a multiple of 4 from 16 to 4096"),
        (["error-time", "-o", "{}/o", "--threads", "0"], "--threads: expected 1 to"),
        (["kernels", "--size", "5000"], "--size: expected 16 to 4096"),
        (["kernels", "--gaussians", "40000"], "--gaussians: expected 1 to 36881, as many as the hand has, got 40000"),
        (["kernels", "--json", "/dev/null/k.json"], "expected the folder"),
        (["kernels", "--csv", "/dev/null/k.csv"], "expected the folder"),
        (["kernels", "--plot", "{}/k.jpeg"], "k.jpeg: expected a name that ends in .png or .svg."),
        (["kernels", "--peer", "gsplat"], "--peer gsplat: it draws on CUDA devices only; add --device cuda."),
        (["kernels", "--only", "nothing"], "--only nothing: expected part of one of rasterization, blend_weights"),
        (["scaling", "-o", "/dev/null/folder"], "expected the folder"),
        (["scaling", "-o", "{}/o", "--seconds", "0"], "--seconds: expected more than 0, got 0."),
        (["scaling", "-o", "{}/o", "--threads", "0"], "--threads: expected 1 to"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_sentence(arguments, sentence, tmp_path, capsys):
    assert main(["bench", *(a.format(tmp_path) for a in arguments)]) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert captured.err.splitlines()[-1].startswith("oasis: ")
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("what", [["kernels"], ["scaling", "-o", "{}/o"], ["roofline"], ["error-time", "-o", "{}/o"]])
def test_a_gpu_that_is_not_there_is_told_in_one_sentence(monkeypatch, tmp_path, capsys, what):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["bench", *(a.format(tmp_path) for a in what), "--device", "cuda"]) == 2
    captured = capsys.readouterr()
    assert captured.err == (
        "oasis: --device cuda: torch finds no CUDA device; use --device cpu, or see `oasis doctor`.\n"
    )
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def gpu(monkeypatch):
    """A machine that says it has a GPU, where nothing is measured."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    asked = {}

    def measure(cases, device, **options):
        asked.update(options, cases=cases, device=device)
        return SPEED

    monkeypatch.setattr(speed, "measure_cases", measure)
    monkeypatch.setattr(roofline, "measure_roofline", lambda *_: KERNELS)
    return asked


def test_kernels_on_a_gpu_are_its_own_cases_on_both_clocks(gpu, tmp_path, capsys):
    files = [tmp_path / name for name in ("k.json", "k.csv")]
    arguments = ["--device", "cuda", "--only", "12k", "--repeats", "9", "--json", str(files[0]), "--csv", str(files[1])]
    assert main(["bench", "kernels", *arguments]) == 0
    assert [case.name for case in gpu["cases"]] == ["12k at 256 x 256"] * 2 + ["12k at 256 x 256, recorded"] * 2
    assert (gpu["groups"], gpu["device"].type, gpu["peers"]) == (9, "cuda", {})
    records = json.loads(files[0].read_text())
    assert [r["way"] for r in records] == ["warp", "gsplat", "warp"]
    assert records[0]["busy_ms"] == GPU.busy_ms
    assert records[1]["busy_ms"] is None
    assert len(files[1].read_text().splitlines()) == 4
    captured = capsys.readouterr()
    assert "37k at 512 x 512" in captured.out
    assert "avatar at 512 x 512, pose + draw: no graph could hold it: operation not permitted" in captured.err
    assert captured.err.count("no graph could hold it") == 1  # nobody tried gsplat


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--size", "512"], "--size: with --device cuda every case has its own; leave it out, or see --only."),
        (["--gaussians", "100"], "--gaussians: with --device cuda every case has its own"),
        (["--only", "nothing"], "--only nothing: expected part of one of 37k at 512 x 512, 12k at 256 x 256"),
        (["--repeats", "1"], "--repeats: expected 2 or more, got 1"),
        (["--peer", "gsplat"], "--peer gsplat: the package is not installed; `pip install gsplat` brings it."),
        (["--json", "/dev/null/k.json"], "expected the folder"),
    ],
)
def test_what_cannot_be_measured_on_a_gpu_is_refused_in_one_sentence(
    gpu, monkeypatch, arguments, sentence, tmp_path, capsys
):
    monkeypatch.setattr(speed, "find_spec", lambda name: None)
    assert main(["bench", "kernels", "--device", "cuda", *(a.format(tmp_path) for a in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("oasis: ")
    assert sentence in captured.err
    assert captured.out == ""
    assert gpu == {}


def test_a_plot_without_matplotlib_is_refused_before_anything_is_measured(gpu, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    assert main(["bench", "roofline", "--plot", str(tmp_path / "r.png")]) == 2
    assert capsys.readouterr().err.startswith("oasis: --plot: matplotlib is not installed")
    assert list(tmp_path.iterdir()) == []


def test_the_roofline_is_told_for_every_kernel(gpu, tmp_path, capsys):
    assert main(["bench", "roofline", "--json", str(tmp_path / "r.json")]) == 0
    out = capsys.readouterr().out
    assert "Ceilings measured: 4,250 GB/s, 50,000 GFLOP/s" in out
    assert "blend_tiles_backward_3" in out
    assert "20%" in out
    assert len(json.loads((tmp_path / "r.json").read_text())) == len(KERNELS)


def test_a_profiler_that_sees_nothing_is_told_in_one_sentence(gpu, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(roofline, "measure_roofline", lambda *_: [])
    assert main(["bench", "roofline", "--json", str(tmp_path / "r.json")]) == 2
    assert "torch's profiler traces no kernels here" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_scaling_writes_its_tables_and_tells_the_steepest_steps(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    asked = {}
    monkeypatch.setattr(scaling, "measure_scaling", lambda points, device, **options: asked.update(options) or STUDY)
    assert main(["bench", "scaling", "--quick", "-o", str(tmp_path / "out"), "--seed", "3"]) == 0
    assert (asked["seconds"], asked["seed"]) == (1.0, 3)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"scaling.csv", "scaling.json"}
    captured = capsys.readouterr()
    assert "(cliff)" in captured.out
    assert "matplotlib is not installed" in captured.err


def test_scaling_and_kernels_draw_what_they_measured(gpu, monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(scaling, "measure_scaling", lambda points, device, **options: STUDY)
    assert main(["bench", "scaling", "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "scaling.png").exists()
    for what in ("kernels", "roofline"):
        assert main(["bench", what, "--device", "cuda", "--plot", str(tmp_path / f"{what}.svg")]) == 0
    assert FRAME.case in (tmp_path / "kernels.svg").read_text()
    assert {p.name for p in tmp_path.iterdir()} == {"out", "kernels.svg", "roofline.svg"}


ROW = SettingRow(
    scene="layered", width=64, height=64, gaussians=1500, faces=None, op="rasterization", pass_="forward",
    knob="stop", value="0.01", device="a CPU, with a comma", threads=1, median_ms=1.25, iqr_ms=0.5, fastest_ms=1.0,
    repeats=20, first_ms=300.0, cpu_ms=1.0, yardstick_ms=11.6, peak_mb=None, rel_l2=1e-2, max_abs=0.1, psnr_db=45.5,
    gradient_rel_l2=None, floor_rel_l2=2e-7, fragile_percent=3.9, bit_equal=False, seed=0, commit="abc",
    versions="oasis_warp 0",
)  # fmt: skip
KEYS = keys(ROW)


def test_csv_and_json_have_the_same_keys_and_values():
    table = [ROW, replace(ROW, pass_="forward + backward", gradient_rel_l2=3e-2, bit_equal=True)]
    from_csv = list(csv.DictReader(io.StringIO(csv_text(table))))
    from_json = json.loads(json_text(table))
    assert [tuple(record) for record in from_csv] == [tuple(record) for record in from_json] == [KEYS] * 2
    for text, value in zip(from_csv, from_json, strict=True):
        for key in KEYS:
            one = value[key]
            words = {True: "yes", False: "no"} if isinstance(one, bool) else {None: ""}
            assert text[key] == words.get(one, str(one))


def test_the_keys_are_those_that_were_promised():
    promised = {
        "scene", "width", "height", "gaussians", "faces", "op", "pass", "knob", "value", "device", "threads",
        "median_ms", "iqr_ms", "repeats", "first_ms", "peak_mb", "rel_l2", "max_abs", "psnr_db", "gradient_rel_l2",
        "fragile_percent", "bit_equal", "seed", "commit", "versions",
    }  # fmt: skip
    assert promised <= set(KEYS)


def test_tables_are_read_back_as_they_were_written(tmp_path):
    table = [ROW, replace(ROW, bit_equal=True, peak_mb=1.5, psnr_db=None)]
    write_rows(table, tmp_path / "t.csv", tmp_path / "t.json")
    assert read_json(SettingRow, tmp_path / "t.json") == table
    for row in (GPU, PEER, POINT, KERNELS[1]):
        assert from_record(type(row), json.loads(json.dumps(to_record(row)))) == row
    (tmp_path / "rows.json").write_text(json_text(SPEED))
    assert read_json(GpuRow, tmp_path / "rows.json") == SPEED
    assert len(csv_text(SPEED).splitlines()) == 4


def test_what_is_not_finite_is_empty():
    infinite = replace(ROW, psnr_db=math.inf, gradient_rel_l2=math.nan)
    assert json.loads(json_text([infinite]))[0]["psnr_db"] is None
    assert ",nan," not in csv_text([infinite])


@pytest.mark.parametrize("text", [None, "", "[1]", '[{"case": "a"}]'])
def test_another_file_than_rows_is_refused_in_one_sentence(tmp_path, text):
    if text is not None:
        (tmp_path / "rows.json").write_text(text)
    with pytest.raises(InputError, match=r"rows\.json: expected (a JSON file|the rows of a GpuRow)"):
        read_json(GpuRow, tmp_path / "rows.json")


def test_the_commit_is_that_of_the_checkout(monkeypatch, tmp_path):
    assert rows.commit() == "" or len(rows.commit().rstrip("+")) == 10
    monkeypatch.setattr(rows, "__file__", str(tmp_path / "rows.py"))
    assert rows.commit() == ""  # outside of any checkout


OPERATOR = SpeedRow(
    op="skin", pass_="forward", way="torch", scene="hand", gaussians=10, faces=None, width=64, height=64,
    device="a CPU", threads=1, median_ms=2.5, iqr_ms=0.1, fastest_ms=2.0, cpu_ms=2.0, first_ms=9.0, repeats=5,
    peak_mb=None, over_yardstick=0.2, over_warp=3.0, rel_l2=1e-7, gradient_rel_l2=None, seed=0, commit="", versions="",
)  # fmt: skip


@pytest.mark.parametrize(
    ("axis", "amount", "name"),
    [("gaussians", 1_000, "1k"), ("gaussians", 3_162_278, "3.16M"), ("gaussians", 10**7, "10M"),
     ("pixels", 512**2, "512²"), ("views", 64, "64")],
)  # fmt: skip
def test_amounts_are_written_short(axis, amount, name):
    assert tables.amount_name(axis, amount) == name


def test_pictures_appear_whole_and_nothing_else(tmp_path):
    pytest.importorskip("matplotlib")
    for name, plot, shown in (
        ("speed", tables.plot_speed, SPEED), ("operators", tables.plot_speed, [OPERATOR]),
        ("scaling", tables.plot_scaling, STUDY), ("roofline", tables.plot_roofline, KERNELS),
    ):  # fmt: skip
        plot(shown, tmp_path / f"{name}.png")
        plot(shown, tmp_path / f"{name}.svg")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 8
    words = {name: (tmp_path / f"{name}.svg").read_text() for name in ("speed", "scaling", "roofline")}
    assert all(word in words["speed"] for word in ("37k at 512 x 512", "gsplat, wall", "warp, GPU", "0.25"))
    assert all(word in words["scaling"] for word in ("ns a Gaussian", "us a view", "256²"))
    assert "blend_tiles_backward_3" in words["roofline"]
    assert "vectorized_elementwise_kernel" not in words["roofline"]  # nothing is known of it


def test_a_picture_that_is_interrupted_leaves_the_old_one(monkeypatch, tmp_path):
    figure = pytest.importorskip("matplotlib.figure")

    def interrupt(self, part, **_):
        part.write_bytes(b"half of it")
        raise KeyboardInterrupt

    (tmp_path / "scaling.png").write_bytes(b"old")
    monkeypatch.setattr(figure.Figure, "savefig", interrupt)
    with pytest.raises(KeyboardInterrupt):
        tables.plot_scaling(STUDY, tmp_path / "scaling.png")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
