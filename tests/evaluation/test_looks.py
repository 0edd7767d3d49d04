"""Views, regions, blemishes, the table of real hands, and how records of photos become tables."""

import math

import pytest
import torch

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.color import cielab, linear_light, luminance
from oasis_warp.core.mirror import mirror_points
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.evaluation.band_energy import BANDS, HAZE_REACH, SIZE, darkest_over_median, haze, mean_light, redness
from oasis_warp.evaluation.contact_sheet import GAP, SMALL, write_cells, write_overview
from oasis_warp.evaluation.kernel_distance import LAYERS
from oasis_warp.evaluation.looks import hand_of, kernel_rows, summarise_looks
from oasis_warp.evaluation.real_hands import real_photos, reference_contrasts, summarise_real
from oasis_warp.evaluation.views import RIM, WRIST_REACH, clear_of_outlines, read_surface, shrink, wrist_end


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
    camera = orbit_camera(hand.template, 0.0, size=256)
    end = wrist_end(hand, hand.template, camera)
    rim, depth = project(camera, hand.template[hand.rim])
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
