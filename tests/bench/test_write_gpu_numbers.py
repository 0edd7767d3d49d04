import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import measure_gpu
import pytest
import write_gpu_numbers
from gpu_rows import FRAME, GPU, KERNELS, PEER, POINT, SPEED, STUDY

from oasis_warp.bench import pareto
from oasis_warp.bench.gpu_speed import GpuRow
from oasis_warp.bench.rows import csv_text, from_record, json_text, read_json, to_record
from oasis_warp.core.errors import InputError

PAGE = Path(__file__).parents[2] / "docs" / "gpu.md"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "kernels.json").write_text(json_text(SPEED))
    (tmp_path / "scaling.json").write_text(json_text(STUDY))
    (tmp_path / "roofline.json").write_text(json_text(KERNELS))
    return tmp_path


def write(monkeypatch, page, folder):
    monkeypatch.setattr(sys, "argv", ["write_gpu_numbers.py", str(page), str(folder)])
    write_gpu_numbers.main()


def test_rows_come_back_from_json_as_they_were(tmp_path):
    for row in (GPU, PEER, POINT, KERNELS[1]):
        assert from_record(type(row), json.loads(json.dumps(to_record(row)))) == row
    (tmp_path / "rows.json").write_text(json_text(SPEED))
    assert read_json(GpuRow, tmp_path / "rows.json") == SPEED
    assert len(csv_text(SPEED).splitlines()) == 4


@pytest.mark.parametrize("text", [None, "", "[1]", '[{"case": "a"}]'])
def test_another_file_than_rows_is_refused_in_one_sentence(tmp_path, text):
    if text is not None:
        (tmp_path / "rows.json").write_text(text)
    with pytest.raises(InputError, match=r"rows\.json: expected (a JSON file|the rows of a GpuRow)"):
        read_json(GpuRow, tmp_path / "rows.json")


def test_every_table_of_the_page_is_filled(monkeypatch, folder):
    pytest.importorskip("matplotlib")
    page = folder / "gpu.md"
    page.write_text(PAGE.read_text())
    (folder / "_static").mkdir()
    write(monkeypatch, page, folder)
    text = page.read_text()
    assert "Not measured yet." not in text
    assert "| 37k at 512 x 512 | forward + backward | 0.25 | 0.1 | 0.11 |" in text
    assert "No graph holds avatar at 512 x 512, pose + draw: operation not permitted" in text
    assert "| gsplat | 0.25 | 0.75 | 3.0x | 0.09 | 0.45 | 5.0x |" in text
    assert "Cliffs: 512 x 512, forward; 512 x 512, forward + backward." in text
    assert "`blend_tiles_backward_3` | 1 | 50 |" in text
    assert "Memset" not in text  # a thousandth of the time, and no formula
    assert "`gather_records_3` takes 8 of the 88.1 us" in text
    pictures = {p.name for p in (folder / "_static").iterdir()}
    assert pictures == {"gpu_kernels.png", "gpu_scaling.png", "gpu_roofline.png"}
    assert all(f"(_static/{name})" in text for name in pictures)
    write(monkeypatch, page, folder)
    assert page.read_text() == text


def test_what_was_not_measured_stays_on_the_page(monkeypatch, folder):
    (folder / "scaling.json").unlink()
    (folder / "roofline.json").unlink()
    monkeypatch.setattr(write_gpu_numbers, "can_plot", lambda: True)
    kernels = write_gpu_numbers.PARTS[0]._replace(plot=lambda rows, path: None)
    monkeypatch.setattr(write_gpu_numbers, "PARTS", (kernels, *write_gpu_numbers.PARTS[1:]))
    page = folder / "gpu.md"
    part = re.compile(r"(<!-- (?!end of|picture of)[a-z]+ -->\n).*?(<!-- end)", re.DOTALL)
    blank = part.sub(r"\1Not measured yet.\n\2", PAGE.read_text())
    page.write_text(blank)
    write(monkeypatch, page, folder)
    assert blank.count("Not measured yet.") == 6
    assert page.read_text().count("Not measured yet.") == 4


def test_without_matplotlib_the_page_is_left_alone(monkeypatch, folder, capsys):
    monkeypatch.setattr(pareto, "find_spec", lambda name: None)
    page = folder / "gpu.md"
    page.write_text("as it was")
    with pytest.raises(SystemExit):
        write(monkeypatch, page, folder)
    assert "matplotlib is not installed" in capsys.readouterr().err
    assert page.read_text() == "as it was"


def test_the_page_says_so_where_no_peer_was_there():
    assert write_gpu_numbers.peer_lines([GPU, FRAME]).startswith("No other rasterizer")


def test_no_step_is_called_a_cliff_where_none_is():
    calm = [replace(row, busy_ms=0.001 * row.amount) for row in STUDY]
    assert "No step is a cliff." in write_gpu_numbers.growth_lines(calm)


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, ""), (0.123456, "0.123"), (12_345.6, "12,346"), (99.96, "100"), (1e-5, "1e-05"), (0.0, "0")],
)
def test_numbers_are_written_short(value, text):
    assert write_gpu_numbers.short(value) == text


def test_measuring_writes_what_the_page_is_written_from(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(measure_gpu.scaling, "measure", lambda points, device, **_: STUDY)
    monkeypatch.setattr(measure_gpu.scaling, "points", lambda quick: [])
    monkeypatch.setattr(sys, "argv", ["measure_gpu.py", str(tmp_path / "gpu"), "scaling", "--device", "cpu"])
    measure_gpu.main()
    assert {p.name for p in (tmp_path / "gpu").iterdir()} == {"scaling.json"}
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("scaling: ")
    assert len(out) == 1 + len(STUDY)
    assert "busy_ms=0.02" in out[1]


def test_an_unknown_part_is_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "argv", ["measure_gpu.py", str(tmp_path / "gpu"), "kernel"])
    with pytest.raises(SystemExit):
        measure_gpu.main()
    assert "part: expected kernels, scaling, roofline, got kernel" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
