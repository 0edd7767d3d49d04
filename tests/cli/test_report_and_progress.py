import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from oasis_warp.cli.console import line_progress, show_progress
from oasis_warp.cli.record import recorded
from oasis_warp.cli.report import make_report, print_report, to_json
from oasis_warp.core.config import ReconstructConfig


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
    said = ("fit", "1.23 s", "total", "likeness to the photo", "30.0 dB", "new_measure", "0.1235")
    for part in ("prior learned", *said):
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
