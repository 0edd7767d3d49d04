"""`oasis evaluate`: refusals in words, both data sets on a small scale, and what real photos are compared by."""

import json
import re

import cv2
import numpy as np
import pytest
import torch

from oasis_warp import reconstruction
from oasis_warp.adaptation.skin_tone import SkinTone
from oasis_warp.adaptation.unseen_skin import OwnSkin
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.avatar.quality import SurfaceQuality
from oasis_warp.cli import evaluate as command
from oasis_warp.cli import main
from oasis_warp.cli.developer_options import Evaluate
from oasis_warp.cli.progress import BAD_INPUT, INTERRUPTED
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Render
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.hand_crop import crop_hand
from oasis_warp.evaluation import look_measures, looks, real_hands, same_hand, views
from oasis_warp.evaluation.methods import ONE_SHOT, RAW, Method
from oasis_warp.evaluation.metrics import HIDDEN_CONTRASTS, HIDDEN_LIKENESS
from oasis_warp.evaluation.same_hand import compare_pairs, compare_with_photo, photos_of_hands, summarise_pairs
from oasis_warp.evaluation.summary import read_result
from oasis_warp.fitted_avatar import draw_as_photo
from oasis_warp.reconstruction import Reconstruction, reconstruct

SMALL = ReconstructConfig(size=96)


class KnownEstimator(HandEstimator):
    """Knows where the hand of `scene` is, and that pictures called `no_hand` show none."""

    def __init__(self, fit):
        self.known, self.shapes = fit, []

    def find(self, photo):
        return [] if photo.name.startswith("no_hand") else [self.known.landmarks]

    def fit(self, photo, landmarks, shape=None, force=False):
        self.shapes.append(shape)
        return self.known


def in_light(photo, *gains):
    return photo._replace(rgb=(photo.rgb * torch.tensor(gains)).to(torch.uint8))


def score_in(scene, photo, avatar=None):
    _, fit, made = scene
    avatar = avatar or made
    crop = crop_hand(photo, fit, avatar.surface_offsets, SMALL)
    return compare_with_photo(avatar, draw_as_photo(avatar, crop, fit.pose), crop, fit.pose)


def test_an_avatar_is_like_the_photo_that_it_was_made_of(scene):
    score = score_in(scene, scene[0])
    assert score.psnr > 34 and score.psnr_plain > 32 and score.ssim_quarter > 0.99
    assert score.overlap > 0.7  # its few Gaussians leave gaps
    assert len(score.region_errors) > 0 and max(score.region_errors.values()) < 0.03


def test_another_light_is_matched_by_one_gain_a_channel(scene):
    score = score_in(scene, in_light(scene[0], 0.9, 0.7, 0.5))
    assert score.psnr > 34 and score.psnr_plain < 20
    assert max(score.region_errors.values()) < 0.03


def test_a_wrong_colour_on_half_the_hand_is_found(scene, hand):
    avatar = scene[2]
    half = hand.template[avatar.gaussians.vertex_index, :1] < -0.1
    wrong = type(avatar)(
        side=avatar.side, shape=avatar.shape, surface_offsets=avatar.surface_offsets,
        gaussians=avatar.gaussians._replace(colors=avatar.gaussians.colors * torch.where(half, 0.5, 1.0)),
        source_pose=avatar.source_pose, source_camera=avatar.source_camera,
    )  # fmt: skip
    score, right = score_in(scene, scene[0], wrong), score_in(scene, scene[0])
    assert score.psnr < right.psnr - 10
    assert score.ssim_quarter < right.ssim_quarter
    assert score.overlap == right.overlap


def test_contrast_is_compared_by_size_of_detail_and_only_in_pictures_of_its_size(scene):
    """A blurred avatar has lost the fine detail of the photo, and keeps the coarse; an equal one has all of it."""
    photo, fit, avatar = scene
    crop = crop_hand(photo, fit, avatar.surface_offsets, ReconstructConfig(size=256))
    rough = np.random.default_rng(0).normal(0.6, 0.1, (256, 256, 1)).astype(np.float32)
    crop = crop._replace(image=torch.from_numpy(rough).clamp(0, 1).expand(-1, -1, 3))
    blurred = torch.from_numpy(cv2.GaussianBlur(rough, (0, 0), 2.0))[..., None].expand(-1, -1, 3)
    equal, soft = (
        compare_with_photo(avatar, Render(image, torch.ones(256, 256)), crop, fit.pose).contrasts
        for image in (crop.image, blurred)
    )
    assert equal is not None and soft is not None and equal == pytest.approx([1.0] * 4)
    assert soft[0] < 0.1 < soft[1] < soft[2] < 0.7 < soft[3] < 1.0
    assert score_in(scene, photo).contrasts is None


def test_every_ordered_pair_is_compared_and_the_second_photo_is_fitted_with_the_firsts_shape(scene):
    photo, fit, avatar = scene
    estimator = KnownEstimator(fit)
    photos = {name: (photo, fit.landmarks) for name in "abc"}
    pairs = list(compare_pairs(estimator, photos, {"a": {"x": avatar, "y": avatar}, "b": {"x": avatar}}, SMALL))
    assert [(pair.source, pair.target) for pair in pairs] == [("b", "a"), ("a", "b"), ("a", "c"), ("b", "c")]
    assert list(pairs[1].scores) == ["x", "y"] and list(pairs[0].scores) == ["x"]
    assert all(torch.equal(shape, avatar.shape) for shape in estimator.shapes)
    assert pairs[0].photo.shape == pairs[0].drawn["x"].shape == (96, 96, 3)


def test_a_left_hand_is_no_target_of_a_right_one(scene):
    photo, fit, avatar = scene
    left = KnownEstimator(fit._replace(side="left"))
    photos = {name: (photo, fit.landmarks) for name in "ab"}
    assert list(compare_pairs(left, photos, {"a": {"x": avatar}, "b": {}}, SMALL)) == []


def pair(target, prior, stage, psnr, error=None):
    record = {"hand": "h", "source": "s", "target": target, "prior": prior, "stage": stage, "psnr": psnr,
              "psnr_plain": psnr, "ssim_quarter": 0.5, "overlap": 0.9}  # fmt: skip
    return record if error is None else record | {"error": error, "error_palm": error}


def test_the_share_of_pairs_on_which_one_shot_is_better():
    pairs = [
        pair("a", "mean", "one_shot", 20.0, 0.2), pair("b", "mean", "one_shot", 21.0),
        pair("c", "mean", "one_shot", 9.0),
        pair("a", "learned", "one_shot", 22.0, 0.1), pair("b", "learned", "one_shot", 20.0, 0.1),
        pair("c", "learned", "one_shot", 10.0),
    ]  # fmt: skip
    mean, learned = summarise_pairs(pairs)
    assert (mean["pairs"], mean["psnr"], mean["error_palm"], mean["error_nail"]) == (3, 20.0, 0.2, None)
    assert mean["beaten_psnr"] == pytest.approx(2 / 3)
    assert mean["beaten_error"] == 1.0 and mean["beaten_ssim_quarter"] == 0.0
    assert learned["beaten_psnr"] is None


@pytest.fixture(scope="module")
def made():
    """Reconstructions by photo and options."""
    return {}


@pytest.fixture
def hands(scene, made, tmp_path, monkeypatch):
    """A folder with two photos of one hand and one of another, one of them of no hand; equal photos are made once."""

    def reconstruct_once(photo, config, *, prior):
        key = photo.rgb.numpy().tobytes(), config, prior.about["name"]
        if key not in made:
            made[key] = reconstruct(photo, config, prior=prior)
        return made[key]

    monkeypatch.setattr(same_hand, "reconstruct", reconstruct_once)
    folder = tmp_path / "hands"
    for name in ("mine/a.png", "mine/b.png", "mine/no_hand.png", "single/a.png", "empty/note.txt"):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            write_picture(path, scene[0].rgb)
        else:
            path.write_text("nothing to see")
    for module in (same_hand, reconstruction):
        monkeypatch.setattr(module, "HandEstimator", lambda *_: KnownEstimator(scene[1]))
    return folder


def test_the_avatars_that_are_compared_are_those_of_reconstruct(hands, scene, hand):
    priors, few = {"mean": MeanPrior(hand)}, ReconstructConfig(size=64, steps=1)
    made, shown = same_hand.make_avatars(scene[0], priors, [Method("mean", RAW), Method("mean", ONE_SHOT)], few)
    shipped = reconstruct(scene[0], ReconstructConfig(steps=1), prior=priors["mean"]).avatar
    ours = made["mean one-shot"].gaussians
    assert all(torch.equal(a, b) for a, b in zip(ours, shipped.gaussians, strict=True) if a is not None)
    assert all(torch.equal(avatar.surface_offsets, shipped.surface_offsets) for avatar in made.values())
    assert not torch.equal(made["mean raw"].gaussians.colors, ours.colors) and shown.shape == (64, 64, 3)


def test_photos_of_the_same_hand_are_measured_and_the_run_is_not_done_twice(hands, tmp_path, capsys, monkeypatch):
    assert list(photos_of_hands(hands)) == ["mine"]
    out = tmp_path / "found"
    arguments = ["evaluate", "--dataset", "same-hand", str(hands), "--out", str(out), "--prior", "none", "--steps", "1",
                 "--size", "64"]  # fmt: skip
    assert main(arguments) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "2 ordered pairs" in output and "photos left out: 1" in output
    assert re.search(r"mean one-shot │ \d\d\.\d\d", output)
    found = json.loads((out / "metrics.json").read_text())
    assert {(p["source"], p["target"]) for p in found["pairs"]} == {("a.png", "b.png"), ("b.png", "a.png")}
    assert all(p["psnr"] > 25 for p in found["pairs"])
    assert list(found["left_out"]) == ["mine/no_hand.png"]
    files = {"evaluation.json", "metrics.json", "sheet.png", "hands", "commands.txt"}
    assert {path.name for path in out.iterdir()} == files
    assert (out / "commands.txt").read_text().startswith("oasis evaluate --dataset same-hand ")
    monkeypatch.setattr(same_hand, "HandEstimator", lambda *_: pytest.fail("measured again"))
    assert main(arguments) == 0
    assert json.loads((out / "metrics.json").read_text()) == found


def test_looks_are_measured_and_drawn_and_the_run_is_not_done_twice(hands, scene, tmp_path, capsys, monkeypatch):
    _, fit, avatar = scene
    kinds = [view.kind for view in views.views_of(avatar)]
    assert [kinds.count(kind) for kind in ("input", "side", "pose", "back")] == [1, 8, 8, 1]
    monkeypatch.setattr(views, "AZIMUTHS", (0, 180))
    monkeypatch.setattr(views, "POSES", ("open",))
    monkeypatch.setattr(looks, "IN_OVERVIEW", (0, 4))
    shown = torch.linspace(0, 1, len(avatar.rest.vertices))
    even = torch.full_like(avatar.rest.vertices, 0.5).log()
    skin = OwnSkin(SkinTone(even, even[0], 0.05), 1.0, 1.0)
    made = Reconstruction(
        avatar, fit, {}, {}, {"input_psnr_inner_db": 30.0, "seen_percent": 40.0}, (), SurfaceQuality(shown, 1 - shown),
        skin,
    )  # fmt: skip

    def ship(photo, config, prior):
        assert config == ReconstructConfig(steps=1)  # all else as it ships
        if photo.name.startswith("no_hand"):
            raise InputError(f"{photo.name}: found no hand.")
        return made

    monkeypatch.setattr(looks, "reconstruct", ship)
    for module in (look_measures, real_hands):
        monkeypatch.setattr(module, "hand_features", lambda image, mask: {"half": [0.0]})  # takes seconds
    monkeypatch.setattr(looks, "HandEstimator", lambda *_: KnownEstimator(fit))
    for name in ("first.png", "no_hand.png"):
        (hands / name).write_bytes((hands / "mine" / "a.png").read_bytes())
    arguments = ["evaluate", str(hands), "--dataset", "looks", "--out", str(tmp_path / "found"), "--prior", "none",
                 "--steps", "1"]  # fmt: skip
    assert main(arguments) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "of 1 avatars" in output and "too few real hands" in output and "photos left out: 1" in output
    found = json.loads((tmp_path / "found" / "metrics.json").read_text())
    record = found["photos"]["first.png"]
    assert record["contrast"]["seen"][0] > 0 and record["haze"] >= 0 and record["lpips"] is None
    assert record["contrast"]["painted_back"][0] > record["contrast"]["photo_back"][0]  # the photo is of a smooth hand
    assert list(found["left_out"]) == ["no_hand.png"] and found["kernel_distance"] == []
    assert read_photo(tmp_path / "found" / "sheets" / "first.jpg").rgb.shape == (512, 6 * 512 + 10, 3)
    damaged = [tmp_path / "found" / name for name in ("real/mine_a.json", "sheets/first.jpg")]
    for file in damaged:
        file.write_bytes(file.read_bytes()[:99])
    assert main(arguments) == 0
    assert json.loads((tmp_path / "found" / "metrics.json").read_text()) == found
    assert all(len(file.read_bytes()) > 99 for file in damaged)
    monkeypatch.setattr(looks, "reconstruct", lambda *arguments, **options: pytest.fail("made again"))
    assert main(arguments) == 0
    assert json.loads((tmp_path / "found" / "metrics.json").read_text()) == found


@pytest.mark.parametrize(
    "text", ["", "[", "[]", "7", "null", '{"psnr": 1}', '[{"psnr": 1, "hand": 2}, {}]', "[" * 10**5, "\0", "[1]", "{}"]
)
def test_damaged_results_are_measured_again(tmp_path, text):
    file = tmp_path / "one.json"
    assert read_result(file, ("psnr", "hand")) is None
    file.write_text(text)
    assert read_result(file, ("psnr", "hand")) is None
    for whole in ({"psnr": 1, "hand": 2}, [{"psnr": 1, "hand": 2, "more": 3}], {"left_out": "no hand"}):
        file.write_text(json.dumps(whole))
        assert read_result(file, ("psnr", "hand")) == whole


@pytest.mark.parametrize(
    ("dataset", "stages"),
    [("same-hand", ["avatars of mine", "pairs of mine"]), ("looks", ["real hands", "avatars"]),
     ("synthetic", ["evaluation"])],
)  # fmt: skip
def test_one_bar_knows_all_stages_of_an_evaluation(hands, dataset, stages):
    (hands / "first.png").write_bytes((hands / "mine" / "a.png").read_bytes())
    options = Evaluate(folder=None if dataset == "synthetic" else hands, dataset=dataset, out=hands)
    assert [step.stage for step in command.plan(options, 2)] == stages


def test_a_folder_of_photos_is_one_hand_and_photos_of_one_stem_are_two(hands):
    mine = hands / "mine"
    (mine / "b.png").rename(mine / "a.webp")
    assert photos_of_hands(mine) == {"mine": [mine / "a.png", mine / "a.webp", mine / "no_hand.png"]}
    (hands / "c.png").mkdir()
    assert list(photos_of_hands(hands)) == ["mine"]


def test_folders_without_pairs_are_refused_in_one_sentence(hands, tmp_path, capsys):
    (hands / "mine" / "a.png").unlink()
    (hands / "mine" / "b.png").rename(hands / "mine" / "no_hand_either.png")
    for folder, words in (
        (tmp_path / "none", "found no such folder"), (hands / "mine" / "no_hand.png", "found a file"),
        (hands / "single", "found none"), (hands, "no hand has two photos"),
    ):  # fmt: skip
        options = ["--dataset", "same-hand", "--out", str(tmp_path / "found"), "--prior", "none"]
        assert main(["evaluate", str(folder), *options]) == BAD_INPUT
        output = [line for line in capsys.readouterr().err.splitlines() if line.startswith("oasis: ")]
        assert len(output) == 1 and words in output[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--dataset", "same-hand"], "expected a folder of photos, or of subfolders, one per hand; name it"),
        (["photos"], "photos: synthetic hands need no folder"),
        (["--people", "0"], "--people: expected 1 or more, got 0"),
        (["--targets", "9"], "--targets: expected 1 to 8, got 9"),
        (["--size", "100"], "--size: expected 64 to 1024 pixels in steps of 16, got 100"),
        (["--steps", "-1"], "--steps: expected 0 or more, got -1"),
        (["--prior", "nowhere.safetensors"], "nowhere.safetensors: expected a network's weights, found no such file"),
        (["--lpips", "a.pth", "b.pth"], "a.pth: expected AlexNet, found no such file"),
        (["photos", "--dataset", "same-hand", "--lpips", "a.pth", "b.pth"], "--lpips: is not measured on photos of"),
        (["photos", "--dataset", "looks", "--size", "512"], "--size: looks are measured in pictures of 256 pixels"),
        (["--dataset", "looks"], "--dataset looks: expected a folder of photos; name it"),
        (["photos", "--dataset", "looks"], "photos: expected a folder with photos of hands, found none there"),
    ],
)
def test_wrong_options_are_one_sentence(tmp_path, capsys, arguments, words):
    out = tmp_path / "found"
    prior = [] if "--prior" in arguments else ["--prior", "none"]
    assert main(["evaluate", "--out", str(out), *prior, *arguments]) == BAD_INPUT
    output = capsys.readouterr().err
    assert words in output and output.count("\n") == 1
    assert not out.exists()


def test_ctrl_c_keeps_what_is_whole(tmp_path, monkeypatch, capsys):
    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "evaluate_people", stopped)
    assert main(["evaluate", "--out", str(tmp_path / "found"), "--prior", "none"]) == INTERRUPTED
    assert "finished parts stay in" in capsys.readouterr().err


def test_a_machine_without_a_gpu_is_told_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["evaluate", "--out", str(tmp_path / "found"), "--device", "cuda"]) == BAD_INPUT
    assert "torch finds no CUDA device" in capsys.readouterr().err


def test_synthetic_hands_are_measured_and_printed(tmp_path, monkeypatch, capsys):
    rows = [
        {"group": group, "light": light, "noise": noise, "colors": colors, "prior": "mean", "stage": "calibrated",
         "people": 1, "pictures": 4, "psnr": 21.5 + noise, "gain": 0.0, "gain_error": None, "better": 0.0,
         "psnr_inner": 25.0, "psnr_visible": None, "psnr_hidden": 24.0, "psnr_stretched": None,
         "psnr_squeezed": 20.0, "psnr_unchanged": 24.0, "ssim": 0.9, "ssim_box": 0.8, "ssim_mask": 0.7, "lpips": None,
         **dict.fromkeys((*HIDDEN_CONTRASTS, *HIDDEN_LIKENESS), 0.5)}
        for group in ("ordinary", "tattoo", "ring") for light in ("same", "studio", "wild")
        for noise in (0.0, 0.5, 1.0, 2.0, 4.0) for colors in ("raw", "matched")
    ]  # fmt: skip
    asked = []

    def found(priors, config, out, device, **options):
        asked.append((list(priors), config.people, config.capture.size, config.adapt.texture_steps, str(device)))
        return {"summary": rows}

    monkeypatch.setattr(command, "evaluate_people", found)
    options = ["--people", "3", "--size", "128", "--steps", "5", "--prior", "none"]
    assert main(["evaluate", "--out", str(tmp_path / "found"), *options]) == 0
    output = capsys.readouterr().out
    assert asked == [(["mean"], 3, 128, 5, "cpu")]
    assert output.count("mean calibrated") == 9 * 2 + 2 + 1 and "Skin that the photo hides" in output
    assert "LPIPS: no weights given" in output
    assert "The same people with a tattoo" in output and "matched" in output and "visible" not in output
    assert re.search(r"mean calibrated .*21\.50.*22\.00.*22\.50.*23\.50.*25\.50", output)


def test_one_photo_of_a_hand_is_no_pair(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.jpg").touch()
    with pytest.raises(InputError, match="two photos of one hand or more, .* found none"):
        photos_of_hands(tmp_path)
