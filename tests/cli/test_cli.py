"""The command line itself, and `oasis info` and `oasis compare`, which answer in words."""

import contextlib
import itertools
import json
import shlex
import shutil
import signal
import subprocess
import sys
from typing import get_args

import cv2
import numpy as np
import pytest

from oasis_warp import __version__
from oasis_warp.cli import app, doctor, main, options
from oasis_warp.core.errors import InputError
from oasis_warp.hand.poses import POSE_NAMES
from oasis_warp.hand_avatar import Avatar

LIST_IMPORTS = """
import sys
from oasis_warp.cli import main
try:
    main(sys.argv[1:])
finally:
    print(*(name for name in ("torch", "warp", "cv2", "numpy") if name in sys.modules), file=sys.stderr)
"""


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["reconstruct", "--help"], ["animate", "--help"]])
def test_help_imports_nothing_that_takes_seconds(arguments):
    done = subprocess.run([sys.executable, "-c", LIST_IMPORTS, *arguments], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stderr.strip() == ""
    assert done.stdout


def test_an_avatar_is_drawn_and_animated_without_the_network_that_made_it(avatar_file, tmp_path):
    code = """
import sys
from oasis_warp.cli import main
avatar, folder = sys.argv[1:]
assert main(["render", avatar, "-o", f"{folder}/picture.png", "--size", "32"]) == 0
assert main(["animate", avatar, "-o", f"{folder}/film.gif", "--size", "32", "--seconds", "0.2"]) == 0
rooms = "network", "reconstruction", "pretraining", "adaptation", "estimation.networks"
once = tuple(f"oasis_warp.{room}" for room in rooms)
print(*(name for name in sys.modules if name.startswith(once)))
"""
    arguments = [sys.executable, "-c", code, str(avatar_file), str(tmp_path)]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"written: {tmp_path / name}" for name in ("picture.png", "film.gif")] + [""]


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"oasis_warp {__version__}\n"


def test_the_module_runs_as_the_command_does():
    done = subprocess.run([sys.executable, "-m", "oasis_warp", "--version"], capture_output=True, text=True)
    assert done.stdout == f"oasis_warp {__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [[], ["frobnicate"], ["reconstruct", "a.jpg"], ["reconstruct", "a.jpg", "-o", "x", "--hand", "both"],
     ["render", "a.safetensors", "-o", "x.png", "--device", "frog"]],
)  # fmt: skip
def test_a_wrong_command_line_exits_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", "expected one of reconstruct, batch, render,"),
        ("bench", "bench: expected one of kernels, error-time, scaling, roofline; see `oasis bench --help`."),
        ("render", "render: expected AVATAR and -o PATH, got none; see `oasis render --help`."),
        ("render a b -o c.png", "render: b is one name too many; see `oasis render --help`."),
        ("render a -o b.png --sise 10", "--sise: not an option of `oasis render` (did you mean '--size'?); see `oasis"),
        ("render a -o b.png --size abc", "--size abc: expected a whole number; see `oasis render --help`."),
        ("render a -o b.png --azimuth left", "--azimuth left: expected a number; see `oasis render --help`."),
        ("render a -o b.png --device gpu", "--device gpu: expected one of cpu, cuda; see `oasis render --help`."),
        ("render a -o b.png --pose", "--pose: expected a value, got none; see `oasis render --help`."),
        ("reconstruct a -o b --hand both", "--hand both: expected left, right, largest or a whole number; see"),
        ("reconstruct a -o b --lpips c", "--lpips c: expected 2 values; see `oasis reconstruct --help`."),
        ("--quiet", "--quiet: not an option of `oasis`; see `oasis --help`."),
        ("render a -o b.png --\x1b[31mred 1", "not an option of `oasis render`"),
    ],
)
@pytest.mark.parametrize("columns", ["40", "100"])
def test_a_wrong_command_line_is_told_in_one_sentence(line, expected, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    assert stopped.value.code == 2
    output = capsys.readouterr().err
    assert expected in output and output.startswith("oasis: ") and output.count("\n") == 1 and "\x1b" not in output


def test_every_command_takes_json_quiet_and_verbose():
    for command in get_args(app.Command):
        kinds = get_args(command)
        if kinds[1].name != "bench":  # its own commands write tables
            assert {"json", "quiet", "verbose"} <= set(kinds[0].__dataclass_fields__), kinds[1].name


def _helped(capsys, *arguments):
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--help"])
    assert stopped.value.code == 0
    return capsys.readouterr().out


def test_help_lists_each_command_on_two_lines_at_most_and_the_short_options(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    lines = _helped(capsys).splitlines()
    starts = [n for n, line in enumerate(lines) if "   • " in line]
    assert len(starts) == len(app.COMMANDS)
    assert max(b - a for a, b in itertools.pairwise([*starts, len(lines) - 1])) <= 2
    text = _helped(capsys, "render")
    assert "-q, --quiet" in text and "-v, --verbose" in text and "--json PATH" in text


@pytest.mark.parametrize("command", [*app.COMMANDS, "bench kernels", "bench scaling", "bench error-time"])
def test_help_names_no_default_that_says_nothing(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    text = " ".join(_helped(capsys, *command.split()).replace("│", " ").split())
    for nothing in ("(default: None)", "(default: False)", "(default: )", "(default: '')", "{None}", "None,"):
        assert nothing not in text


def test_json_holds_the_exact_command_and_what_it_wrote_or_what_went_wrong(avatar_file, tmp_path, capsys):
    record, out = tmp_path / "record.json", tmp_path / "a picture.png"
    arguments = ["render", str(avatar_file), "-o", str(out), "--size", "32", "--json", str(record)]
    assert main(arguments) == 0
    found = json.loads(record.read_text())
    assert shlex.split(found["command"]) == ["oasis", *arguments]
    assert found["written"] == [str(out)] and found["exit_code"] == 0 and found["error"] is None
    assert found["options"]["size"] == 32 and found["seconds"] > 0
    assert main([*arguments, "--background", "mauve"]) == 2
    found = json.loads(record.read_text())
    assert found["exit_code"] == 2 and f"oasis: {found['error']}\n" == capsys.readouterr().err
    assert "written" not in found
    assert main([*arguments[:-1], str(tmp_path)]) == 2
    assert "found a folder" in capsys.readouterr().err


def test_quiet_says_only_what_is_wrong_and_verbose_where(avatar_file, tmp_path, capsys):
    arguments = ["animate", str(avatar_file), "-o", str(tmp_path / "x.gif"), "--size", "32", "--seconds", "0.1"]
    for quiet in ("--quiet", "-q"):
        assert main([*arguments, quiet]) == 0
        assert capsys.readouterr() == ("", "")
    assert main([*arguments, "--quiet", "--fps", "0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    for verbose in ("--verbose", "-v"):
        assert main([*arguments, verbose, "--fps", "0"]) == 2
        output = capsys.readouterr().err
        assert "in count_frames" in output and output.splitlines()[-1].startswith("oasis: --fps 0")


@pytest.mark.parametrize("swallowed", [ValueError("could not determine the shape"), InputError("x: damaged.")])
def test_an_interrupt_that_a_library_turns_into_another_error_is_still_one(monkeypatch, capsys, swallowed):
    """safetensors does."""

    def run(chosen):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise swallowed

    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(doctor, "run", run)
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err == "oasis: stopped, nothing was written.\n"
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


LEAVE = """
import atexit, os, signal, sys
from oasis_warp.cli import doctor, main
class Crash:
    def __del__(self):
        os.abort()
crash = Crash()
crash.itself = crash
atexit.register(print, "cleaned up")
doctor.run = lambda chosen: signal.raise_signal(signal.SIGINT)
sys.argv = ["oasis", "doctor"]
sys.exit(main())
"""


def test_a_process_that_is_interrupted_cleans_up_and_does_not_crash_at_its_end():
    done = subprocess.run([sys.executable, "-c", LEAVE], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (130, "cleaned up\n")
    assert done.stderr == "oasis: stopped, nothing was written.\n"


COMPLETE = """
source {script}
shown() {{ COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); _tyro_oasis; echo "${{COMPREPLY[@]}}"; }}
shown oasis re
shown oasis render --po
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_a_shell_completes_commands_and_options(tmp_path):
    command = [sys.executable, "-m", "oasis_warp", "--tyro-print-completion", "bash"]
    (tmp_path / "script").write_bytes(subprocess.run(command, capture_output=True, check=True).stdout)
    code = COMPLETE.format(script=shlex.quote(str(tmp_path / "script")))
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["reconstruct render", "--pose"]


def test_bad_input_is_one_sentence_and_exits_with_two(capsys, tmp_path):
    assert main(["render", str(tmp_path / "none"), "-o", str(tmp_path / "x.png")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("oasis: ")
    assert captured.err.count("\n") == 1


def test_an_interrupt_is_told_and_exits_with_130(capsys, monkeypatch, avatar_file):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Avatar, "orbit_camera", interrupt)
    assert main(["render", str(avatar_file), "-o", str(avatar_file.with_name("x.png"))]) == 130
    assert capsys.readouterr().err == "oasis: stopped, nothing was written.\n"
    assert not avatar_file.with_name("x.png").exists()


def test_an_error_of_ours_is_not_dressed_up_as_bad_input(monkeypatch, avatar_file):
    def fail(*_, **__):
        raise ValueError("a bug")

    monkeypatch.setattr(Avatar, "orbit_camera", fail)
    with pytest.raises(ValueError, match="a bug"):
        main(["render", str(avatar_file), "-o", str(avatar_file.with_name("x.png"))])


def test_the_command_line_offers_every_pose():
    names = [name for part in get_args(options.PoseName) for name in get_args(part)]
    assert names == ["photo", *POSE_NAMES]


@pytest.mark.parametrize(
    ("command", "answer"),
    [("reconstrct", "did you mean 'reconstruct'?\n"), ("frobnicate", "expected one of reconstruct, batch, render, ")],
)
def test_a_mistyped_command_is_answered_with_the_nearest_one(command, answer, capsys):
    with pytest.raises(SystemExit):
        main([command, "a.jpg"])
    assert capsys.readouterr().err.startswith(f"oasis: {command!r} is not a command; {answer}")


def test_the_facts_are_those_of_the_avatar(avatar_file, tmp_path, capsys):
    assert main(["info", str(avatar_file), "--json", str(tmp_path / "facts.json")]) == 0
    facts = json.loads((tmp_path / "facts.json").read_text())[str(avatar_file)]
    avatar = Avatar.load(avatar_file)
    assert facts["side"] == avatar.side
    assert facts["n_gaussians"] == len(avatar.gaussians.opacities)
    assert facts["hand_licence"].startswith("CC0")
    assert 150 < facts["length_mm"] < 230 and 50 < facts["breadth_mm"] < 90
    assert str(facts["n_gaussians"]) in capsys.readouterr().out


def test_two_avatars_have_a_column_each_and_a_wrong_file_is_said(avatar_file, tmp_path, capsys):
    assert main(["info", str(avatar_file), str(avatar_file)]) == 0
    (tmp_path / "no.safetensors").write_text("no avatar")
    assert main(["info", str(avatar_file), str(tmp_path / "no.safetensors")]) == 2
    assert "no.safetensors: expected" in capsys.readouterr().err


def test_a_comparison_names_what_differs_and_nothing_else(scene, avatar_file, tmp_path, capsys):
    one, other = tmp_path / "one" / "avatar.safetensors", tmp_path / "other" / "avatar.safetensors"
    for path, seed, psnr in ((one, 0, 30.0), (other, 3, 31.5)):
        path.parent.mkdir()
        report = {"config": {"seed": seed, "size": 512}, "errors": {"input_psnr_db": psnr, "mask_iou": 0.9}}
        path.with_name("report.json").write_text(json.dumps(report))
    avatar = scene[2]
    avatar.save(one)
    avatar.with_looks(avatar.gaussians._replace(scales=0.9 * avatar.gaussians.scales), None).save(other)
    record = tmp_path / "record.json"
    assert main(["compare", str(one), str(other), "-o", str(tmp_path / "both.png"), "--json", str(record)]) == 0
    output = capsys.readouterr().out
    assert "--seed" in output and "--size" not in output and "31.5 dB" in output and "mask IoU of the fit" not in output
    facts = json.loads(record.read_text())
    assert facts["different"]["--seed"] == ["0", "3"]
    assert facts["different"]["median size of a Gaussian"] == pytest.approx([3, 2.7])
    assert "side" not in facts["different"]
    assert all(20 < value < 60 for value in facts["likeness_db"])
    assert np.asarray(cv2.imread(str(tmp_path / "both.png"))).shape[1] == 1200


def test_an_avatar_differs_in_nothing_from_itself(avatar_file, tmp_path, capsys):
    record = tmp_path / "record.json"
    assert main(["compare", str(avatar_file), str(avatar_file), "--json", str(record)]) == 0
    assert capsys.readouterr().out.count("identical") == 3
    assert json.loads(record.read_text())["different"] == {}


def test_no_avatar_is_said(capsys):
    assert main(["info"]) == 2
    assert "expected at least one avatar.safetensors" in capsys.readouterr().err


@pytest.mark.parametrize(("error", "code", "output"), [
    (OSError(24, "Too many open files"), 1,
     "cannot be loaded (Too many open files); check `ulimit -a`, or reinstall."),
    (KeyboardInterrupt(), 130, "stopped, nothing was written."),
], ids=["few descriptors", "Ctrl-C"])  # fmt: skip
def test_what_happens_while_the_commands_are_imported_is_told(monkeypatch, capsys, error, code, output):
    """Both were tracebacks."""

    class Full:
        def find_spec(self, name, path=None, target=None):
            if name == "oasis_warp.cli.app":
                raise error

    monkeypatch.delitem(sys.modules, "oasis_warp.cli.app")
    monkeypatch.delattr("oasis_warp.cli.app")
    monkeypatch.setattr(sys, "meta_path", [Full(), *sys.meta_path])
    assert main(["--version"]) == code
    assert capsys.readouterr().err == f"oasis: {output}\n"
