"""docs/gpu.md and docs/kernels.md: every table is filled from its file, and what has no file stays."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from gpu_rows import KERNELS, SPEED, STUDY

from oasis_warp.bench import plots
from oasis_warp.bench.rows import json_text
from studies import kernels
from studies.__main__ import render

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
    monkeypatch.setattr(plots, "find_spec", lambda name: None)
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
