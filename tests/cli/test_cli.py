import json
import shlex
import shutil
import subprocess
import sys
from typing import get_args

import pytest

from oasis_warp import __version__
from oasis_warp.cli import app, main, options
from oasis_warp.hand.poses import POSE_NAMES

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


def test_every_command_takes_json_quiet_and_verbose():
    for command in get_args(app.Command):
        kinds = get_args(command)
        if kinds[1].name != "bench":  # its own commands write tables
            assert {"json", "quiet", "verbose"} <= set(kinds[0].__dataclass_fields__), kinds[1].name


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
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert main([*arguments, "--quiet", "--fps", "0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main([*arguments, "--verbose", "--fps", "0"]) == 2
    said = capsys.readouterr().err
    assert "in count_frames" in said and said.splitlines()[-1].startswith("oasis: --fps 0")


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
    from oasis_warp.cli import render

    def interrupt(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(render, "orbit_camera", interrupt)
    assert main(["render", str(avatar_file), "-o", str(avatar_file.with_name("x.png"))]) == 130
    assert capsys.readouterr().err == "oasis: stopped, nothing written.\n"
    assert not avatar_file.with_name("x.png").exists()


def test_an_error_of_ours_is_not_dressed_up_as_bad_input(monkeypatch, avatar_file):
    from oasis_warp.cli import render

    def fail(*args):
        raise ValueError("a bug")

    monkeypatch.setattr(render, "orbit_camera", fail)
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
    assert capsys.readouterr().err.startswith(f"oasis: {command!r} is no command; {answer}")
