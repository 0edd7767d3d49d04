"""Rows of measurements: files, tables and pictures of them."""

import csv
import io
import json
import math
from dataclasses import replace

import pytest
from gpu_rows import GPU, KERNELS, PEER, POINT, SPEED, STUDY

from oasis_warp.bench import plots, rows
from oasis_warp.bench.error_time import SettingRow
from oasis_warp.bench.gpu_speed import GpuRow
from oasis_warp.bench.rows import csv_text, from_record, json_text, keys, read_json, to_record, write_rows
from oasis_warp.bench.speed import SpeedRow
from oasis_warp.core.errors import InputError

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
    assert plots.amount_name(axis, amount) == name


def test_pictures_appear_whole_and_nothing_else(tmp_path):
    pytest.importorskip("matplotlib")
    for name, plot, shown in (
        ("speed", plots.plot_speed, SPEED), ("operators", plots.plot_speed, [OPERATOR]),
        ("scaling", plots.plot_scaling, STUDY), ("roofline", plots.plot_roofline, KERNELS),
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
        plots.plot_scaling(STUDY, tmp_path / "scaling.png")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
