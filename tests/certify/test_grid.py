"""140 scenes of the seeded grid against the float64 references, what a scene is, and `oasis gradcheck` of them."""

import json
import math
import signal
import subprocess
import sys
import time
from typing import get_args

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.certification import EXACT_STIFF, check_scene, grid_scenes, run_grid
from oasis_warp.certify.compare import LAYER, Measurement, compare
from oasis_warp.certify.families import FAMILIES
from oasis_warp.cli import developer_options, gradcheck, main


@pytest.mark.parametrize(
    "scenes", [range(20), pytest.param(range(20, 100), marks=pytest.mark.slow)], ids=["first 20", "up to 100"]
)
@pytest.mark.parametrize("name", FAMILIES)
def test_float32_operators_keep_their_bounds_on_the_first_scenes_of_the_grid(name, scenes, device):
    measured = [m for seed in scenes for m in check_scene(name, seed, device)]
    assert len(measured) > len(scenes)
    assert not [m for m in measured if not m.passed]


SMALL = {"rasterization": {"n": 40, "size": (17, 15), "channels": 3, "mode": "RGB"}}


@pytest.mark.parametrize(
    "dtype", [torch.float32, pytest.param(torch.float64, marks=pytest.mark.slow)], ids=["float32", "float64"]
)
@pytest.mark.parametrize("name", FAMILIES)
def test_small_scenes_of_every_condition_equal_the_references(name, dtype, device):
    family = FAMILIES[name]
    for condition in family.conditions:
        for seed in (0, 1):
            case = family.case(condition, seed, **SMALL.get(name, {}))
            found = compare(family, case, dtype, device, EXACT_STIFF if dtype == torch.float64 else None)
            assert not [m for m in found if not m.passed]


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_float64_operators_are_exact_on_the_first_scenes_of_the_grid(name, device):
    family = FAMILIES[name]
    for seed in range(len(family.conditions)):
        measured = compare(family, family.scene(seed), torch.float64, device, EXACT_STIFF)
        assert not [m for m in measured if not m.passed]


@pytest.mark.parametrize("name", FAMILIES)
def test_a_scene_is_a_function_of_its_seed_alone(name):
    for seed in range(0, 40, 7):
        torch.manual_seed(0)
        first = FAMILIES[name].scene(seed)
        before = torch.get_rng_state()
        torch.manual_seed(1)
        second = FAMILIES[name].scene(seed)
        assert (
            str(first) == str(second)
            and first.differentiable == second.differentiable
            and first.bounds == second.bounds
        )
        assert first.floats.keys() == second.floats.keys()
        assert all(torch.equal(first.floats[k], second.floats[k]) for k in first.floats)
        assert all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
                   for a, b in ((first.others[k], second.others[k]) for k in first.others))  # fmt: skip
        torch.manual_seed(0)
        assert torch.equal(before, torch.get_rng_state()), "the global generator was used"


@pytest.mark.parametrize("name", FAMILIES)
def test_scenes_hold_float32_numbers_and_every_condition_has_its_turn(name):
    family = FAMILIES[name]
    cases = [family.scene(seed) for seed in range(len(family.conditions))]
    assert {case.condition for case in cases} == set(family.conditions)
    for case in cases:
        for tensor in case.floats.values():
            assert tensor.dtype == torch.float64 and torch.equal(tensor, tensor.float().double())


def test_scenes_are_shared_out_over_the_operators_with_consecutive_seeds():
    got = grid_scenes(("a", "b"), 5, seed=7)
    assert got == [("a", 7), ("b", 7), ("a", 8), ("b", 8), ("a", 9)]


def test_an_operator_that_raises_is_a_failure_and_not_the_end(monkeypatch):
    def broken(**_):
        raise RuntimeError("no such kernel")

    monkeypatch.setattr(ops, "face_rotations", broken)
    (found,) = check_scene("face_rotations", 4, torch.device("cpu"))
    assert not found.passed and "any unit of length, seed 4: RuntimeError: no such kernel" in found.scene


@pytest.mark.parametrize(
    ("break_it", "check"),
    [
        (lambda image: image * (1 + 3e-5), "values"),
        (lambda image: image + 1e-3 * (torch.arange(image.numel()).view_as(image) == 5), "single elements"),
        (lambda image: image.where(image != image.max(), math.nan), "not finite"),
        (lambda image: image + 1e-4 * (image - image.detach()), "gradients"),
    ],
)  # fmt: skip
def test_a_slightly_wrong_image_is_found(break_it, check, monkeypatch):
    right = ops.rasterization

    def wrong(**arguments):
        image, alphas, meta = right(**arguments)
        return break_it(image), alphas, meta

    monkeypatch.setattr(ops, "rasterization", wrong)
    case = FAMILIES["rasterization"].case("ordinary", 2, n=20, size=(17, 15))
    found = compare(FAMILIES["rasterization"], case, torch.float32, torch.device("cpu"))
    assert check in {m.check.removeprefix("float32 ") for m in found if not m.passed}


def test_nan_fails_every_bound():
    assert not Measurement("f", "c", "s", math.nan, 1.0).passed
    assert Measurement("f", "c", "s", math.nan, 1.0).load == math.inf
    assert LAYER > 1 / 255


@pytest.mark.slow
def test_processes_measure_what_one_process_measures():
    todo = grid_scenes(("pose_on_mesh", "face_rotations"), 44, 0)
    cpu = torch.device("cpu")
    alone = sorted(m for _, part in run_grid(todo, cpu, 1) for m in part)
    shared = list(run_grid(todo, cpu, 2))
    assert sum(n for n, _ in shared) == 44
    assert sorted(m for _, part in shared for m in part) == alone


@pytest.mark.usefixtures("as_shipped")
def test_sound_operators_give_a_table_a_file_and_zero(capsys, tmp_path):
    assert main(["gradcheck", "--family", "pose_on_mesh", "--json", str(tmp_path / "all.json")]) == 0
    shown = capsys.readouterr().out
    for check in ("finite differences", "gradients, stiff", "thread counts with other bits", "not refused by name"):
        assert check in shown
    assert "all within bounds" in shown and "FAILED" not in shown
    found = json.loads((tmp_path / "all.json").read_text())
    assert found["passed"] and not found["failures"]
    assert found["command"].startswith("oasis gradcheck --family pose_on_mesh --json ")
    assert {row["family"] for row in found["checks"]} == {"pose_on_mesh"}
    assert all(row["cases"] > 0 and row["failures"] == 0 and row["error"] <= row["bound"] for row in found["checks"])
    assert {row["condition"] for row in found["conditions"]} == set(FAMILIES["pose_on_mesh"].conditions)
    assert found["machine"]["device"].startswith("cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["all.json"]


@pytest.mark.usefixtures("as_shipped")
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


@pytest.mark.usefixtures("as_shipped")
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


@pytest.mark.usefixtures("as_shipped")
def test_all_operators_take_part_in_the_grid(capsys):
    assert main(["gradcheck", "--scenes", str(2 * len(FAMILIES)), "--jobs", "1"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in FAMILIES)
    assert f"{2 * len(FAMILIES)} scenes" in shown


@pytest.mark.usefixtures("as_shipped")
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


@pytest.mark.usefixtures("as_shipped")
def test_a_missing_cuda_device_is_refused(capsys, monkeypatch):
    monkeypatch.setattr(gradcheck.torch.cuda, "is_available", lambda: False)
    assert main(["gradcheck", "--device", "cuda"]) == 2
    assert "no CUDA device found" in capsys.readouterr().err


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("arguments", [["--family", "teapot"], ["--scenes", "many"], ["--frobnicate"]])
def test_a_wrong_command_line_exits_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["gradcheck", *arguments])
    assert stopped.value.code == 2


@pytest.mark.usefixtures("as_shipped")
def test_the_command_line_offers_every_operator():
    assert get_args(developer_options.FamilyName) == tuple(FAMILIES)


@pytest.mark.usefixtures("as_shipped")
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
    assert err.splitlines()[-1] == "oasis: stopped, nothing was written." and "Traceback" not in err
    assert not list(tmp_path.iterdir())
