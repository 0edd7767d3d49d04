import io

import pytest
from rich.console import Console

from oasis_warp.cli.console import line_progress, show_run
from oasis_warp.cli.progress import EDIT_PLAN, USUAL_STEPS, ManyPhotos, Run, reconstruct_plan
from oasis_warp.core.config import ReconstructConfig


class Clock:
    """Time that passes when it is told to."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def work(run, clock, plan, pace, watch=lambda: None, *, texture_steps=USUAL_STEPS):
    """Do the steps of a plan at `pace` times their seconds; `watch` looks now and then."""
    for step in plan:
        parts, total = (texture_steps, 400) if step.stage == "texture" else (10, 10)
        run(step.stage, 0, total)
        for k in range(parts):
            clock.now += pace * step.seconds / (step.usual or parts)
            watch()
            if step.stage in ("texture", "colours", "turntable"):
                run(step.stage, k + 1, total)
        if step.stage not in ("colours", "turntable"):
            run(step.stage, total, total)


@pytest.mark.parametrize("pace", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("n_photos", [1, 3])
def test_the_time_left_is_right_within_a_third_on_machines_of_any_speed(pace, n_photos):
    clock, seen = Clock(), []
    plan = reconstruct_plan(ReconstructConfig(), n_photos)
    run = Run(plan, clock=clock)
    work(run, clock, plan, pace, lambda: seen.append((clock.now, run.share, run.left)))
    for now, share, left in seen:
        if 0.2 < share < 0.9:
            assert abs(left - (clock.now - now)) <= 0.3 * (clock.now - now)
    shares = [share for _, share, _ in seen]
    assert shares == sorted(shares) and run.share == pytest.approx(1) and run.left == pytest.approx(0)


def test_texture_learning_that_ends_early_jumps_and_is_not_counted_to_its_limit():
    clock, plan = Clock(), reconstruct_plan(ReconstructConfig(), 1)
    run = Run(plan, clock=clock)
    names = [step.stage for step in plan]
    work(run, clock, plan[: names.index("texture")], 1.0)
    before, whole = run.share, sum(step.seconds for step in plan)
    for step in range(42):  # as few as it can be
        clock.now += 5 / USUAL_STEPS
        run("texture", step + 1, 400)
    assert run.share - before == pytest.approx(5.1 / whole / 2, rel=0.05)
    run("texture", 400, 400)
    assert run.share - before == pytest.approx(5.1 / whole, rel=0.05)


def test_a_photo_that_fails_counts_neither_as_work_nor_as_speed():
    clock, plan = Clock(), reconstruct_plan(ReconstructConfig(), 1)
    run = Run(plan, 3, clock=clock)
    run.begin(0, "photo 1 of 3")
    work(run, clock, plan[:2], 1.0)  # no hand in it
    run.begin(1, "photo 2 of 3")
    run("fit", 0, 1)
    assert run.what == "photo 2 of 3, fit" and run.share == pytest.approx(1 / 3)
    assert run.left == pytest.approx(2 * sum(step.seconds for step in plan), rel=0.1)


def test_kernels_that_are_compiled_once_do_not_make_the_machine_slow():
    clock = Clock()
    run = Run(EDIT_PLAN, clock=clock)
    run("kernels", 0, 1)
    clock.now += 60
    run("kernels", 1, 1)
    assert run.left < 8


def test_without_a_terminal_a_stage_is_a_line_and_long_ones_tell_the_time_left():
    clock, lines = Clock(), []
    plan = reconstruct_plan(ReconstructConfig(), 1)
    progress = line_progress(lines.append, clock=clock, run=Run(plan, clock=clock))
    progress("adaptation", 0, 1)
    work(progress, clock, [step for step in plan if step.stage in ("calibration", "completion", "texture")], 3.0)
    progress("adaptation", 1, 1)
    *between, last = lines
    assert last == "adaptation: 18.5 s"
    assert 2 <= len(between) <= 3 and all(line.startswith("texture: ") and "s left" in line for line in between)
    assert not any("400" in line for line in lines)


def test_lines_of_a_photo_begin_anew_after_one_that_failed():
    clock, lines = Clock(), []
    plan = reconstruct_plan(ReconstructConfig(), 1)
    run = Run(plan, 2, clock=clock)
    progress = line_progress(lines.append, clock=clock, run=run)
    run.begin(0, "photo 1 of 2")
    progress("landmarks", 0, 1)
    clock.now += 7
    run.begin(1, "photo 2 of 2")
    for stage in ("landmarks", "fit"):
        progress(stage, 0, 1)
        clock.now += 1
        progress(stage, 1, 1)
    progress("fit", 1, 1)  # also said by what works within it
    assert lines == ["photo 2 of 2, landmarks: 1.0 s", "photo 2 of 2, fit: 1.0 s"]


def test_the_time_left_for_many_photos_follows_those_that_took_work():
    clock = Clock()
    run = ManyPhotos(1000, ReconstructConfig(), 2, clock=clock)
    planned = 1000 * sum(step.seconds for step in reconstruct_plan(ReconstructConfig(), 1)) / 2
    assert run.left == pytest.approx(planned)
    run.count(0, 400)  # found done, at once
    assert run.left == pytest.approx(0.6 * planned)
    for made in range(1, 201):
        clock.now += 3.0 if made < 100 else 1.0  # more workers came
        run.count(made, 400)
    assert run.share == 0.6 and run.what == "600 of 1000 photos"
    assert run.left == pytest.approx(400, rel=0.1)
    clock.now += 5
    assert run.left == pytest.approx(395, rel=0.1)


def test_on_a_terminal_there_is_one_bar_of_eighty_columns():
    out, plan = io.StringIO(), reconstruct_plan(ReconstructConfig(), 1)
    run = Run(plan, 2)
    with show_run(Console(file=out, force_terminal=True, width=80), run) as shown:
        run.begin(0, "photo 1 of 2")
        for step in plan[:6]:
            shown.progress(step.stage, 0, 1)
            shown.progress(step.stage, 1, 1)
        shown.progress("texture", 20, 400)
        with shown.paused():
            out.write("a report\n")
    text = out.getvalue()
    assert "photo 1 of 2" in text and "s left" in text and "400" not in text and "a report\n" in text
