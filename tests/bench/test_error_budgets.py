from dataclasses import replace

import pytest
from test_rows import ROW

from oasis_warp.bench.summary import BUDGETS, fastest, groups, non_dominated


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
    from oasis_warp.bench.pareto import plot_operator

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
