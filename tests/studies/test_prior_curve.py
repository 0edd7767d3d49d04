"""The study of the prior's growth: it trains, measures with painted skin, and its tables leave out what was not run."""

import pytest

from studies import prior_curve
from studies.harness import read_rows


def row(network, stage="raw", **numbers):
    return {
        "network": network, "stage": stage, "title": network, "seed": 0, "people": 1,
        **dict.fromkeys(prior_curve.MEASURES, 0.5), **numbers,
    }  # fmt: skip


def test_the_curve_shows_the_spread_of_seeds_and_only_what_was_trained():
    text = prior_curve.curve([row("few_0", psnr_hidden=26.0), row("few_1", psnr_hidden=28.0), row("learned")]) or ""
    assert "| 64 people | 0.50 ± 0.00 | 0.50 ± 0.00 | 27.00 ± 1.41 | 0.50 / 0.50 / 0.50 / 0.50 |" in text
    assert "1024 people" not in text and "learned" not in text
    assert prior_curve.curve([row("learned")]) is None is prior_curve.sharp([row("learned")])


@pytest.mark.slow
def test_networks_are_trained_and_measured_as_guessed_adapted_and_painted(tmp_path, monkeypatch):
    few = {"sharp": prior_curve.SHARP["sharp"]._replace(people=1, steps=1)}
    monkeypatch.setattr(prior_curve, "SHARP", few)
    options = prior_curve.Options(of=("sharp",), hands=1, views=1, held_out=1, out=tmp_path)
    rows = prior_curve.run(options)
    assert read_rows(tmp_path / "prior_curve" / "rows.jsonl") == rows
    assert [(each["network"], each["stage"]) for each in rows] == [
        (network, stage) for network in ("learned", "sharp_0") for stage in ("raw", "one_shot", "painted")
    ]
    guessed, _, painted = rows[:3]
    assert painted["hidden contrast 2-4"] > 1.5 * guessed["hidden contrast 2-4"]
    assert prior_curve.curve(rows) is None and "painted" in (prior_curve.sharp(rows) or "")
