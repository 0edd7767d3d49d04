"""The command as a user runs it, with the whole pipeline: minutes, so marked slow."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest

PHOTOS = Path(__file__).parents[1] / "data" / "photos"
FILES = {"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"}
OASIS = [sys.executable, "-m", "oasis_warp"]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def oasis(*arguments, **options):
    return subprocess.run([*OASIS, *map(str, arguments)], capture_output=True, text=True, **options)


def names(folder):
    return {path.name for path in folder.iterdir()}


def assert_refused(done, folder, expected, left=frozenset()):
    """Exit code 2, one sentence, no traceback, nothing written."""
    assert done.returncode == 2
    sentences = [line for line in done.stderr.splitlines() if line.startswith("oasis: ")]
    assert len(sentences) == 1
    assert expected in sentences[0]
    assert "Traceback" not in done.stderr
    assert names(folder) == set(left)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder that one run on an ordinary photo has filled."""
    folder = tmp_path_factory.mktemp("finished") / "out"
    done = oasis("reconstruct", PHOTOS / "palm_open_left_02.png", "-o", folder, "--steps", 20)
    assert done.returncode == 0, done.stderr
    return folder, done


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


@pytest.mark.parametrize(("photo", "options"), [("no_hand_cup_15.jpg", ()), ("backs_two_left_05.jpg", ("--hand", 7))])
def test_a_photo_without_the_hand_is_refused(tmp_path, photo, options):
    done = oasis("reconstruct", PHOTOS / photo, "-o", tmp_path / "out", *options)
    assert_refused(done, tmp_path, photo)


def test_a_wrong_keypoints_file_is_refused(tmp_path):
    points = tmp_path / "points.json"
    points.write_text("{")
    done = oasis("reconstruct", PHOTOS / "palm_open_left_02.png", "-o", tmp_path / "out", "--keypoints", points)
    assert_refused(done, tmp_path, "points.json", {"points.json"})


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
    assert errors.endswith("oasis: stopped, nothing written.\n")
    assert names(tmp_path) == set()


def test_the_example_runs_without_arguments(tmp_path):
    example = Path(__file__).parents[2] / "examples" / "reconstruct.py"
    done = subprocess.run([sys.executable, example], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert names(tmp_path) == {"fist.png", "fist.safetensors"}
    assert "left hand" in done.stdout
