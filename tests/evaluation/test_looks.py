"""Views, regions, blemishes, the table of real hands, records of photos as tables, and data sets with their truth."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from datasets.trees import WRITERS

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.wrist import ARM_GROWTH, ARM_LENGTH, rim_axis
from oasis_warp.cli import evaluate, main
from oasis_warp.core import config
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.color import cielab, linear_light, luminance
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_points
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation import data_sets
from oasis_warp.evaluation.band_energy import BANDS, HAZE_REACH, SIZE, darkest_over_median, haze, mean_light, redness
from oasis_warp.evaluation.data_sets import Choice, Key, Row, Sample, choose, evaluate_data_set, misposed
from oasis_warp.evaluation.kernel_distance import LAYERS
from oasis_warp.evaluation.look_measures import measure_looks
from oasis_warp.evaluation.looks import hand_of, kernel_rows, summarise_looks
from oasis_warp.evaluation.methods import RAW
from oasis_warp.evaluation.paper_tables import (
    as_latex,
    letter_of,
    make_tables,
    pose_curve,
    rows_of_tables,
    write_tables,
)
from oasis_warp.evaluation.pictures import GAP, MARGIN, SMALL, write_cells, write_curve, write_overview
from oasis_warp.evaluation.real_hands import real_photos, reference_contrasts, summarise_real
from oasis_warp.evaluation.views import RIM, WRIST_REACH, clear_of_outlines, read_surface, shrink, wrist_end
from oasis_warp.hand.mano import read_mano
from oasis_warp.network.config import COMPACT, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import choose_prior
from oasis_warp.network.weights_file import save_network
from oasis_warp.reconstruction import reconstruct


def test_pixels_near_the_outline_of_a_finger_before_the_hand_do_not_count():
    depth = torch.full((SIZE, SIZE), torch.inf)
    depth[40:200, 40:200] = 0.5 + 0.0005 * torch.arange(160)  # a slope is no outline
    depth[100:140, 40:200] -= 0.02
    clear = clear_of_outlines(depth)
    rows = clear[:, 120].nonzero()[:, 0].tolist()
    inside = [*range(40 + RIM, 100 - RIM), *range(100 + RIM, 140 - RIM), *range(140 + RIM, 200 - RIM)]
    assert rows == [row for row in range(SIZE) if row in inside or row < 40 - RIM or row >= 200 + RIM]


@pytest.mark.parametrize("left", [False, True])
def test_the_outside_of_the_skin_counts_and_the_inside_of_the_wrist_does_not(hand, left):
    vertices = mirror_points(hand.template) if left else hand.template
    ones, palm = torch.ones(len(vertices)), label_regions(hand).palm
    wrist = 0
    for k in range(8):
        camera = orbit_camera(vertices, k * math.pi / 4)
        outside = read_surface(hand, vertices, camera, ones, palm, left=left)
        inside = read_surface(hand, vertices, camera, ones, palm, left=not left)  # as if the skin were inside out
        least = 0.1 * int(outside.silhouette.sum())
        assert int(outside.interior.sum()) > least > int(inside.interior.sum())
        assert not (outside.interior & inside.interior).any()
        wrist += int(inside.interior.sum())
    assert wrist > 500  # one of the views looks into it


def test_the_end_of_the_wrist_is_where_its_rim_is_seen(hand):
    edge = hand.template[hand.rim]
    wider = edge + ARM_GROWTH * (edge - edge.mean(0))
    ends = torch.cat([edge, wider + ARM_LENGTH * rim_axis(hand.template, hand.rim)])  # of the arm that fades
    camera = orbit_camera(torch.cat([hand.template, ends]), 0.0, size=256)
    end = wrist_end(hand, hand.template, camera)
    rim, depth = project(camera, ends)
    tips, _ = project(camera, hand.tips)
    x, y = rim.long().unbind(-1)
    assert end[y, x].all() and not end[tips[:, 1].long(), tips[:, 0].long()].any()
    rows, columns = end.nonzero().unbind(-1)
    reach = WRIST_REACH * float(camera.K[0, 0] / depth.mean())
    beyond = rim[:, 0].min() - columns.min(), rows.max() + 1 - rim[:, 1].max()
    assert all(abs(float(pixels) - reach) < 2 for pixels in beyond)


def test_shrinking_takes_means_of_blocks():
    image = torch.arange(2 * SIZE).float()[:, None].expand(-1, 2 * SIZE)[..., None].expand(-1, -1, 3).contiguous()
    small = shrink(image)
    assert small.shape == (SIZE, SIZE, 3) and small[1, 7].tolist() == [2.5] * 3
    assert shrink(image[..., 0]).shape == (SIZE, SIZE)


def test_photos_of_a_subfolder_are_one_hand_and_copies_count_once(tmp_path):
    (tmp_path / "mine").mkdir()
    for k, name in enumerate(("a.png", "mine/x.png", "mine/y.png")):
        write_picture(tmp_path / name, torch.full((8, 8, 3), 20 * k, dtype=torch.uint8))
    (tmp_path / "copy.png").write_bytes((tmp_path / "mine/x.png").read_bytes())
    found = real_photos(tmp_path)
    assert {path.name: hand for path, hand in found.items()} == {"a.png": "a", "x.png": "mine", "y.png": "mine"}
    assert hand_of(tmp_path / "copy.png", found) == "mine" and hand_of(tmp_path / "a.png", found) == "a"


def test_the_table_that_ships_is_in_order_and_says_how_many_photos_it_has():
    table = reference_contrasts()
    for side in ("palm", "back"):
        own = table[side]
        assert own["photos"] > own["hands"] > 5
        for low, median, high in zip(own["quarter"], own["median"], own["three_quarters"], strict=True):
            assert 0.5 < low < median < high < 20


def real(hand, contrast, features=0.0, mostly="palm"):
    layers = {layer: [features, 1.0] for layer in LAYERS}
    return {"hand": hand, "contrast": {"palm": contrast}, "features": layers, "mostly": mostly}


def test_the_table_of_real_hands_holds_quartiles_of_photos():
    records = [real(f"{k // 2}", [float(k)] * 4) for k in range(5)]
    assert summarise_real(records) == {
        "palm": {"photos": 5, "hands": 3, "quarter": [1.0] * 4, "median": [2.0] * 4, "three_quarters": [3.0] * 4}
    }  # fmt: skip


def record(contrast, **changes):
    return {
        "contrast": contrast, "input_psnr_db": 30.0, "haze": 0.02, "haze_of_mean": 0.01, "palm_minus_back": None,
        "darkest": 0.5, "lpips": None, "back_over_front": [1.0, 1.05, 1.25], **changes,
    }  # fmt: skip


def test_hidden_skin_is_compared_with_real_hands_and_seen_skin_with_its_photo():
    reference = {"back": {"median": [2.0, 2.0, 4.0, 4.0]}}
    records = [
        record({"photo": [4.0] * 4, "seen": [2.0] * 4, "hidden_back": [1.0] * 4, "hidden_palm": [9.0] * 4}),
        record({"photo": [4.0] * 4, "seen": [6.0] * 4}, haze=0.06, darkest=None),
    ]
    found = summarise_looks(records, reference)
    rows = {row["region"]: row for row in found["contrast"]}
    assert list(rows) == ["seen", "hidden_back"]
    assert [rows["hidden_back"][f"ratio {band}"] for band in BANDS] == [0.5, 0.5, 0.25, 0.25]
    assert rows["seen"]["photos"] == 2 and rows["seen"]["ratio <1"] == 1.0 and rows["seen"]["contrast <1"] == 4.0
    spoilt = found["blemishes"]
    assert spoilt["haze_ratio"] == pytest.approx(4) and spoilt["darkest"] == 0.5 and spoilt["palm_minus_back"] is None
    assert (spoilt["wounded"], spoilt["back_brightness"], spoilt["back_hue"]) == (0, 1.1, 1.25)
    dark = record({}, darkest=0.1, back_over_front=[0.5, 0.4, 0.3])
    spoilt = summarise_looks([dark, record({})], reference)["blemishes"]
    assert spoilt["wounded"] == 0.5 and spoilt["back_brightness"] == pytest.approx((2.5 + 1.1) / 2)


def test_few_real_hands_give_no_distance():
    assert kernel_rows({"input": [], "side": [], "pose": []}, [real("a", [1.0] * 4)]) == []


def test_halves_of_real_hands_are_the_floor_and_palms_and_backs_are_apart():
    random = torch.Generator().manual_seed(0)
    values = torch.randn(16, generator=random) + 5 * (torch.arange(16) % 2)
    crowd = [real(f"{k}", [], float(value), ("palm", "back")[k % 2]) for k, value in enumerate(values)]
    rows = {row["name"]: row for row in kernel_rows({"input": [], "side": [], "pose": []}, crowd)}
    floor, apart = rows["halves of the real hands"], rows["real palms to real backs"]
    assert abs(floor["half"]) < 3 * floor["half_error"] and apart["half"] > 3 * apart["half_error"]


def test_sheets_have_rows_of_cells_and_the_overview_shows_some_of_them(tmp_path):
    colors = torch.linspace(0.1, 0.9, 8)
    write_cells(tmp_path / "a.png", [(torch.full((64, 64, 3), float(c)), "words") for c in colors], columns=4)
    sheet = read_photo(tmp_path / "a.png").rgb
    assert sheet.shape == (2 * 64 + GAP, 4 * 64 + 3 * GAP, 3)
    assert abs(float(sheet[-5, -5].float().mean() / 255) - 0.9) < 0.01
    write_overview(tmp_path / "all.png", [tmp_path / "a.png"] * 2, (0, 7), columns=4)
    small = read_photo(tmp_path / "all.png").rgb
    assert small.shape == (2 * SMALL + GAP, 2 * SMALL + GAP, 3)
    assert abs(float(small[SMALL // 2 + SMALL, -5].float().mean() / 255) - 0.9) < 0.02


def test_colours_have_their_known_coordinates():
    colors = torch.tensor([[1.0, 1, 1], [1, 0, 0], [0, 0, 1], [0.5, 0.5, 0.5]])
    known = torch.tensor([[100.0, 0, 0], [53.24, 80.09, 67.20], [32.30, 79.19, -107.86], [53.39, 0, 0]])
    torch.testing.assert_close(cielab(colors), known, atol=0.05, rtol=0)
    torch.testing.assert_close(luminance(colors)[:2], torch.tensor([1.0, 0.2126]))
    assert float(linear_light(torch.tensor([0.02, 0.5, 1]))[0]) == pytest.approx(0.02 / 12.92)


def test_haze_is_the_alpha_beyond_its_reach_over_the_silhouette():
    silhouette = torch.zeros(64, 64, dtype=torch.bool)
    silhouette[20:40, 20:40] = True
    alpha = silhouette.float()
    alpha[20, 40 : 40 + HAZE_REACH] = 1  # a soft outline is none
    nowhere = torch.zeros_like(silhouette)
    assert haze(alpha, silhouette, nowhere) == 0
    alpha[20, 40 + HAZE_REACH : 50] = 0.5
    assert haze(alpha, silhouette, nowhere) == pytest.approx(0.5 * (10 - HAZE_REACH) / 400)
    assert haze(alpha, silhouette, alpha == 0.5) == 0


def test_a_gash_of_two_percent_of_the_palm_is_a_wound_and_a_speck_is_none():
    where = torch.ones(40, 40, dtype=torch.bool)
    image = torch.full((40, 40, 3), 0.7)
    image[0, :10] = 0.1
    assert darkest_over_median(image, where) == pytest.approx(1)
    image[0] = 0.1
    found = darkest_over_median(image, where)
    assert found is not None and found < 0.2
    assert darkest_over_median(image, where & (image[..., 0] < 0.5)) is None


def test_a_red_palm_and_a_dim_back():
    where = torch.ones(40, 40, dtype=torch.bool)
    red, grey = torch.tensor([0.8, 0.6, 0.5]).expand(40, 40, 3), torch.full((40, 40, 3), 0.6)
    of_red, of_grey = redness(red, where), redness(grey, where)
    assert of_red is not None and of_grey is not None and of_red > 10 and abs(of_grey) < 0.1
    light, dim = mean_light(grey, where), mean_light(grey * torch.tensor([0.5, 1, 1]), where)
    assert light is not None and dim is not None
    assert float((dim / light)[0]) < 0.3 and float(dim[2]) == pytest.approx(float(light[2]))
    assert mean_light(grey, where & False) is None


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
    assert pose_curve([{"row": "ours", "psnr": 26.0}, {"row": "pose 5", "psnr": 20.0}]) == [(0.0, 26.0), (5.0, 20.0)]
    written = write_tables(tmp_path, tables)
    with (tmp_path / "results.csv").open() as file:
        assert next(csv.reader(line for line in file if line.startswith("OHTA")))[1] == "26.11"
    assert len(written) == 7 and "| OHTA | 26.11 | 0.864 | 12.93 |" in (tmp_path / "tables.md").read_text()
    assert r"LPIPS*" in as_latex(results) and r"SelfRecon & 26.38 & 0.879 & 14.21" in as_latex(results)


def test_a_plot_falls_where_its_numbers_fall(tmp_path):
    write_curve(tmp_path / "plot.png", [(0.0, 30.0), (5.0, 25.0), (10.0, 20.0)], "degrees", "PSNR")
    pixels, (width, height) = read_photo(tmp_path / "plot.png").rgb, (480, 320)
    for share in (0.25, 0.5, 0.75):  # along the line, and beside it
        x, y = (round(MARGIN + share * (side - 2 * MARGIN)) for side in (width, height))
        assert pixels[y - 1 : y + 2, x].min() < 100 and pixels[height - y - 9, x].min() > 200


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


@pytest.fixture
def few_steps(monkeypatch):
    """The paper's 100 steps of calibration are made few, and a frame is timed."""
    few = replace(config.PAPER_ADAPTATION, calibration_steps=2, reference_views=1)
    monkeypatch.setattr(config, "PAPER_ADAPTATION", few)
    monkeypatch.setattr(data_sets, "FRAMES", 1)


@pytest.mark.slow
def test_every_row_of_the_papers_tables_is_measured(hand, tmp_path, few_steps):
    data = PhotosOfOneHand(["02_flat_closed", "08_two_fingers"], HandEstimator(hand))
    priors = {"learned": choose_prior("learned")}
    rows = rows_of_tables(priors, (), 3, 0)
    found = evaluate_data_set(data, priors, rows, Choice(photos=1, targets=1), tmp_path)
    tables = make_tables("hanco", found["summary"])
    assert not found["left_out"] and all(line[1] for table in tables if table.name != "model" for line in table.lines)
    by_name = {row["row"]: row for row in json.loads((tmp_path / "metrics.json").read_text())["summary"]}
    wrong = [by_name[f"pose {degrees}"]["psnr"] for degrees in (2, 5, 10)]  # a single one may be lucky on one picture
    assert sum(wrong) / len(wrong) < by_name["ours"]["psnr"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tree", "split"),
    [("interhand", "interhand", "test"), ("hanco", "hanco", "train"), ("whim", "photos", "train")],
)
def test_the_command_fills_the_papers_tables_from_stand_ins_of_data_sets(
    name, tree, split, mano_dir, tmp_path, capsys, monkeypatch, weights_of, few_steps
):
    """Of one person, and of each table the row that no other has: every row is measured on real photos above."""
    own = ("ours", "pose 10", "model d", "one-shot f")
    asked, first = evaluate.rows_of_tables, data_sets.choose
    monkeypatch.setattr(evaluate, "rows_of_tables", lambda *given: [row for row in asked(*given) if row.name in own])
    monkeypatch.setattr(data_sets, "choose", lambda *given: first(*given)[:1])
    models = {side: read_mano(mano_dir, side) for side in ("right", "left")}
    WRITERS[tree](tmp_path / "root", models, split)
    command = ["evaluate", "--dataset", name, "--root", str(tmp_path / "root"), "--mano-dir", str(mano_dir)]
    few = ["--people", "1", "--targets", "1", "--steps", "2", "--ablations", str(weights_of(fom="off"))]
    assert main([*command, "--out", str(tmp_path / "out"), *few]) == 0
    text = (tmp_path / "out" / "tables.md").read_text()
    measured = [line for line in text.splitlines() if line.startswith(("| ours |", "| d w/o FoM", "| f w/o LoRA"))]
    assert len(measured) == 3 and all(line.split("|")[5].strip() for line in measured)
    assert "Ablation of one-shot" in capsys.readouterr().out
    files = {"results.csv", "tables.tex", "sheet.png", "metrics.json", "attention.png", "pose_errors.png"}
    assert files <= {path.name for path in (tmp_path / "out").iterdir()}


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
        (["--dataset", "hanco"], "expected --root FOLDER and a learned prior"),
        (["--dataset", "hanco", "--root", "x", "--prior", "none"], "expected --root FOLDER and a learned prior"),
        (["--root", "x"], "--root: works only with interhand, hanco"),
        (["folder", "--dataset", "hanco", "--root", "x"], "a data set has --root"),
        (["--dataset", "hanco", "--root", "x", "--targets", "0"], "--targets"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(options, said, tmp_path, capsys):
    assert main(["evaluate", *options, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.gpu
def test_looks_of_an_avatar_on_the_device_are_measured():
    """The hand painted all over had its surface on the CPU and its tone on the device."""
    photo = read_photo(Path(__file__).parents[1] / "data" / "photos" / "palm_open_left_02.png")
    prior = choose_prior("learned")
    made = reconstruct(photo, ReconstructConfig(device="cuda", steps=2), prior=prior)
    looks = measure_looks(photo, made, "a", prior, 0)
    assert looks.samples["painted"] and looks.record["contrast"]["painted_palm"]
