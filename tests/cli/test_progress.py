"""What a user sees of a reconstruction: its progress, its report, its summary."""

import contextlib
import io
import itertools
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console

from oasis_warp.avatar.quality import SurfaceQuality
from oasis_warp.cli import summary
from oasis_warp.cli.options import Reconstruct as ReconstructOptions
from oasis_warp.cli.progress import (
    EDIT_PLAN,
    ManyPhotos,
    Run,
    Terminal,
    line_progress,
    plain_console,
    reconstruct_plan,
    show_progress,
    show_run,
)
from oasis_warp.cli.record import recorded
from oasis_warp.cli.report import make_report, print_report, print_warnings, to_json
from oasis_warp.cli.summary import (
    FINGER_COLORS,
    PAPER,
    POSES,
    VIEWS,
    WIDTH,
    Panel,
    draw_landmarks,
    draw_mesh,
    draw_quality,
    draw_summary,
    make_sheet,
    panel_side,
    shade_mesh,
)
from oasis_warp.core.config import ReconstructConfig


class Clock:
    """Time that passes when it is told to."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def work(run, clock, plan, pace, watch=lambda: None):
    """Do the steps of a plan at `pace` times their seconds; `watch` looks now and then."""
    for step in plan:
        total = 56 if step.stage == "texture" else 10
        run(step.stage, 0, total)
        for k in range(total):
            clock.now += pace * step.seconds / total
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
    steps = [step for step in plan if step.stage in ("calibration", "completion", "texture")]
    work(progress, clock, steps, 5.0)
    progress("adaptation", 1, 1)
    *between, last = lines
    assert last == f"adaptation: {5 * sum(step.seconds for step in steps):.1f} s"
    assert 2 <= len(between) <= 3 and all(line.startswith("texture: ") and "s left" in line for line in between)
    assert not any("of 56" in line or "/56" in line for line in lines)


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
    plan = reconstruct_plan(ReconstructConfig(), 1, pictures=False)
    planned = 1000 * sum(step.seconds for step in plan) / 2
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


def test_a_report_holds_the_run(scene, made):
    made = made._replace(warnings=("the thumb is hidden",))
    photo = scene[0]._replace(shrink=0.5)
    with recorded(None, ["reconstruct", "my hand.png", "--seed", "3"]):
        report = json.loads(to_json(make_report([photo], made, ReconstructConfig(seed=3), {"fit": 0.25, "save": 0.5})))
    assert report["command"] == "oasis reconstruct 'my hand.png' --seed 3"
    assert report["photo"]["name"] == "known.png" and report["photo"]["shrink"] == 0.5
    assert report["hand"] == {"side": "right", "side_score": 0.99, "presence": 0.98, "landmarks_from": "network"}
    assert report["config"]["seed"] == 3
    assert report["prior"] == {"name": "learned", "sha256": "0a1b", "step": 7}
    assert report["seconds"] == {"fit": 0.25, "save": 0.5, "total": 0.75}
    assert report["errors"] == made.errors
    assert report["warnings"] == ["the thumb is hidden"]


def test_numbers_that_json_does_not_know_become_null():
    text = to_json({"a": [float("nan"), {"b": float("inf")}], "c": 1.5})
    assert json.loads(text) == {"a": [None, {"b": None}], "c": 1.5}


def test_a_path_is_written_as_text(scene, made):
    config = ReconstructConfig(prior=Path("own") / "network.safetensors")
    report = json.loads(to_json(make_report([scene[0]], made, config, {})))
    assert report["config"]["prior"] == str(Path("own") / "network.safetensors")


def test_the_table_says_everything_in_words(scene, made):
    made = made._replace(errors={**made.errors, "new_measure": 0.123456}, warnings=("the thumb is hidden",))
    out = io.StringIO()
    print_report(Console(file=out, width=100), make_report([scene[0]], made, ReconstructConfig(), {"fit": 1.234}))
    text = out.getvalue()
    expected = ("fit", "1.23 s", "total", "PSNR to the photo", "30.0 dB", "new_measure", "0.1235")
    for part in ("prior learned", *expected):
        assert part in text
    assert "Warning: the thumb is hidden" in text


def test_lines_tell_the_time_left_now_and_then_and_the_time_at_the_end():
    lines, now = [], iter([0.0, 1.0, 6.0, 7.0, 12.0, 20.0])
    progress = line_progress(lines.append, clock=lambda: next(now))
    for done in (0, 1, 2, 3, 5, 10):
        progress("texture", done, 10)
    assert lines == [
        "texture: 2 of 10, about 24 s left",
        "texture: 5 of 10, about 12 s left",
        "texture: 20.0 s",
    ]


def test_a_stage_that_comes_twice_is_timed_twice():
    lines, now = [], iter([0.0, 1.0, 5.0, 7.0])
    progress = line_progress(lines.append, clock=lambda: next(now))
    for done in (0, 1, 0, 1):
        progress("views", done, 1)
    assert lines == ["views: 1.0 s", "views: 2.0 s"]


def test_progress_whose_reader_has_gone_ends_no_thread(monkeypatch):
    """`oasis batch` waited for ever: rich had ended Dask's thread, which counts photos."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as nobody:
        monkeypatch.setattr("sys.stderr", nobody)
        with show_progress(Terminal()) as progress:
            for step in range(3):
                progress("fit", step + 1, 3)
        monkeypatch.undo()
        with contextlib.suppress(BrokenPipeError):
            nobody.close()


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_is_shown_on_terminals_and_elsewhere(terminal):
    out = io.StringIO()
    with show_progress(Console(file=out, force_terminal=terminal, width=80)) as progress:
        for done in range(4):
            progress("texture", done, 3)
        progress("landmarks", 1, 1)
    assert "texture" in out.getvalue()
    assert "landmarks" in out.getvalue()
    assert ("\x1b" in out.getvalue()) == terminal


def test_the_summary_has_three_rows_of_panels_that_all_show_something(scene, made):
    reports = []
    sheet = draw_summary([scene[0]], made, progress=lambda *report: reports.append(report)).numpy()
    assert sheet.shape[1] == WIDTH
    total = 1 + VIEWS + len(POSES)
    assert reports == [("summary", n, total) for n in range(1, total + 1)]
    painted = (sheet != PAPER).any(-1)[:, 60].astype(int)  # a column through the first panel of each row
    rows = np.diff(np.flatnonzero(np.diff(painted)))
    for n_panels in (4, VIEWS, len(POSES)):
        assert panel_side(n_panels, WIDTH) in rows


def test_the_avatars_panel_matches_the_photos(scene, made):
    sheet = draw_summary([scene[0]], made).numpy().astype(int)
    side, top = panel_side(4, WIDTH), 24 + 44
    photo, _, mask, avatar = (sheet[top : top + side, 24 + k * (side + 12) :][:, :side] for k in range(4))
    hand = mask[..., 0] > 250
    assert np.abs(photo[hand] - (200, 150, 120)).max() <= 5  # the edge blends in
    assert np.abs(avatar[hand].mean(0) - (200, 150, 120)).max() < 15
    assert (avatar[mask[..., 0] < 5].mean(0) > 220).all()


def test_doubts_are_mentioned(scene, made):
    sure, doubtful = (draw_summary([scene[0]], made._replace(warnings=w)) for w in ((), ("a finger is hidden",)))
    assert (sure[:68] != doubtful[:68]).any()
    assert torch.equal(sure[68:], doubtful[68:])


def test_a_surface_is_brightest_where_it_faces_the_camera(scene, hand):
    _, fit, avatar = scene
    shade, inside = shade_mesh(avatar.mesh(fit.pose), hand.faces, fit.camera)
    assert torch.equal(inside, fit.mask)
    assert (shade[inside == 0] == 0).all()
    assert 0.34 < shade[inside == 1].min() < 0.7
    assert 0.95 < shade.max() <= 1.0001


def test_landmarks_are_drawn_where_they_are():
    points = np.stack([np.linspace(10, 90, 21), np.tile([20.0, 50.0, 80.0], 7)], 1)
    drawn = draw_landmarks(np.zeros((100, 100, 3), np.uint8), points)
    for finger, color in enumerate(FINGER_COLORS):
        x, y = points[4 * finger + 4]
        assert tuple(drawn[int(y), int(x)]) == color


def test_a_mesh_leaves_the_picture_around_it_alone():
    picture = np.full((60, 60, 3), 77, np.uint8)
    inside = np.zeros((60, 60))
    inside[20:40, 20:40] = 1
    drawn = draw_mesh(picture, inside, inside)
    assert (drawn[:18] == 77).all()
    assert (drawn[25:35, 25:35] != 77).all()


def test_panels_stand_beside_each_other_untouched():
    panels = [Panel(np.full((panel_side(2, 200),) * 2 + (3,), value, np.uint8), "x") for value in (10, 90)]
    sheet = make_sheet("title", "more", [panels], 200)
    assert (sheet == 10).all(-1).sum() >= panel_side(2, 200) ** 2
    assert (sheet == 90).all(-1).sum() >= panel_side(2, 200) ** 2


def panels(made, visibility):
    quality = SurfaceQuality(visibility, 1 - visibility)
    sheet = draw_quality("a hand", made.avatar, quality).numpy()
    side, top = panel_side(4, WIDTH), 24 + 44
    assert sheet.shape[1] == WIDTH
    return [sheet[top : top + side, 24 + k * (side + 12) :][:, :side].astype(float) for k in range(4)]


def test_words_under_a_panel_end_before_the_next_one(made, monkeypatch):
    """The legend stood under two panels and ran into the second."""
    places = []
    write = summary.write_text

    def measured(sheet, text, x, y, size, color, weight):
        write(sheet, text, x, y, size, color, weight)
        left, _, width, _ = cv2.getTextSize(sheet.shape[1::-1], text, (x, y), cv2.FontFace("sans"), size, weight)
        places.append((y, left, left + width))

    monkeypatch.setattr(summary, "write_text", measured)
    n = len(made.avatar.hand.template)
    draw_quality("a hand", made.avatar, SurfaceQuality(torch.ones(n), torch.zeros(n), torch.zeros(n)))
    for row in {y for y, *_ in places}:
        ends = [place[1:] for place in places if place[0] == row]
        assert all(before[1] < after[0] for before, after in itertools.pairwise([*ends, [WIDTH, WIDTH]]))


def hue(panel):
    """Mean colour of what is no background, as shares."""
    color = panel[np.ptp(panel, axis=-1) > 12].mean(0)
    return color / color.sum()


def test_each_side_of_the_hand_is_shown_in_the_colours_of_what_is_known_of_it(made):
    n = len(made.avatar.hand.template)
    seen, unseen = panels(made, torch.ones(n)), panels(made, torch.full((n,), 0.1))
    assert hue(seen[0])[1] > 0.42 and hue(seen[1])[1] > 0.42  # green, from both sides
    assert hue(unseen[0])[0] > hue(unseen[0])[1] > hue(unseen[0])[2]  # yellow
    assert hue(seen[2])[2] > 0.4 and hue(unseen[2])[2] < 0.25  # blue where it is sure


def test_the_palm_and_the_back_are_told_apart(made):
    palm = (made.avatar.mesh(made.fit.pose).vertices[:, 2] < 0.6).float()  # the camera looks along z
    front, behind, *_ = panels(made, palm)
    green = [(np.argmax(panel, -1) == 1).mean() for panel in (front, behind)]
    assert green[0] > 2 * green[1]


@pytest.mark.parametrize("quiet", [True, False])
def test_warnings_are_printed_even_when_quiet(quiet, capsys):
    with recorded(ReconstructOptions(photos=(), out=Path("out"), quiet=quiet), ["reconstruct"]):
        print_warnings(plain_console(), ["the thumb is hidden"])
    captured = capsys.readouterr()
    said, silent = (captured.err, captured.out) if quiet else (captured.out, captured.err)
    assert (said, silent) == ("Warning: the thumb is hidden\n", "")
