"""The study of the paper's profile, with few channels, small pictures, and self-attention over few points."""

from dataclasses import replace

import pytest
from pretraining.painted_hands import PaintedHands

from oasis_warp.core.config import PAPER_ADAPTATION
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import PAPER, PROFILES
from oasis_warp.network.encoders import SIZES, Size
from studies import paper_profile
from studies.paper_profile import Options, run

TINY = replace(
    PAPER, backbone="dinov2-small", image_size=28, width=16, heads=2, n_tokens=8, n_coarse=64, head_width=8
)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_papers_network_learns_people_by_heart_from_random_weights(monkeypatch, tmp_path):
    monkeypatch.setitem(PROFILES, "paper", TINY)
    monkeypatch.setitem(SIZES, "dinov2-small", Size(32, 2, 2))
    made = lambda hands, options, planners=0: PaintedHands(bundled_hand(), hands, 1, options.size)(0, 0, 1)  # noqa: E731
    monkeypatch.setattr(paper_profile, "batches", made)  # people of the synthetic world take long to bake
    monkeypatch.setattr(paper_profile, "PEOPLE", 2)
    few = replace(PAPER_ADAPTATION, calibration_steps=2, texture_steps=3, reference_views=1)
    monkeypatch.setattr(paper_profile, "PAPER_ADAPTATION", few)
    options = Options(
        out=tmp_path, device="cpu", profiles=("paper",), hands=(1,), steps=6, learning_rate=0.02, warmup=1, timed=1,
        size=32, precision="float32", planners=0,
    )  # fmt: skip
    rows = run(options)
    first, last = (next(row for row in rows if row.get("step") == step) for step in (0, 6))
    assert last["psnr"] > first["psnr"] + 0.5 and last["loss"] < 0.95 * first["loss"]
    costs = [row for row in rows if row["kind"] == "cost"]
    assert [row["lpips"] for row in costs] == [False, True] and all(row["step_s"] > 0 for row in costs)
    adapted = next(row for row in rows if row["kind"] == "adaptation")
    assert adapted["steps"] == "2 + 3" and adapted["last"] < adapted["first"]
    assert all(section.text(rows) for section in paper_profile.SECTIONS)
