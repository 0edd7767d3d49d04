import csv
import json
from dataclasses import replace

import pytest
import torch
from test_bench_command import ROW

from oasis_warp.bench import knobs
from oasis_warp.bench.error_time import BUDGETS, Sweep, fastest, groups, measure_settings, non_dominated, standard_plan
from oasis_warp.bench.knobs import Setting, in_other_order
from oasis_warp.bench.operators import OPERATORS, draw_in_torch
from oasis_warp.bench.rows import write_rows
from oasis_warp.bench.scenes import equal_depths, hand_scenes, layered
from oasis_warp.bench.tables import plot_operator
from oasis_warp.ops._runtime.rules import Rules

COARSE_STOP = Setting("stop", "0.01", Rules(transmittance_stop=1e-2))


def sweep(scene, op, *settings, **options):
    return measure_settings(
        Sweep(
            plan=((scene, op),), device=torch.device("cpu"), repeats=2,
            settings=lambda *_: (knobs.DEFAULT, *settings), **options,
        )
    )  # fmt: skip


def by_setting(rows, pass_="forward"):
    return {row.knob: row for row in rows if row.pass_ == pass_}


@pytest.fixture(scope="module")
def layers():
    """Rows of the rasterizer on the layered scene."""
    half = Setting("Gaussians", "50%", share=0.5)
    return sweep(layered(size=32), "rasterization", COARSE_STOP, knobs.FLOAT64, knobs.TORCH, half, knobs.SIZES[0])


def test_there_is_one_row_a_setting_and_pass(layers):
    knobs_seen = ["default", "stop", "precision", "torch", "Gaussians", "resolution"]
    assert [(r.knob, r.pass_) for r in layers] == [
        (knob, pass_) for knob in knobs_seen for pass_ in ("forward", "forward + backward")
    ]
    assert all(r.median_ms > 0 and r.repeats == 2 and r.yardstick_ms > 0 for r in layers)


def test_the_default_is_exact_but_for_rounding(layers):
    for row in layers[:2]:
        assert row.is_default
        assert row.rel_l2 <= 1e-6
        assert row.bit_equal
    assert layers[1].gradient_rel_l2 <= 1e-5
    assert layers[0].gradient_rel_l2 is None


def test_a_stop_at_a_hundredth_costs_what_it_must(layers):
    row = by_setting(layers)["stop"]
    assert 42 <= row.psnr_db <= 50  # 47 dB: what is not drawn has at most weight 0.01, mostly less
    assert 1e-3 < row.rel_l2 < 2e-2
    assert not row.bit_equal


def test_the_exact_picture_is_known_far_better_than_what_is_judged_by_it(layers):
    assert {row.floor_rel_l2 for row in layers} == {layers[0].floor_rel_l2}
    assert 0 < layers[0].floor_rel_l2 <= 1e-12


def test_float64_is_what_errors_are_measured_from(layers):
    rows = by_setting(layers, "forward + backward")
    assert (rows["precision"].rel_l2, rows["precision"].gradient_rel_l2) == (0, 0)
    assert 0 < rows["torch"].error < 1e-4


def test_dropping_gaussians_loses_their_gradients_too(layers):
    row = by_setting(layers, "forward + backward")["Gaussians"]
    assert row.gaussians == 1500
    assert 0.1 < row.gradient_rel_l2 < 10
    assert row.psnr_db < 30


def test_gradients_of_smaller_images_are_not_compared(layers):
    row = by_setting(layers, "forward + backward")["resolution"]
    assert row.gradient_rel_l2 is None
    assert 5 < row.psnr_db < 40


def test_fragile_pixels_are_told(layers):
    share = 100 * float(draw_in_torch(layered(size=32).to(dtype=torch.float64)).fragile.double().mean())
    assert layers[0].fragile_percent == pytest.approx(share)
    assert 0 < share < 10


def test_threads_change_no_bit():
    rows = sweep(equal_depths(), "rasterization", Setting("threads", "2", threads=2))
    assert [r.threads for r in rows] == [1, 1, 2, 2]
    assert all(r.bit_equal for r in rows)


@pytest.mark.parametrize("make", [layered, equal_depths])
def test_another_order_of_the_list_draws_the_same(make):
    scene = make(size=16).to(dtype=torch.float64)
    other = in_other_order(scene)
    assert not torch.equal(other.means, scene.means)
    torch.testing.assert_close(draw_in_torch(other).image, draw_in_torch(scene).image, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def small_hand():
    return hand_scenes(32)[1]


def test_a_coarser_depth_buffer_hides_the_wrong_points(small_hand):
    rows = by_setting(sweep(small_hand, "depth_visibility", knobs.SIZES[0], knobs.FLOAT64), "forward + backward")
    assert rows["default"].rel_l2 < 1e-4
    assert 0.01 < rows["resolution"].rel_l2 < 1
    assert rows["resolution"].gradient_rel_l2 is not None  # by the same points
    assert rows["default"].psnr_db is None


@pytest.mark.parametrize("op", ["depth_map", "face_rotations", "pose_on_mesh"])
def test_every_operator_on_meshes_is_exact_by_default(small_hand, op):
    for row in sweep(small_hand, op):
        assert row.error < 5e-6
        assert row.floor_rel_l2 < 1e-5
        assert row.bit_equal
        assert row.fragile_percent is None


def test_the_plan_covers_every_operator_that_is_swept_and_quick_the_avatar_alone():
    quick, full = standard_plan(32, 0, True), standard_plan(32, 0, False)
    ops = [op for op in OPERATORS if op not in ("blend_weights", "blend_colors", "posing")]
    assert [op for _, op in quick] == ops
    assert {scene.name for scene, _ in quick} == {"hand"}
    assert [(s.name, op) for s, op in full[: len(quick)]] == [(s.name, op) for s, op in quick]
    assert {s.name for s, _ in full} == {
        "hand", "far hand", "layered", "needles", "opaque", "equal depths", "slivers",
    }  # fmt: skip


def test_every_knob_that_is_tried_differs_from_the_default():
    rules = Rules()
    for op in OPERATORS:
        chosen = knobs.settings(op, torch.device("cpu"), 1, 2)
        assert [s.knob for s in chosen].count("default") == 1
        for s in chosen[1:]:
            rotated = [
                s.rules != rules, s.dtype != torch.float32, s.threads is not None, bool(s.options), s.share != 1,
                s.shrink != 1, s.torch,
            ]  # fmt: skip
            assert sum(rotated) == 1
        labels = [(s.knob, s.value) for s in chosen]
        assert len(set(labels)) == len(labels)


def test_exponentials_are_a_knob_of_the_cpu_only():
    cpu, cuda = (knobs.settings("rasterization", torch.device(d), 1, 1) for d in ("cpu", "cuda"))
    assert {s.knob for s in cpu} - {s.knob for s in cuda} == {"exp degree"}


def test_files_hold_every_row(layers, tmp_path):
    write_rows(layers, tmp_path / "e.csv", tmp_path / "e.json")
    records = list(csv.DictReader((tmp_path / "e.csv").read_text().splitlines()))
    assert len(records) == len(json.loads((tmp_path / "e.json").read_text())) == len(layers)


def test_progress_ends_where_it_said(small):
    reports = []
    measure_settings(
        Sweep(plan=((small, "rasterization"),) * 2, device=torch.device("cpu"), repeats=2,
              settings=lambda *_: (knobs.DEFAULT,)),
        lambda stage, done, total: reports.append((done, total)),
    )  # fmt: skip
    assert reports == [(1, 4), (2, 4), (3, 4), (4, 4)]


def row(knob, ms, error, **changes):
    return replace(ROW, knob=knob, value=str(ms), median_ms=ms, fastest_ms=ms, cpu_ms=ms, rel_l2=error, **changes)


DEFAULT, FAST, FASTER, SLOW, SAME = (
    row("default", 10.0, 1e-7, bit_equal=True), row("stop", 8.0, 5e-4), row("stop", 6.0, 5e-3),
    row("precision", 30.0, 0.0), row("tile", 7.0, 1e-7, bit_equal=True),
)  # fmt: skip


def test_the_fastest_setting_within_each_budget():
    (group,) = groups([DEFAULT, FAST, FASTER, SLOW])
    assert [fastest(group, budget) for _, budget in BUDGETS] == [FASTER, FAST, DEFAULT, DEFAULT]
    (group,) = groups([DEFAULT, FAST, SAME])
    assert fastest(group, None) == SAME


def test_a_gain_within_the_noise_is_no_gain():
    (group,) = groups([DEFAULT, row("tile", 9.8, 1e-7, bit_equal=True)])
    assert fastest(group, 1e-2) == DEFAULT


def test_gradients_count_and_unknown_ones_do_not():
    backward = {"pass_": "forward + backward"}
    default = replace(DEFAULT, gradient_rel_l2=1e-6, **backward)
    wrong, unknown = replace(FASTER, gradient_rel_l2=0.5, **backward), replace(FASTER, **backward)
    (group,) = groups([default, wrong, unknown])
    assert fastest(group, 1e-2) == default


def test_rows_are_compared_within_an_operator_a_scene_and_a_pass():
    rows = [DEFAULT, replace(DEFAULT, scene="hand"), replace(DEFAULT, op="depth_map"), FAST]
    assert [(g.op, g.scene, len(g.rows)) for g in groups(rows)] == [
        ("rasterization", "layered", 2), ("rasterization", "hand", 1), ("depth_map", "layered", 1),
    ]  # fmt: skip


def test_non_dominated_rows_get_slower_and_better():
    worse = row("alpha cut", 9.0, 1e-3)  # slower and less exact than FAST
    assert non_dominated([SLOW, worse, DEFAULT, FAST, FASTER]) == [FASTER, FAST, DEFAULT, SLOW]


def test_pictures_show_what_is_asked_for(tmp_path):
    pytest.importorskip("matplotlib")
    rows = [DEFAULT, FAST, FASTER, SLOW, replace(DEFAULT, scene="hand")]
    plot_operator(rows, "rasterization", tmp_path / "all.png")
    plot_operator(rows, "rasterization", tmp_path / "one.svg", ["layered"])
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")
    assert "layered, forward" in (tmp_path / "one.svg").read_text()
    assert {p.name for p in tmp_path.iterdir()} == {"all.png", "one.svg"}


def test_other_work_on_the_machine_does_not_decide():
    delayed = replace(SAME, fastest_ms=50.0, median_ms=90.0)
    (group,) = groups([DEFAULT, delayed])
    assert fastest(group, None) == delayed
    assert replace(SAME, threads=2, fastest_ms=50.0).cost_ms == 50  # CPU time of two threads is no time to wait
    assert replace(SAME, cpu_ms=None, fastest_ms=3.0).cost_ms == 3
