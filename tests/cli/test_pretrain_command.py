"""`oasis pretrain`: refusals in words, what it leaves, and stopping and going on."""

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from safetensors import safe_open

from oasis_warp.cli import main
from oasis_warp.cli import pretrain as command
from oasis_warp.cli.progress import BAD_INPUT, INTERRUPTED
from oasis_warp.network.config import COMPACT, PROFILES
from oasis_warp.network.weights_file import load_network
from oasis_warp.pretraining.pretrain import CHECKPOINT, METRICS, SHEET, WEIGHTS
from oasis_warp.synthetic import people

pytestmark = pytest.mark.slow

TINY = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
SMALL = ("--hands", "1", "--views", "1", "--people", "1", "--size", "32", "--steps", "2", "--workers", "0",
         "--device", "cpu", "--precision", "float32")  # fmt: skip


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setitem(PROFILES, "compact", TINY)


def stop_after_one_step(monkeypatch):
    """Have Ctrl-C come while the first step is reported."""

    @contextmanager
    def shown(console):
        def progress(stage, done, total):
            if (stage, done) == ("pretraining", 1):
                signal.raise_signal(signal.SIGINT)

        yield progress

    monkeypatch.setattr(command, "show_progress", shown)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """A training that nothing stopped."""
    folder = tmp_path_factory.mktemp("unbroken") / "prior"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PROFILES, "compact", TINY)
        patch.setattr(people, "_cache", type(people._cache)())  # as in a process of its own
        assert main(["pretrain", str(folder), *SMALL]) == 0
        baked = people._cache
    people._cache.update(baked)  # for the other trainings
    return folder


def test_a_training_leaves_weights_metrics_and_pictures(unbroken, hand):
    names = {CHECKPOINT, WEIGHTS, METRICS, SHEET, command.SETTINGS, command.PEOPLE, "commands.txt"}
    assert {path.name for path in unbroken.iterdir()} == names
    (line,) = map(json.loads, (unbroken / METRICS).read_text().splitlines())
    assert line["step"] == 2 and line["loss"] > 0
    assert load_network(unbroken / WEIGHTS, hand).config == TINY
    assert [path.name for path in (unbroken / command.PEOPLE).iterdir()] == ["000000.safetensors"]


def test_the_weights_say_how_they_came_about(unbroken):
    with safe_open(unbroken / WEIGHTS, framework="pt") as file:
        notes = json.loads(json.loads(file.metadata()["oasis-network"])["notes"])
    assert notes["step"] == 2 and notes["learning_rate"] > 0
    assert notes["hold_out"] == []
    assert notes["precision"] == "float32" and notes["people"] == 1 and notes["processes"] == 1


def test_ctrl_c_ends_it_after_the_step_and_the_same_command_ends_with_the_same_bits(
    unbroken, tmp_path, tiny, monkeypatch, capfd
):
    asked = signal.getsignal(signal.SIGINT)
    folder = tmp_path / "prior"
    with monkeypatch.context() as patch:
        stop_after_one_step(patch)
        assert main(["pretrain", str(folder), *SMALL]) == INTERRUPTED
    said = capfd.readouterr().err
    assert "stopping after this step" in said and "the same command continues" in said
    assert signal.getsignal(signal.SIGINT) is asked
    assert [json.loads(line)["step"] for line in (folder / METRICS).read_text().splitlines()] == [1]
    assert main(["pretrain", str(folder), *SMALL]) == 0
    for name in (CHECKPOINT, WEIGHTS, SHEET):
        assert (folder / name).read_bytes() == (unbroken / name).read_bytes(), name


def test_a_finished_training_is_left_as_it_is(unbroken, tiny):
    before = {path: path.read_bytes() for path in unbroken.iterdir() if path.is_file()}
    assert main(["pretrain", str(unbroken), *SMALL]) == 0
    assert {path: path.read_bytes() for path in unbroken.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("other", [["--seed", "1"], ["--steps", "3"], ["--people", "2"], ["--precision", "bf16"],
                                   ["--hold-out", "tattoo"]])  # fmt: skip
def test_another_training_in_the_same_folder_is_refused(unbroken, tiny, capsys, other):
    before = (unbroken / CHECKPOINT).read_bytes()
    assert main(["pretrain", str(unbroken), *SMALL, *other]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"a training made with other settings, {other[0].removeprefix('--').replace('-', '_')} " in said
    assert (unbroken / CHECKPOINT).read_bytes() == before


def test_a_checkpoint_of_unknown_origin_is_refused(unbroken, tiny, tmp_path, capsys):
    (tmp_path / CHECKPOINT).write_bytes((unbroken / CHECKPOINT).read_bytes())
    assert main(["pretrain", str(tmp_path), *SMALL]) == BAD_INPUT
    assert "holds a checkpoint but no training.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--steps", "0"], "--steps: expected 1 or more, got 0"),
        (["--hands", "0"], "--hands: expected 1 or more, got 0"),
        (["--people", "-3"], "--people: expected 1 or more, got -3"),
        (["--people", "49", "--steps", "49"], "--people: expected at most 48 that one cpu device meets, got 49"),
        (["--views", "9"], "--views: expected 1 to 8, got 9"),
        (["--size", "100"], "--size: expected a multiple of 16 from 32 to 1024 pixels, got 100"),
        (["--seed", "-1"], "--seed: expected 0 or more, got -1"),
        (["--workers", "-1"], "--workers: expected 0 or more, got -1"),
        (["--profile", "paper"], "--profile paper: reads photos with dinov2-large; give its model.safetensors"),
        (["--profile", "paper", "--backbone-weights", "none"], "none: expected DINOv2 ViT-L/14, found no such file"),
        (["--lpips", "a.pth", "b.pth"], "a.pth: expected AlexNet, found no such file; download https://download.pytorch"),
        (["--backbone-weights", "none"], "the compact profile trains its own encoder"),
    ],
)
def test_wrong_options_are_one_sentence(tmp_path, tiny, capsys, arguments, words):
    out = tmp_path / "prior"
    assert main(["pretrain", str(out), *SMALL, *arguments]) == BAD_INPUT
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("name", ["file", "file/prior"])
def test_a_place_that_is_no_folder_is_refused(tmp_path, tiny, capsys, name):
    (tmp_path / "file").write_text("mine")
    assert main(["pretrain", str(tmp_path / name), *SMALL]) == BAD_INPUT
    assert "found a file" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


def test_a_machine_without_a_gpu_is_told_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["pretrain", str(tmp_path / "prior")]) == BAD_INPUT
    assert "--device cuda: torch finds no CUDA device" in capsys.readouterr().err


def test_a_second_ctrl_c_ends_it_at_once(capfd):
    with pytest.raises(KeyboardInterrupt), command.stop_signals(can_force=True) as asked:
        assert not asked()
        signal.raise_signal(signal.SIGINT)
        assert asked()
        signal.raise_signal(signal.SIGINT)
    assert capfd.readouterr().err.count("stopping") == 1


def test_sigterm_ends_it_after_the_step_and_so_does_a_second_one():
    with command.stop_signals(can_force=True) as asked:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert asked()


TOGETHER = (*SMALL, "--people", "2", "--steps", "4")


def torchrun(folder, *where):
    """The command that trains together, and its environment."""
    script = Path(__file__).with_name("pretrain_together.py")
    start = [sys.executable, "-m", "torch.distributed.run", *where, str(script), str(folder), *TOGETHER]
    # Or those that were restarted wait for the others forever (pytorch, issue 135712; docs/network.md).
    return start, {**os.environ, "OMP_NUM_THREADS": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    """A training by two processes of one node, which nothing stopped."""
    folder = tmp_path_factory.mktemp("together") / "prior"
    command, environment = torchrun(folder, "--standalone", "--nproc-per-node", "2")
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


def steps_of(folder):
    return [json.loads(line)["step"] for line in (folder / METRICS).read_text().splitlines()]


def test_two_processes_train_one_network_on_people_of_their_own(together, hand):
    assert json.loads((together / command.SETTINGS).read_text())["processes"] == 2
    people_met = sorted(path.name for path in (together / command.PEOPLE).iterdir())
    assert people_met == ["000000.safetensors", "000001.safetensors"]
    assert steps_of(together) == [2, 4]
    assert load_network(together / WEIGHTS, hand).config == TINY


@pytest.mark.timeout(600)
def test_a_killed_process_of_one_of_two_nodes_restarts_all_from_the_checkpoint_and_the_weights_have_the_same_bits(
    together, tmp_path
):
    """An agent of torchrun each, which meet on this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    meeting = ["--nnodes", "2", "--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", "1"]
    command, environment = torchrun(tmp_path, *meeting, "--local-addr", "127.0.0.1", "--max-restarts", "2")
    environment["DIE_AT"] = "3"
    nodes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) for _ in range(2)]
    said = [node.communicate(timeout=280)[1] for node in nodes]
    assert [node.returncode for node in nodes] == [0, 0], said
    assert "Traceback" in "".join(said)  # of the other process, which lost its peer
    assert (tmp_path / WEIGHTS).read_bytes() == (together / WEIGHTS).read_bytes()
    assert steps_of(tmp_path) == [2, 4]


def test_it_begins_with_weights_that_are_given(tiny, unbroken, tmp_path, capsys):
    start = unbroken / WEIGHTS
    assert main(["pretrain", str(tmp_path / "on"), *SMALL, "--start", str(start)]) == 0
    with safe_open(tmp_path / "on" / WEIGHTS, "pt") as file, safe_open(start, "pt") as before:
        ends = [f.get_tensor("vertex_head.second.weight").float() for f in (file, before)]
    assert 0 < float((ends[0] - ends[1]).abs().max()) < 0.01
    assert "start_sha256" in json.loads((tmp_path / "on" / command.SETTINGS).read_text())


def test_weights_of_another_profile_are_no_start(unbroken, tmp_path, capsys):
    start = unbroken / WEIGHTS
    assert main(["pretrain", str(tmp_path / "on"), *SMALL, "--initial-weights", str(start)]) == BAD_INPUT
    assert "of another network than --profile compact" in capsys.readouterr().err
    assert not (tmp_path / "on").exists()


def test_a_data_set_is_mixed_in_and_noted(tiny, mano_dir, tmp_path, capsys):
    from datasets.trees import photos  # a small tree of photos with an estimator's files

    from oasis_warp.hand.mano import read_mano

    photos(tmp_path / "data", {side: read_mano(mano_dir, side) for side in ("right", "left")})
    data = ("--data", "photos", "--root", str(tmp_path / "data"), "--mano-dir", str(mano_dir))
    assert main(["pretrain", str(tmp_path / "prior"), *SMALL, *data, "--data-weight", "1"]) == 0
    noted = json.loads((tmp_path / "prior" / command.SETTINGS).read_text())
    assert noted["data"] == "photos" and noted["samples"] == 3 and noted["data_weight"] == 1
    assert "3 samples of photos, 0 left out" in capsys.readouterr().err
    assert main(["pretrain", str(tmp_path / "prior"), *SMALL, *data]) == BAD_INPUT  # another mixture
    assert main(["pretrain", str(tmp_path / "other"), *SMALL, *data[:2]]) == BAD_INPUT
    assert "--data and --root belong together" in capsys.readouterr().err
