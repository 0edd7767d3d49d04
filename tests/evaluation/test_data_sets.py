import csv
import json
from pathlib import Path

import pytest
import torch
from datasets.trees import WRITERS

from oasis_warp.cli import main
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation.data_sets import Choice, Key, Row, Sample, choose, evaluate_data_set, misposed
from oasis_warp.evaluation.methods import RAW
from oasis_warp.evaluation.paper_tables import as_latex, letter_of, make_tables, rows_of_tables, write_tables
from oasis_warp.hand.mano import read_mano
from oasis_warp.network.config import COMPACT, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import choose_prior
from oasis_warp.network.weights_file import save_network

PHOTOS = Path(__file__).parents[1] / "data" / "photos" / "same_hand" / "a1_wood_right"
RECORD = {"psnr": 20.0, "psnr_whole": 26.0, "ssim": 0.9, "ssim_box": 0.8, "ssim_mask": 0.7, "lpips": 0.125}


class PhotosOfOneHand:
    """A stand-in for a data set: photos of the tests, where the estimator's own landmarks are the annotations."""

    def __init__(self, names, estimator):
        self.keys = [Key("a1", name) for name in names]
        self.estimator, self.left_out = estimator, {}

    def read(self, key):
        photo = read_photo(PHOTOS / f"{key.name}.jpg")
        return Sample(photo, choose_hand(self.estimator.find(photo), "largest", photo.name))


def keys(subject, count):
    return [Key(subject, f"{subject}{k:03}") for k in range(count)]


def test_photos_and_targets_are_spread_over_the_recording_of_each_person():
    chosen = choose([*keys("a", 21), *keys("b", 1)], Choice(photos=3, targets=2))
    assert [photo.name for photo, _ in chosen] == ["a000", "a010", "a020", "b000"]
    assert [key.name for key in chosen[1][1]] == ["a000", "a020"]
    assert chosen[3][1] == [chosen[3][0]]  # nothing else to compare with
    assert all(photo not in targets for photo, targets in chosen[:3])


def test_wrong_poses_are_wrong_by_as_much_as_asked_and_possible(scene_fit, hand):
    low, high = hand.pose_limits[1:].unbind(-1)
    assert misposed(hand, scene_fit, 0.0, 1) is scene_fit
    for degrees in (2.0, 10.0):
        pose = misposed(hand, scene_fit, degrees, 1).pose
        again = misposed(hand, scene_fit, degrees, 1).pose
        assert torch.equal(pose.angles, again.angles) and torch.equal(pose.orientation, again.orientation)
        assert bool(((pose.angles >= low - 1e-6) & (pose.angles <= high + 1e-6)).all())
        turn = scene_fit.pose.orientation.T @ pose.orientation
        angle = torch.rad2deg(torch.arccos((turn.diagonal().sum() - 1) / 2))
        assert 0.3 * degrees < float(angle) < 4 * degrees
        torch.testing.assert_close(pose.orientation @ pose.orientation.T, torch.eye(3), atol=1e-5, rtol=0)


@pytest.fixture
def scene_fit(hand):
    from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks

    pose = HandPose(torch.zeros(15, 3), torch.eye(3), torch.tensor([0.0, 0.0, 0.5]))
    camera = Camera(torch.eye(4), torch.eye(3), 8, 8)
    landmarks = Landmarks(torch.zeros(21, 2), None, "right", 1.0, 1.0, "file")
    shape = torch.zeros(hand.shape_basis.shape[-1])
    return HandFit("right", shape, pose, camera, landmarks, torch.zeros(8, 8), 0.0, 0.0, 1.0, 0.0, ())


@pytest.mark.parametrize(
    ("switches", "letter"),
    [({}, "a"), ({"vet": "off"}, "b"), ({"vet": "mlp"}, "b.2"), ({"vpia": "no_bias"}, "c.1"), ({"fom": "off"}, "d")],
)
def test_a_network_is_known_by_the_switch_that_is_off(switches, letter):
    assert letter_of(NetworkConfig(**{**vars(COMPACT), **switches})) == letter
    if letter == "d":
        with pytest.raises(InputError, match="rows b and d at once"):
            letter_of(NetworkConfig(**{**vars(COMPACT), **switches, "vet": "off"}))


def test_tables_hold_what_was_measured_beside_what_papers_print(tmp_path):
    times = {"seconds": 90.0, "fps": 50.0, "avatars": 1, "pictures": 4}
    names = ("ours", "ours, no fine-tuning", "one-shot a", "one-shot f", "model b.1", "pose 5")
    tables = make_tables("interhand", [{"row": name, **RECORD, **times} for name in names])
    results, model, one_shot, poses, speed = tables
    assert ["OHTA", "26.11", "0.864", "12.93"] == results.lines[6][:4]
    assert results.lines[-1] == ["ours, one-shot as in the paper", "26.00", "0.900", "12.50", "20.00", "0.800", "0.700",
                                 "90.0", "50.0"]  # fmt: skip
    assert [line[0].split()[0] for line in model.lines] == ["a", "b", "b.1", "b.2", "c", "c.1", "d"]
    assert model.lines[2][1:5] == ["27.08", "0.955", "11.87", "26.00"] and model.lines[3][4:] == [""] * 8
    assert [line[0] for line in one_shot.lines][-1] == "f w/o LoRA: full tuning" and one_shot.lines[-1][4] == "26.00"
    assert poses.lines[2][1] == "26.00" and poses.lines[1][1] == ""
    assert speed.lines[-1] == ["ours, here", "50.0", "1.50"]
    written = write_tables(tmp_path, tables)
    with (tmp_path / "results.csv").open() as file:
        assert next(csv.reader(line for line in file if line.startswith("OHTA")))[1] == "26.11"
    assert len(written) == 7 and "| OHTA | 26.11 | 0.864 | 12.93 |" in (tmp_path / "tables.md").read_text()
    assert r"LPIPS*" in as_latex(results) and r"SelfRecon & 26.38 & 0.879 & 14.21" in as_latex(results)


@pytest.mark.timeout(120)
def test_what_cannot_be_read_is_left_out_and_named_and_a_run_goes_on(hand, tmp_path, monkeypatch):
    data = PhotosOfOneHand(["08_two_fingers", "02_flat_closed", "gone"], HandEstimator(hand))
    rows = [Row("guess", "mean", RAW, AdaptConfig())]
    priors = {"mean": choose_prior("none")}
    found = evaluate_data_set(data, priors, rows, Choice(photos=2, targets=2), tmp_path)
    assert set(found["left_out"]) == {"gone"} and "no such file" in found["left_out"]["gone"]
    (row,) = found["summary"]
    assert row["pictures"] == 1 and 8 < row["psnr"] < 30 and 0.3 < row["ssim_mask"] < row["ssim"]
    assert row["lpips"] is None and row["fps"] > 0 and (tmp_path / "sheet.png").exists()
    monkeypatch.setattr(data, "read", lambda key: pytest.fail("all is there"))
    assert evaluate_data_set(data, priors, rows, Choice(photos=2, targets=2), tmp_path) == found


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_row_of_the_papers_tables_is_measured(hand, tmp_path):
    data = PhotosOfOneHand(["02_flat_closed", "08_two_fingers"], HandEstimator(hand))
    priors = {"learned": choose_prior("learned")}
    rows = rows_of_tables(priors, (), 3, 0)
    found = evaluate_data_set(data, priors, rows, Choice(photos=1, targets=1), tmp_path)
    tables = make_tables("hanco", found["summary"])
    assert not found["left_out"] and all(line[1] for table in tables if table.name != "model" for line in table.lines)
    by_name = {row["row"]: row for row in json.loads((tmp_path / "metrics.json").read_text())["summary"]}
    assert by_name["pose 10"]["psnr"] < by_name["ours"]["psnr"]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "tree", "split"),
    [("interhand", "interhand", "test"), ("hanco", "hanco", "train"), ("whim", "photos", "train")],
)
def test_the_command_fills_the_papers_tables_from_stand_ins_of_data_sets(
    name, tree, split, mano_dir, tmp_path, capsys, weights_of
):
    models = {side: read_mano(mano_dir, side) for side in ("right", "left")}
    WRITERS[tree](tmp_path / "root", models, split)
    command = ["evaluate", "--dataset", name, "--root", str(tmp_path / "root"), "--mano-dir", str(mano_dir)]
    few = ["--people", "1", "--targets", "1", "--steps", "2", "--ablations", str(weights_of(fom="off"))]
    assert main([*command, "--out", str(tmp_path / "out"), *few]) == 0
    text = (tmp_path / "out" / "tables.md").read_text()
    measured = [line for line in text.splitlines() if line.startswith(("| ours |", "| d w/o FoM", "| f w/o LoRA"))]
    assert len(measured) == 3 and all(line.split("|")[5].strip() for line in measured)
    assert "Ablation of one-shot" in capsys.readouterr().out
    assert {"results.csv", "tables.tex", "sheet.png", "metrics.json"} <= {p.name for p in (tmp_path / "out").iterdir()}


@pytest.fixture
def weights_of(hand, tmp_path):
    """Weights of a small network with a switch turned, which knows nothing yet."""

    def write(**switches):
        small = dict(width=32, heads=2, n_tokens=16, n_coarse=64, refine_layers=1, head_width=16)
        config = NetworkConfig(**{**vars(COMPACT), **small, **switches})
        save_network(tmp_path / "network.safetensors", HandNetwork(config, hand))
        return tmp_path / "network.safetensors"

    return write


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--dataset", "hanco"], "expected its folder, --root, and a learned prior"),
        (["--dataset", "hanco", "--root", "x", "--prior", "none"], "expected its folder, --root, and a learned prior"),
        (["--root", "x"], "--root: is for interhand, hanco"),
        (["folder", "--dataset", "hanco", "--root", "x"], "a data set has --root"),
        (["--dataset", "hanco", "--root", "x", "--targets", "0"], "--targets"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(options, said, tmp_path, capsys):
    assert main(["evaluate", *options, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
