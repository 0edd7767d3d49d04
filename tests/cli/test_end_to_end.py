"""Commands as a user runs them, the examples, and what surrounds a command: closed streams, odd names, no memory."""

import importlib.util
import inspect
import json
import os
import signal
import subprocess
import sys
import time
import types
from importlib import resources
from pathlib import Path

import cv2
import pytest
import torch
from disk import full_disk

from oasis_warp.assets import asset
from oasis_warp.cli import main
from oasis_warp.cli.app import what_ran_out
from oasis_warp.cli.progress import plain_console
from oasis_warp.cli.report import measures_table
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops._runtime import launch

PHOTOS = Path(__file__).parents[1] / "data" / "photos"
FILES = {"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"}
OASIS = [sys.executable, "-m", "oasis_warp"]


def oasis(*arguments, **options):
    return subprocess.run([*OASIS, *map(str, arguments)], capture_output=True, text=True, **options)


def names(folder):
    return {path.name for path in folder.iterdir()}


def assert_refused(code, said, folder, expected, left=frozenset()):
    """Exit code 2, one sentence, no traceback, nothing written."""
    assert code == 2
    sentences = [line for line in said.splitlines() if line.startswith("oasis: ")]
    assert len(sentences) == 1
    assert expected in sentences[0]
    assert "Traceback" not in said
    assert names(folder) == set(left)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder that one run on an ordinary photo has filled."""
    folder = tmp_path_factory.mktemp("finished") / "out"
    done = oasis("reconstruct", PHOTOS / "palm_open_left_02.png", "-o", folder, "--size", 256, "--steps", 10)
    assert done.returncode == 0, done.stderr
    return folder, done


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_photo_becomes_an_avatar_that_looks_like_it(finished):
    folder, done = finished
    assert names(folder) == FILES
    report = json.loads((folder / "report.json").read_text())
    assert report["hand"]["side"] == "left"
    assert report["errors"]["input_psnr_db"] > 20
    assert report["errors"]["mask_iou"] > 0.85
    stages = {"read", "landmarks", "fit", "prior", "adaptation", "summary", "turntable", "save"}
    assert stages <= report["seconds"].keys()
    assert report["prior"]["name"] == "learned" and len(report["prior"]["sha256"]) == 64
    assert "left hand" in done.stdout
    assert "adaptation" in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_avatar_can_be_drawn_and_animated_without_its_photo(finished, tmp_path):
    avatar = finished[0] / "avatar.safetensors"
    assert oasis("render", avatar, "-o", tmp_path / "fist.png", "--pose", "fist", "--size", 128).returncode == 0
    picture = cv2.imread(str(tmp_path / "fist.png"))
    assert picture is not None
    assert picture.shape == (128, 128, 3)
    assert 0.05 < (picture < 230).any(-1).mean() < 0.9
    film = tmp_path / "film.gif"
    assert oasis("animate", avatar, "-o", film, "--motion", "poses", "--seconds", 0.5, "--size", 96).returncode == 0
    assert names(tmp_path) == {"fist.png", "film.gif"}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_photo_without_a_hand_is_refused(tmp_path):
    done = oasis("reconstruct", PHOTOS / "no_hand_cup_15.jpg", "-o", tmp_path / "out")
    assert_refused(done.returncode, done.stderr, tmp_path, "no_hand_cup_15.jpg")


@pytest.mark.slow
def test_a_photo_without_the_hand_that_is_asked_for_is_refused(tmp_path, capfd):
    code = main(["reconstruct", str(PHOTOS / "backs_two_left_05.jpg"), "-o", str(tmp_path / "out"), "--hand", "7"])
    assert_refused(code, capfd.readouterr().err, tmp_path, "backs_two_left_05.jpg")


@pytest.mark.slow
def test_a_wrong_keypoints_file_is_refused(tmp_path, capfd):
    points, photo = tmp_path / "points.json", PHOTOS / "palm_open_left_02.png"
    points.write_text("{")
    code = main(["reconstruct", str(photo), "-o", str(tmp_path / "out"), "--keypoints", str(points)])
    assert_refused(code, capfd.readouterr().err, tmp_path, "points.json", {"points.json"})


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("stage", "stop"), [("landmarks", signal.SIGINT), ("fit", signal.SIGTERM)])
def test_a_stop_midway_leaves_nothing(tmp_path, stage, stop):
    def heed_interrupts():  # a shell's background jobs, such as a CI's, inherit an ignored Ctrl-C
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(
        [*OASIS, "reconstruct", str(PHOTOS / "palm_open_left_02.png"), "-o", str(tmp_path / "out")],
        stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=heed_interrupts,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith(f"{stage}: "):
                break
        time.sleep(0.5)  # into the next stage
        process.send_signal(stop)
        errors = process.stderr.read()
    assert process.returncode == 130
    assert errors.endswith("oasis: stopped, nothing was written.\n")
    assert names(tmp_path) == set()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_example_runs_without_arguments(tmp_path):
    example = Path(__file__).parents[2] / "examples" / "reconstruct.py"
    done = subprocess.run([sys.executable, example], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert names(tmp_path) == {"fist.png", "fist.safetensors"}
    assert "left hand" in done.stdout


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
    make = inspect.unwrap(ReconstructConfig.__init__)  # below the shape checks
    few = {**make.__kwdefaults__, "steps": 2, "size": 256}  # the example above has as many as a user
    monkeypatch.setattr(make, "__kwdefaults__", few)
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
    def fail(*_, **__):
        torch.empty(1 << 60, dtype=torch.uint8)

    monkeypatch.setattr(Avatar, "orbit_camera", fail)
    assert main(["render", str(avatar_file), "-o", str(tmp_path / "x.png")]) == 2
    assert capsys.readouterr().err == "oasis: the memory of cpu is full; use smaller sizes, or fewer at once.\n"
    assert what_ran_out(MemoryError()) == what_ran_out(torch.OutOfMemoryError("CUDA error: out of memory"))
    assert what_ran_out(RuntimeError("a bug")) is None


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("blend: CUDA error 719: unspecified launch failure"), "cpu failed, nothing was written"),
        (OSError(24, "Too many open files"), "too many files are open"),
        (OSError(36, "File name too long"), "the name of a file is too long"),
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


SMALL = ["--size", "64", "--steps", "2", "--prior", "none", "--unseen", "plain"]


def process_of(*arguments, **environment):
    """A process of ours with at most 32 open files."""
    limited = ["sh", "-c", 'ulimit -n 32; exec "$@"', "sh", *OASIS, *map(str, arguments)]
    given = {name: value for name, value in {**os.environ, **environment}.items() if value}
    return subprocess.Popen(limited, env=given, stdout=subprocess.DEVNULL)


def reconstructing(out, **environment):
    """A process that makes a small avatar of the bundled photo."""
    with resources.as_file(asset("photos", "palm_open_left_02.png")) as photo:
        return process_of("reconstruct", photo, "-o", out, *SMALL, **environment)


@pytest.mark.slow
def test_without_a_home_few_descriptors_do_no_harm(tmp_path):
    process = reconstructing(tmp_path / "out", HOME="", OASIS_WARP_CACHE="")
    assert (process.wait(), (tmp_path / "out" / "avatar.safetensors").is_file()) == (0, True)


@pytest.mark.slow
@pytest.mark.parametrize("home", ["/proc", "missing"])
def test_a_home_that_is_missing_or_cannot_be_written_does_no_harm(avatar_file, tmp_path, home):
    where = str(tmp_path / home) if home == "missing" else home
    picture = tmp_path / "a.png"
    process = process_of("render", avatar_file, "-o", picture, "--size", 16, HOME=where, OASIS_WARP_CACHE="")
    assert (process.wait(), picture.is_file()) == (0, True)


def cpu_seconds(*processes):
    """What each has used when it ends, which must be well."""
    ends = [os.wait4(process.pid, 0)[1:] for process in processes]
    for process, (status, _) in zip(processes, ends, strict=True):
        process.returncode = os.waitstatus_to_exitcode(status)
    assert [process.returncode for process in processes] == [0] * len(processes)
    return [used.ru_utime + used.ru_stime for _, used in ends]


SPINNING = 1.6
"""CPU time with several threads over that with one. On two cores at a load of ten it was 2.6 while torch's threads spun
through the pictures of `oasis reconstruct`, and is 1.15 since they sleep; processes on one core add to both."""


@pytest.mark.slow
def test_processes_at_once_write_one_output_one_after_the_other_and_their_waiting_threads_sleep(tmp_path):
    out, alone = tmp_path / "out", tmp_path / "alone"
    (used,) = cpu_seconds(reconstructing(alone, OMP_NUM_THREADS="1"))
    both = cpu_seconds(*[reconstructing(out, OMP_NUM_THREADS="4") for _ in range(2)])
    assert max(both) < SPINNING * used, (both, used)
    whole = {"avatar.safetensors", "quality.png", "report.json", "summary.png", "turntable.mp4"}
    assert names(out) == whole and names(tmp_path) == {"out", "alone"}
    Avatar.load(out / "avatar.safetensors")
