"""The examples run, in this process, small."""

import importlib.util
import json
import sys
import types
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def example(monkeypatch, tmp_path):
    """Loads an example by name; what it writes goes to a temporary folder."""
    monkeypatch.chdir(tmp_path)

    def load(name):
        spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


def test_gaussians_of_ones_own_are_trained(example, capsys, tmp_path):
    module = example("train_gaussians")
    module.main(module.Options(size=48, gaussians=300, steps=60))
    decibels = [float(line.split()[2]) for line in capsys.readouterr().out.splitlines() if line.startswith("step")]
    assert decibels[-1] > decibels[0] + 6
    assert (tmp_path / "fitted.png").is_file()


def test_gaussians_go_to_gsplat_and_our_rasterizer_alike(example, capsys, avatar_file):
    module = example("draw_with_gsplat")
    module.main(module.Options(avatar=avatar_file))
    assert "Gaussians cover" in capsys.readouterr().out


@pytest.mark.slow
def test_the_notebook_runs(monkeypatch, tmp_path, capsys):
    """Cell after cell, as Jupyter does; without Jupyter, whose pictures are counted instead."""
    shown, jupyter = [], types.ModuleType("IPython.display")
    jupyter.__dict__.update(HTML=str, Image=lambda data=None, filename=None: data or Path(filename).read_bytes(),
                            display=shown.append)  # fmt: skip
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", jupyter)
    monkeypatch.chdir(tmp_path)
    names = {}
    for cell in json.loads((EXAMPLES / "avatar.ipynb").read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert float(capsys.readouterr().out.split()[3]) < 3  # "the tip is 0.9 mm off"
    assert len(shown) == 6 and all(picture[1:4] == b"PNG" for picture in shown[:4])
    assert {"avatar.safetensors", "poses.webp", "hand.html", "hand.glb"} <= {file.name for file in tmp_path.iterdir()}


def test_an_avatar_is_posed_and_rendered_in_a_loop(example, capsys, tmp_path, avatar_file):
    module = example("pose_and_render")
    module.main(module.Options(avatar=avatar_file, frames=2, size=32))
    assert sorted(file.name for file in (tmp_path / "frames").iterdir()) == ["0000.png", "0001.png"]
    assert "frames per second" in capsys.readouterr().out
