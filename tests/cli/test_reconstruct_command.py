import json
import sys
from pathlib import Path

import cv2
import pytest
import torch
from disk import full_disk

from oasis_warp.cli import main, summary
from oasis_warp.cli import reconstruct as command
from oasis_warp.core.errors import InputError
from oasis_warp.data.avatar_file import load_avatar
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.reconstruction import FusedReconstruction, PhotoOfHand

FILES = {"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"}


@pytest.fixture(autouse=True)
def small_pictures(request, monkeypatch):
    """Pictures are small; tests that do not ask for them to be `drawn` look at folders alone, and get grey ones."""
    monkeypatch.setattr(summary, "WIDTH", 480)
    monkeypatch.setattr(summary, "VIEWS", 2)
    monkeypatch.setattr(summary, "POSES", ("fist", "ok"))
    monkeypatch.setattr(command, "TURNTABLE_FRAMES", 2)
    monkeypatch.setattr(command, "TURNTABLE_SIZE", 64)
    if "drawn" not in request.fixturenames:
        grey = torch.full((64, 64, 3), 128, dtype=torch.uint8)
        for name, made in (("draw_summary", grey), ("draw_quality", grey), ("turntable", [grey, grey])):
            monkeypatch.setattr(command, name, lambda *_, made=made, **__: made)


@pytest.fixture
def drawn():
    """For tests of what pictures show, or of how large their files are."""


@pytest.fixture(scope="module")
def found():
    """Hands found in the real photos, by name."""
    return {}


@pytest.fixture(autouse=True)
def quick_search(monkeypatch, found):
    """Real photos are searched once, drawn ones show no hand."""

    class Remembering(HandEstimator):
        def find(self, photo):
            if photo.name.endswith(".jpg") and photo.name not in found:
                found[photo.name] = super().find(photo)
            return found.get(photo.name, [])

    monkeypatch.setattr(command, "HandEstimator", Remembering)


@pytest.fixture
def pipeline(monkeypatch, made):
    """The pipeline, already knowing the answer; a photo whose name has "bad" in it is refused."""

    def answer(photo, config, *, keypoints, perceptual, progress):
        calls.append((photo, config, keypoints, perceptual))
        if "bad" in photo.name:
            raise InputError(f"{photo.name}: no hand was found; give another photo.")
        if "stop" in photo.name:
            raise KeyboardInterrupt
        progress("landmarks", 1, 1)
        return made

    calls = []
    monkeypatch.setattr(command, "reconstruct", answer)
    return calls


@pytest.fixture
def photo_file(tmp_path, scene):
    def write(name="hand.png"):
        write_picture(tmp_path / name, scene[0].rgb)
        return str(tmp_path / name)

    return write


def names(folder):
    return {path.name for path in folder.iterdir()}


def test_one_photo_fills_the_folder_itself(pipeline, drawn, photo_file, tmp_path, capsys):
    assert main(["reconstruct", photo_file(), "-o", str(tmp_path / "out")]) == 0
    assert names(tmp_path / "out") == FILES
    assert names(tmp_path) == {"hand.png", "out"}
    captured = capsys.readouterr()
    assert "hand.png: right hand" in captured.out
    assert "30.0 dB" in captured.out
    assert "landmarks: " in captured.err


def test_lpips_is_measured_with_the_weights_that_are_given(pipeline, photo_file, tmp_path, monkeypatch, capsys):
    files = [str(tmp_path / name) for name in ("alexnet-owt-7be5be79.pth", "alex.pth")]
    command_line = ["reconstruct", photo_file(), "-o", str(tmp_path / "out"), "--lpips", *files]
    assert main(command_line) == 2 and not pipeline
    assert "alexnet-owt-7be5be79.pth: expected AlexNet, found no such file; download" in capsys.readouterr().err
    monkeypatch.setattr(command, "load_lpips", lambda *files, allow_download: torch.nn.Identity())
    assert main(command_line) == 0
    assert isinstance(pipeline[0][3], torch.nn.Identity)


def test_what_was_written_can_be_read(pipeline, drawn, photo_file, tmp_path):
    main(["reconstruct", photo_file(), "-o", str(tmp_path / "out"), "--seed", "5", "--steps", "7", "--force"])
    _, header = load_avatar(tmp_path / "out" / "avatar.safetensors")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert header["side"] == report["hand"]["side"] == "right"
    assert {"seed": 5, "steps": 7, "force": True, "hand": "largest"}.items() <= report["config"].items()
    assert read_photo(tmp_path / "out" / "summary.png").rgb.shape[1] == 480
    capture = cv2.VideoCapture(str(tmp_path / "out" / "turntable.mp4"))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 2


def test_options_reach_the_pipeline(pipeline, photo_file, tmp_path):
    keypoints = tmp_path / "points.json"
    main(["reconstruct", photo_file(), "-o", str(tmp_path / "out"), "--hand", "1", "--keypoints", str(keypoints)])
    photo, config, got, _ = pipeline[0]
    assert (photo.name, config.hand, got) == ("hand.png", 1, keypoints)


def test_the_prior_is_chosen_and_told(pipeline, photo_file, weights_file, tmp_path, capsys):
    for number, prior in enumerate(("learned", "none", str(weights_file))):
        assert main(["reconstruct", photo_file(), "-o", str(tmp_path / "out"), "--prior", prior]) == 0
        assert str(pipeline[number][1].prior) == prior
        report = json.loads((tmp_path / "out" / "report.json").read_text())
        assert report["config"]["prior"] == prior
        assert report["prior"] == {"name": "learned", "sha256": "0a1b", "step": 7}  # what the pipeline says it was
    assert "prior learned" in capsys.readouterr().out


@pytest.mark.parametrize("content", [None, b"", b"no weights"])
def test_a_file_that_is_no_prior_is_refused_once_and_before_any_photo_is_read(
    pipeline, photo_file, tmp_path, capsys, content
):
    weights = tmp_path / "own.safetensors"
    if content is not None:
        weights.write_bytes(content)
    photos = [photo_file("a.png"), photo_file("b.png")]
    assert main(["reconstruct", *photos, "-o", str(tmp_path / "out"), "--prior", str(weights)]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith(f"oasis: {weights}: expected a network's weights")
    assert errors.count("oasis:") == 1
    assert not pipeline and not (tmp_path / "out").exists()


def test_several_photos_get_a_folder_each(pipeline, photo_file, tmp_path):
    photos = [photo_file("a.png"), photo_file("b.png")]
    assert main(["reconstruct", *photos, "-o", str(tmp_path / "out")]) == 0
    assert names(tmp_path / "out") == {"a", "b"}
    assert names(tmp_path / "out" / "a") == names(tmp_path / "out" / "b") == FILES


def test_a_photo_that_fails_does_not_stop_the_others(pipeline, photo_file, tmp_path, capsys):
    photos = [photo_file("a.png"), photo_file("bad.png"), str(tmp_path / "none.png"), photo_file("b.png")]
    assert main(["reconstruct", *photos, "-o", str(tmp_path / "out")]) == 2
    assert names(tmp_path / "out") == {"a", "b"}
    errors = capsys.readouterr().err
    assert "oasis: bad.png: no hand was found" in errors
    assert "none.png: expected a photo, found no such file" in errors
    assert errors.endswith(f"oasis: 2 of 4 photos are done; failed: {photos[1]}, {photos[2]}.\n")


@pytest.fixture
def fusion(monkeypatch, made, scene):
    """The fusion, already knowing the answer; a photo whose name has "bad" in it is refused."""

    def answer(photos, config, *, perceptual, progress):
        for photo in photos:
            if "bad" in photo.name:
                raise InputError(f"{photo.name}: shows a left hand, the other photos a right one; leave it out.")
        calls.append(photos)
        shares = {"seen_percent": 30.0, "best_percent": 20.0, "input_psnr_db": 25.0}
        errors = {"reprojection_percent": 1.0, "mask_iou": 0.9, **shares}
        about = tuple(PhotoOfHand(photo.name, scene[1], (1.0, 1.0, 1.0), errors, None) for photo in photos)
        return FusedReconstruction(
            made.avatar, about, made.prior, {"fusion": 1.0}, {"seen_percent": 50.0}, ("b.png: small",),
            made.quality,
        )  # fmt: skip

    calls = []
    monkeypatch.setattr(command, "reconstruct_same_hand", answer)
    return calls


HAND = Path(__file__).parents[1] / "data" / "photos" / "same_hand" / "a1_wood_right"
PALM, BACK = str(HAND / "02_flat_closed.jpg"), str(HAND / "03_flat_closed_back.jpg")
FINGERS = str(HAND / "08_two_fingers.jpg")


@pytest.mark.parametrize(("answer", "is_one"), [("\n", True), ("y\n", True), ("n\n", False), ("", False)])
def test_palm_and_back_become_one_avatar_when_the_user_says_so(
    pipeline, fusion, tmp_path, monkeypatch, capsys, answer, is_one
):
    for stream in ("stdin", "stderr"):
        monkeypatch.setattr(getattr(sys, stream), "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stdin, "readline", lambda: answer, raising=False)
    assert main(["reconstruct", PALM, BACK, "-o", str(tmp_path / "out")]) == 0
    assert "the palm and the back of a right hand. Is it one hand" in capsys.readouterr().err
    assert names(tmp_path / "out") == (FILES if is_one else {"02_flat_closed", "03_flat_closed_back"})


def test_without_a_terminal_palm_and_back_stay_apart_and_the_option_is_named(pipeline, tmp_path, capsys):
    assert main(["reconstruct", PALM, BACK, "-o", str(tmp_path / "out")]) == 0
    assert "--same-hand makes one avatar of them" in capsys.readouterr().err
    assert len(pipeline) == 2


def test_two_palms_are_not_asked_about(pipeline, tmp_path, capsys):
    assert main(["reconstruct", PALM, FINGERS, "-o", str(tmp_path / "out")]) == 0
    assert "same-hand" not in capsys.readouterr().err


def test_several_photos_of_the_same_hand_make_one_avatar(fusion, drawn, photo_file, tmp_path, capsys):
    photos = [photo_file(name) for name in ("a.png", "b.png", "c.png")]
    assert main(["reconstruct", *photos, "--same-hand", "-o", str(tmp_path / "out")]) == 0
    assert names(tmp_path / "out") == FILES
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [part["photo"]["name"] for part in report["photos"]] == ["a.png", "b.png", "c.png"]
    assert report["photos"][1]["gain"] == [1.0, 1.0, 1.0]
    assert report["warnings"] == ["b.png: small"]
    rows = read_photo(tmp_path / "out" / "summary.png").rgb.shape[0]
    printed = capsys.readouterr().out
    assert "3 photos of a right hand" in printed and "b.png" in printed and "50 %" in printed
    assert main(["reconstruct", *photos[:2], "--same-hand", "-o", str(tmp_path / "two")]) == 0
    assert read_photo(tmp_path / "two" / "summary.png").rgb.shape[0] < rows  # a row for each photo


def test_one_wrong_photo_of_the_same_hand_is_named_and_nothing_is_left(fusion, photo_file, tmp_path, capsys):
    photos = [photo_file(name) for name in ("a.png", "bad.png")]
    assert main(["reconstruct", *photos, "--same-hand", "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("oasis: bad.png: shows a left hand")
    assert names(tmp_path) == {"a.png", "bad.png"}


def test_one_photo_of_the_same_hand_is_a_photo_like_any_other(pipeline, fusion, photo_file, tmp_path):
    assert main(["reconstruct", photo_file(), "--same-hand", "-o", str(tmp_path / "out")]) == 0
    assert len(pipeline) == 1 and not fusion
    assert names(tmp_path / "out") == FILES


def test_the_same_photo_may_be_given_twice_for_the_same_hand(fusion, photo_file, tmp_path):
    photo = photo_file()
    assert main(["reconstruct", photo, photo, "--same-hand", "-o", str(tmp_path / "out")]) == 0
    assert len(fusion[0]) == 2


def test_a_failure_leaves_nothing(pipeline, photo_file, tmp_path):
    photos = [photo_file("bad.png"), photo_file("bad2.png")]
    assert main(["reconstruct", photos[0], "-o", str(tmp_path / "out")]) == 2
    assert main(["reconstruct", *photos, "-o", str(tmp_path / "out")]) == 2
    assert names(tmp_path) == {"bad.png", "bad2.png"}


def test_an_interrupt_leaves_nothing(pipeline, photo_file, tmp_path, capsys):
    assert main(["reconstruct", photo_file("stop.png"), "-o", str(tmp_path / "out")]) == 130
    assert names(tmp_path) == {"stop.png"}
    assert capsys.readouterr().err == "oasis: stopped, nothing was written.\n"


def test_an_interrupt_keeps_the_photos_that_are_done(pipeline, photo_file, tmp_path, capsys):
    photos = [photo_file("a.png"), photo_file("stop.png"), photo_file("b.png")]
    assert main(["reconstruct", *photos, "-o", str(tmp_path / "out")]) == 130
    assert names(tmp_path / "out") == {"a"}
    assert capsys.readouterr().err.endswith("oasis: stopped; 1 of 3 photos are done.\n")


def test_a_second_run_replaces_its_files_and_keeps_the_others(pipeline, photo_file, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    (out / "report.json").write_text("old")
    assert main(["reconstruct", photo_file(), "-o", str(out)]) == 0
    assert names(out) == {*FILES, "notes.txt"}
    assert (out / "notes.txt").read_text() == "mine"
    assert json.loads((out / "report.json").read_text())


def test_the_output_is_checked_before_the_work_begins(pipeline, photo_file, tmp_path, capsys):
    (tmp_path / "file").touch()
    photos = photo_file(), photo_file("a.png")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        assert main(["reconstruct", photos[0], "-o", str(out)]) == 2
        assert main(["reconstruct", *photos, "-o", str(out)]) == 2
    assert not pipeline
    assert "Traceback" not in capsys.readouterr().err
    assert names(tmp_path) == {"file", "hand.png", "a.png"}


@pytest.mark.parametrize("room", [2_000, 50_000, 150_000])
def test_a_full_disk_is_told_and_leaves_nothing(pipeline, drawn, photo_file, tmp_path, capsys, room):
    photo = photo_file()
    with full_disk(room):
        assert main(["reconstruct", photo, "-o", str(tmp_path / "out")]) == 2
    assert "free some" in capsys.readouterr().err
    assert names(tmp_path) == {"hand.png"}


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["a.png", "b.png", "--same-hand", "--keypoints", "k.json"], "--keypoints: works with one photo"),
        (["--same-hand"], "photos: expected at least one"),
        ([], "photos: expected at least one"),
        (["a/x.png", "b/x.jpg"], "would share one output folder"),
        (["a.png", "b.png", "--keypoints", "k.json"], "--keypoints: works with one photo"),
        (["a.png", "--size", "8"], "--size 8: expected 64 to 1024"),
        (["a.png", "--steps", "-1"], "--steps -1: expected 0 or more"),
        (["a.png", "--hand", "-1"], "--hand -1: expected 0 or more"),
    ],
)
def test_options_that_make_no_sense_are_refused(pipeline, tmp_path, capsys, arguments, expected):
    assert main(["reconstruct", *arguments, "-o", str(tmp_path / "out")]) == 2
    assert expected in capsys.readouterr().err
    assert names(tmp_path) == set()
