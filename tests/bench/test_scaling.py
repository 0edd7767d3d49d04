import json
import sys
from dataclasses import replace

import pytest
import torch
from gpu_rows import POINT, STUDY, line

from oasis_warp.bench import scaling, speed
from oasis_warp.bench.counts import count
from oasis_warp.bench.knobs import generic_kernels
from oasis_warp.bench.operators import OPERATORS, forward
from oasis_warp.bench.rows import json_text
from oasis_warp.bench.scaling import Point, measure_scaling, picture_errors, points, steepest
from oasis_warp.bench.scenes import hand_scenes, surface

SMALL = Point("gaussians", "64 x 64", lambda seed: surface(2_000, 64, 2, seed))


def test_the_study_goes_as_far_as_was_promised():
    whole = points(quick=False)
    assert len([p for p in whole if p.axis == "gaussians"]) == 9
    assert [p.series for p in whole if p.axis == "stress"] == ["one tile", "giants"]
    sizes = [p.make for p in whole if p.axis == "gaussians"]
    assert len(sizes[0](0).means) == 1_000
    assert {p.series for p in whole if p.axis == "pixels"} == {"37,000 Gaussians", "1,000,000 Gaussians"}
    assert len([p for p in whole if p.axis == "pixels"]) == 12
    views = [p.make for p in whole if p.axis == "views"]
    assert len(views[-1](0).viewmats) == 64
    assert len(points(quick=True)) < len(whole) / 2


def test_a_point_is_timed_in_both_passes_and_its_picture_compared(cpu):
    forward_row, both = measure_scaling([SMALL], cpu, seconds=0.1)
    assert (forward_row.pass_, both.pass_) == ("forward", "forward + backward")
    assert (both.gaussians, both.views, both.width, both.amount) == (2_000, 2, 64, 2_000)
    assert both.pairs == count(surface(2_000, 64, 2)).pairs
    assert both.finite
    assert both.checked == "all"
    assert both.max_abs < 2 / 255
    assert both.most_abs < 2e-6
    assert both.wall_ms > 0
    assert forward_row.wall_ms > 0
    assert (both.busy_ms, both.overflow, both.not_captured) == (None, None, "no CUDA device")


@pytest.mark.parametrize("affordable", [10**9, 0])
def test_a_wrong_picture_is_seen_whether_all_of_it_or_a_part_is_compared(monkeypatch, affordable):
    monkeypatch.setitem(scaling.AFFORDABLE, "cpu", affordable)
    scene = surface(5_000, 256)
    work = count(scene)
    image, _ = forward(OPERATORS["rasterization"].call, scene, {})
    what, largest, most = picture_errors(scene, image, work)
    assert what == ("all" if affordable else "crop")
    assert most < 2e-6
    assert largest < 2 / 255
    assert picture_errors(scene, image.roll(1, dims=2), work)[1] > 0.05


def test_a_part_at_the_edge_of_the_picture_is_compared_too(monkeypatch):
    monkeypatch.setitem(scaling.AFFORDABLE, "cpu", 0)
    scene = surface(3_000, 100)
    moved = replace(scene, Ks=scene.Ks + torch.tensor([[0.0, 0, 60], [0, 0, 60], [0, 0, 0]]))
    image, _ = forward(OPERATORS["rasterization"].call, moved, {})
    assert float(image[0, -1, -1].sum()) > 0
    what, _, most = picture_errors(moved, image, count(moved))
    assert what == "crop"
    assert most < 2e-6


def test_values_that_are_not_finite_are_told(cpu):
    def broken(seed):
        scene = surface(200, 32, 1, seed)
        return replace(scene, colors=scene.colors * float("inf"))

    row, _ = measure_scaling([Point("gaussians", "32 x 32", broken)], cpu, seconds=0.05)
    assert not row.finite


def test_growth_is_that_of_time_over_that_of_work():
    found = {(g.axis, g.pass_): g for g in steepest(STUDY)}
    assert set(found) == {(a, p) for a in ("gaussians", "pixels", "views") for p in ("forward", "forward + backward")}
    gaussians, views = found["gaussians", "forward"], found["views", "forward"]
    assert gaussians.ratio == pytest.approx((0.6 / 0.03) / 10)
    assert (gaussians.before, gaussians.after, gaussians.cliff) == (10_000, 100_000, True)
    assert views.ratio == pytest.approx(6 / 8)
    assert not views.cliff


def test_what_grows_is_what_the_axis_says():
    assert [row.amount for row in line("pixels", "", (128**2,), (1.0,))] == [128**2] * 2
    assert [row.amount for row in line("views", "", (8,), (1.0,))] == [8] * 2
    assert POINT.amount == 1_000
    assert POINT.cost_ms == 0.02
    assert replace(POINT, busy_ms=None).cost_ms == 0.1


@pytest.mark.gpu
def test_a_point_on_a_gpu_is_timed_in_a_graph():
    for row in measure_scaling([SMALL], torch.device("cuda"), seconds=0.2):
        assert row.not_captured == ""
        assert row.busy_ms is not None
        assert 0 < row.busy_ms < 10
        assert row.most_abs < 2e-5
        assert row.overflow is False


CPU_ONCE = speed.RunOptions(device=torch.device("cpu"), repeats=2)


@pytest.fixture(scope="module")
def mesh():
    return hand_scenes(32)[1]


@pytest.mark.slow
def test_every_way_is_timed_in_every_pass_and_all_agree(small):
    rows = speed.measure_operator(OPERATORS["rasterization"], small, CPU_ONCE)
    assert [(r.pass_, r.way) for r in rows] == [
        (pass_, way) for pass_ in ("forward", "forward + backward") for way in ("warp", "scalar", "torch")
    ]
    for row in rows:
        assert row.rel_l2 < 5e-6
        assert (row.gradient_rel_l2 is None) == (row.pass_ == "forward")
        assert row.gradient_rel_l2 is None or row.gradient_rel_l2 < 1e-3
        assert row.over_yardstick > 0
        assert (row.over_warp == 1) == (row.way == "warp")


@pytest.mark.parametrize("name", OPERATORS)
def test_generic_kernels_give_float32_answers_of_their_own(name, small, mesh):
    operator = OPERATORS[name]
    scene = operator.prepare(small if operator.scene is type(small) else mesh)
    vectors = operator.comparable(forward(operator.call, scene, {}))
    with generic_kernels():
        scalars = operator.comparable(forward(operator.call, scene, {}))
    again = operator.comparable(forward(operator.call, scene, {}))
    for a, b, c in zip(vectors, scalars, again, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
        assert torch.equal(a, c)  # and afterwards everything is as it was


def test_generic_kernels_answer_no_wherever_an_operator_asks_for_vectors():
    def answers():
        modules = [m for name, m in sys.modules.items() if name.startswith("oasis_warp.ops.")]
        return [m.has_vectors(torch.zeros(1)) for m in modules if hasattr(m, "has_vectors")]

    assert len(answers()) > 3
    assert all(answers())
    with generic_kernels():
        assert not any(answers())


def test_rows_are_plain_json(small):
    rows = speed.measure_operator(OPERATORS["blend_colors"], small, CPU_ONCE)
    records = json.loads(json_text(rows))
    assert [r["way"] for r in records] == ["warp", "torch"] * 2  # sparse products are torch's: nothing to vectorise
    assert {r["pass"] for r in records} == {"forward", "forward + backward"}
