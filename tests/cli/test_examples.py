"""The examples run, in this process, small."""

import importlib.util
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


def test_an_avatar_is_posed_and_rendered_in_a_loop(example, capsys, tmp_path, avatar_file):
    module = example("pose_and_render")
    module.main(module.Options(avatar=avatar_file, frames=2, size=32))
    assert sorted(file.name for file in (tmp_path / "frames").iterdir()) == ["0000.png", "0001.png"]
    assert "frames per second" in capsys.readouterr().out
