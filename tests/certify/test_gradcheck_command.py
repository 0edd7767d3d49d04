"""`oasis gradcheck`: its table, its exit codes, its file."""

import json
import signal
import subprocess
import sys
import time
from typing import get_args

import pytest

from oasis_warp import ops
from oasis_warp.certify.families import FAMILIES
from oasis_warp.cli import developer_options, gradcheck, main

pytestmark = pytest.mark.usefixtures("as_shipped")


def test_sound_operators_give_a_table_a_file_and_zero(capsys, tmp_path):
    assert main(["gradcheck", "--family", "pose_on_mesh", "--json", str(tmp_path / "all.json")]) == 0
    shown = capsys.readouterr().out
    for check in ("finite differences", "gradients, stiff", "thread counts with other bits", "not refused by name"):
        assert check in shown
    assert "all within bounds" in shown and "FAILED" not in shown
    found = json.loads((tmp_path / "all.json").read_text())
    assert found["passed"] and not found["failures"]
    assert {row["family"] for row in found["checks"]} == {"pose_on_mesh"}
    assert all(row["cases"] > 0 and row["failures"] == 0 and row["error"] <= row["bound"] for row in found["checks"])
    assert {row["condition"] for row in found["conditions"]} == set(FAMILIES["pose_on_mesh"].conditions)
    assert found["machine"]["device"].startswith("cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["all.json"]


def test_a_broken_operator_gives_one_and_says_what_is_wrong(capsys, monkeypatch, tmp_path):
    right = ops.face_rotations

    def broken(**arguments):
        made = right(**arguments)
        return made._replace(area_ratio=1.0001 * made.area_ratio)

    monkeypatch.setattr(ops, "face_rotations", broken)
    assert main(["gradcheck", "--family", "face_rotations", "--json", str(tmp_path / "all.json")]) == 1
    shown = capsys.readouterr().out
    assert "FAILED" in shown and "beyond their bounds" in shown
    assert "face_rotations, float32 values: ordinary, seed 0: area_ratio: 1.00e-04, expected at most 5e-06" in shown
    found = json.loads((tmp_path / "all.json").read_text())
    assert not found["passed"]
    broken_checks = {row["check"] for row in found["checks"] if row["failures"]}
    assert {"float64 values", "float32 values", "float32 values, stiff"} <= broken_checks
    assert "finite differences" not in broken_checks, "its gradient is that of the wrong value"


def test_a_failing_scene_of_the_grid_can_be_run_alone(capsys, monkeypatch):
    right = ops.depth_map

    def broken(**arguments):
        made = right(**arguments)
        return made._replace(depth=1.1 * made.depth) if arguments["near_plane"] == 2.0 else made

    monkeypatch.setattr(ops, "depth_map", broken)
    assert main(["gradcheck", "--scenes", "20", "--family", "depth_map", "--jobs", "1"]) == 1
    shown = capsys.readouterr().out
    assert "oasis gradcheck --scenes 1 --family depth_map --seed 4" in shown
    assert main(["gradcheck", "--scenes", "1", "--family", "depth_map", "--seed", "4", "--jobs", "1"]) == 1
    assert main(["gradcheck", "--scenes", "4", "--family", "depth_map", "--jobs", "1"]) == 0


def test_all_operators_take_part_in_the_grid(capsys):
    assert main(["gradcheck", "--scenes", str(2 * len(FAMILIES)), "--jobs", "1"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in FAMILIES)
    assert f"{2 * len(FAMILIES)} scenes" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenes", "0"], "--scenes: expected 1 or more, got 0."),
        (["--jobs", "-1", "--scenes", "3"], "--jobs: expected 1 or more, got -1."),
        (["--seed", "-1"], "--seed: expected 0 or more, got -1."),
        (["--json", "/dev/null/x.json"], "expected the folder /dev/null to write to, found a file"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_sentence(arguments, message, capsys):
    assert main(["gradcheck", *arguments]) == 2
    shown = capsys.readouterr()
    assert message in shown.err and shown.err.count("\n") == 1 and not shown.out


def test_a_missing_cuda_device_is_refused(capsys, monkeypatch):
    monkeypatch.setattr(gradcheck.torch.cuda, "is_available", lambda: False)
    assert main(["gradcheck", "--device", "cuda"]) == 2
    assert "no CUDA device found" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--family", "teapot"], ["--scenes", "many"], ["--frobnicate"]])
def test_a_wrong_command_line_exits_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["gradcheck", *arguments])
    assert stopped.value.code == 2


def test_the_command_line_offers_every_operator():
    assert get_args(developer_options.FamilyName) == tuple(FAMILIES)


@pytest.mark.slow
def test_an_interrupt_ends_the_processes_of_the_grid_and_leaves_no_file(tmp_path):
    command = [sys.executable, "-m", "oasis_warp", "gradcheck", "--scenes", "100000", "--jobs", "2",
               "--json", str(tmp_path / "all.json")]  # fmt: skip

    def heed_interrupts():
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a test run in the background ignores them, and its child would

    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
    )
    try:
        time.sleep(6)
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 130
    assert err.splitlines()[-1] == "oasis: stopped, nothing written." and "Traceback" not in err
    assert not list(tmp_path.iterdir())
