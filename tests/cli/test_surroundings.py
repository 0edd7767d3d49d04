"""What surrounds a command: closed streams, odd names, folders that are not there, no memory."""

import os
import signal
import subprocess
import sys
from importlib import resources

import cv2
import pytest
import torch
from disk import full_disk

from oasis_warp.assets import asset
from oasis_warp.cli import main
from oasis_warp.cli.app import what_ran_out
from oasis_warp.cli.console import plain_console
from oasis_warp.cli.report import measures_table
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops._runtime import launch

CLOSED = """
import os, sys
os.closerange(0, 3)
sys.stdin = sys.stdout = sys.stderr = None  # as Python starts without them
from oasis_warp.cli.app import open_standard_streams
open_standard_streams()
assert os.open(sys.argv[1], os.O_RDONLY) > 2
print("nobody reads this")
print("nor this", file=sys.stderr)
os.close(2)
from oasis_warp.data.photo import read_photo
assert read_photo(sys.argv[1]).rgb.shape == (48, 64, 3)
os._exit(7)
"""


def test_closed_streams_are_opened_so_that_no_file_gets_their_numbers(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), torch.zeros(48, 64, 3, dtype=torch.uint8).numpy())
    assert subprocess.run([sys.executable, "-c", CLOSED, str(tmp_path / "a.png")]).returncode == 7


def test_a_reader_that_goes_away_is_no_error_of_ours():
    code = "import sys; from oasis_warp.cli import main; sys.exit(main(['--help']))"
    reading, writing = os.pipe()
    os.close(reading)
    ran = subprocess.run([sys.executable, "-c", code], stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (ran.returncode, ran.stderr) == (141, "")


@pytest.mark.parametrize("name", ["[/b]", "[red]", "a" * 250])
def test_a_picture_with_an_odd_name_in_a_folder_that_is_not_there_is_drawn(avatar_file, tmp_path, name):
    out = tmp_path / "new" / f"{name}.png"
    assert main(["render", str(avatar_file), "-o", str(out), "--size", "16"]) == 0
    assert [file.name for file in out.parent.iterdir()] == [out.name]


def test_brackets_in_the_name_of_a_photo_are_no_markup(capsys):
    plain_console().print(measures_table("a[/b].png on [red]", {"total": 1.0}, {}, {}))
    assert "a[/b].png on [red]" in capsys.readouterr().out


def test_a_program_that_calls_a_command_keeps_its_own_answer_to_sigterm(avatar_file, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    assert main(["render", str(avatar_file), "-o", str(tmp_path / "a.png"), "--size", "16"]) == 0
    assert signal.getsignal(signal.SIGTERM) == before


def test_names_that_are_no_text_can_be_printed():
    code = "import sys; from oasis_warp.cli.app import open_standard_streams as o; o(); print(sys.argv[1])"
    utf8 = os.environ | {"PYTHONUTF8": "1"}
    done = subprocess.run([sys.executable, "-c", code, b"a\xff.png"], capture_output=True, env=utf8)
    assert done.stdout == b"a\\udcff.png\n"


def test_a_full_disk_is_told_and_leaves_no_picture(avatar_file, capsys):
    with full_disk(500):
        assert main(["render", str(avatar_file), "-o", str(avatar_file.with_name("x.png")), "--size", "64"]) == 2
    assert "no room left" in capsys.readouterr().err
    assert [file.name for file in avatar_file.parent.iterdir()] == [avatar_file.name]


def test_full_memory_is_told_in_one_sentence(avatar_file, tmp_path, monkeypatch, capsys):
    from oasis_warp.cli import render

    def fail(*_):
        torch.empty(1 << 60, dtype=torch.uint8)

    monkeypatch.setattr(render, "orbit_camera", fail)
    assert main(["render", str(avatar_file), "-o", str(tmp_path / "x.png")]) == 2
    assert capsys.readouterr().err == "oasis: the memory of cpu is full; give smaller sizes, or fewer at once.\n"
    assert what_ran_out(MemoryError()) == what_ran_out(torch.OutOfMemoryError("CUDA error: out of memory"))
    assert what_ran_out(RuntimeError("a bug")) is None


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("blend: CUDA error 719: unspecified launch failure"), "cpu failed in the middle of the work"),
        (OSError(24, "Too many open files"), "too many files are open"),
        (OSError(28, "No space left on device"), "a disk is full"),
    ],
)
def test_a_launch_that_fails_in_the_middle_is_told_and_leaves_nothing(avatar_file, monkeypatch, capsys, error, said):
    """A GPU that is lost, no more descriptors, no room for a kernel: they ended in tracebacks."""
    left, run_shared = [9], launch.run_shared  # of the launches of a clip, more than one frame's

    def run(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise RuntimeError("a package wraps it") from error
        return run_shared(*arguments)

    monkeypatch.setattr(launch, "run_shared", run)
    assert main(["animate", str(avatar_file), "-o", str(avatar_file.with_name("x.gif")), "--size", "16"]) == 2
    said_last = capsys.readouterr().err.splitlines()[-1]
    assert said_last.startswith(f"oasis: {said}") and said_last.endswith(".") and left[0] == -1
    assert [file.name for file in avatar_file.parent.iterdir()] == [avatar_file.name]


SMALL = ["--size", "64", "--steps", "2", "--prior", "none"]


def reconstructing(out, **environment):
    """A process that makes a small avatar of the bundled photo, with at most 32 open files."""
    with resources.as_file(asset("photos", "palm_open_left_02.png")) as photo:
        command = [sys.executable, "-m", "oasis_warp", "reconstruct", str(photo), "-o", str(out), *SMALL]
    limited = ["sh", "-c", 'ulimit -n 32; exec "$@"', "sh", *command]
    given = {name: value for name, value in {**os.environ, **environment}.items() if value}
    return subprocess.Popen(limited, env=given, stdout=subprocess.DEVNULL)


@pytest.mark.slow
@pytest.mark.parametrize("home", ["", "/proc", "missing"])
def test_a_home_that_is_missing_or_cannot_be_written_and_few_descriptors_do_no_harm(tmp_path, home):
    where = str(tmp_path / home) if home == "missing" else home
    process = reconstructing(tmp_path / "out", HOME=where, OASIS_WARP_CACHE="")
    assert (process.wait(), (tmp_path / "out" / "avatar.safetensors").is_file()) == (0, True)


@pytest.mark.slow
def test_two_processes_write_one_output_one_after_the_other(tmp_path):
    out = tmp_path / "out"
    processes = [reconstructing(out) for _ in range(2)]
    assert [process.wait() for process in processes] == [0, 0]
    whole = {"avatar.safetensors", "quality.png", "report.json", "summary.png", "turntable.mp4"}
    assert {path.name for path in out.iterdir()} == whole and list(tmp_path.iterdir()) == [out]
    Avatar.load(out / "avatar.safetensors")
