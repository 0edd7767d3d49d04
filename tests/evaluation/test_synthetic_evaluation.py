"""The evaluation as a whole: what it leaves, that it goes on where it was stopped, and what it refuses."""

import json
from dataclasses import replace

import pytest
import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.errors import InputError
from oasis_warp.evaluation import synthetic
from oasis_warp.evaluation.held_out import FIRST_PERSON, CaptureConfig, capture_person, estimated_batch
from oasis_warp.evaluation.methods import METHODS, Method, prior_digest, reconstructions
from oasis_warp.evaluation.metrics import MEASURES
from oasis_warp.evaluation.synthetic import (
    ATTENTION,
    METRICS,
    PEOPLE,
    SETTINGS,
    SHEET,
    SyntheticEvaluation,
    _packed,
    _Setup,
    _unpacked,
    crop_of,
    evaluate_people,
)
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
TINY = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
CONFIG = SyntheticEvaluation(
    groups=("ordinary",), people=1, noise=(1.0,), curve=(), capture=CaptureConfig(targets=2, size=64),
    adapt=AdaptConfig(texture_steps=1, reference_views=1),
)  # fmt: skip


def default_priors(network):
    """The priors of `METHODS`: the mean hand, and the learned one where there is a network."""
    learned = {} if network is None else {"learned": NetworkPrior(network)}
    return {"mean": MeanPrior(bundled_hand()), **learned}


@pytest.fixture(scope="module")
def network(hand):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return HandNetwork(TINY, hand)


@pytest.fixture(scope="module")
def left(network, tmp_path_factory):
    """What an evaluation leaves, and what it returns."""
    folder = tmp_path_factory.mktemp("evaluation") / "found"
    return folder, evaluate_people(default_priors(network), CONFIG, folder, CPU)


def test_numbers_and_pictures_are_left(left, network):
    folder, found = left
    assert {path.name for path in folder.iterdir()} == {SETTINGS, METRICS, SHEET, ATTENTION, PEOPLE}
    assert json.loads((folder / METRICS).read_text()) == found
    assert len(found["pictures"]) == 3 * 2 * 2 * len(METHODS)  # lights, targets, colours
    assert all(set(MEASURES) < set(record) for record in found["pictures"])
    assert all(10 < record["psnr"] < 45 for record in found["pictures"])
    assert found["settings"]["priors"]["mean"] is None
    assert found["settings"]["priors"]["learned"] == prior_digest(default_priors(network)["learned"])
    by_colors = [
        [record["psnr"] for record in found["pictures"] if record["colors"] == colors] for colors in ("raw", "matched")
    ]
    assert all(matched >= raw - 0.02 for raw, matched in zip(*by_colors, strict=True))  # clipped after the best gain


def test_an_untrained_network_is_the_mean_hand(left):
    rows = [row for row in left[1]["summary"] if row["stage"] == "one_shot" and row["colors"] == "matched"]
    for light in ("same", "studio", "wild"):
        mean, learned = (row for row in rows if row["light"] == light)
        assert mean["psnr"] == pytest.approx(learned["psnr"], abs=0.15)


def test_without_a_network_what_needs_none_is_measured_alone(left, tmp_path):
    found = evaluate_people(default_priors(None), replace(CONFIG, lights=("studio",)), tmp_path / "found", CPU)
    assert {record["prior"] for record in found["pictures"]} == {"mean"}
    assert not (tmp_path / "found" / ATTENTION).exists()
    same = [r for r in left[1]["pictures"] if (r["prior"], r["light"]) == ("mean", "studio")]
    assert len(found["pictures"]) == len(same)
    for one, other in zip(found["pictures"], same, strict=True):  # some processors round by where memory begins
        assert one == pytest.approx(other, abs=0.05)


def test_a_run_that_was_stopped_goes_on_with_who_is_missing(left, network, tmp_path, monkeypatch):
    changes = {"groups": ("ordinary", "ring"), "lights": ("studio",), "curve": (2.0,), "methods": (METHODS[2],)}
    config = replace(CONFIG, **changes)
    folder = tmp_path / "found"

    def stop(stage, done, total):
        if (stage, done) == ("evaluation", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_people(default_priors(network), config, folder, CPU, progress=stop)
    assert not (folder / METRICS).exists()
    first = folder / PEOPLE / f"ordinary_{FIRST_PERSON}.json"
    written = first.stat().st_mtime_ns
    met = []
    monkeypatch.setattr(synthetic, "capture_person", lambda *who: met.append(who[1:3]) or capture_person(*who))
    found = evaluate_people(default_priors(network), config, folder, CPU)
    assert met == [("ring", FIRST_PERSON)] and first.stat().st_mtime_ns == written
    measured = {(record["group"], record["noise"]) for record in found["pictures"]}
    assert measured == {("ordinary", 1.0), ("ordinary", 2.0), ("ring", 1.0)}
    again = evaluate_people(default_priors(network), config, folder, CPU)
    assert again == found and len(met) == 1


def test_what_measures_people_travels_whole(hand, network):
    priors = default_priors(network)
    there = _unpacked(_packed(_Setup(priors, CONFIG, None)))
    assert list(there.priors) == list(priors) and there.config == CONFIG and there.perceptual is None
    assert {name: prior_digest(prior) for name, prior in there.priors.items()} == {
        name: prior_digest(prior) for name, prior in priors.items()
    }
    assert all(dict(there.priors[name].about) == dict(prior.about) for name, prior in priors.items())


def test_people_measured_by_other_processes_come_out_the_same(left, network, tmp_path):
    config = replace(CONFIG, people=2, lights=("studio",), methods=(METHODS[2],))
    here = evaluate_people(default_priors(network), config, tmp_path / "here", CPU)
    there = evaluate_people(default_priors(network), config, tmp_path / "there", CPU, workers=1)
    assert [record["person"] for record in there["pictures"][:: len(there["pictures"]) // 2]] == [
        FIRST_PERSON, FIRST_PERSON + 1
    ]  # fmt: skip
    assert there == here


def test_another_evaluation_in_the_same_folder_is_refused(left, network):
    before = (left[0] / METRICS).read_bytes()
    with pytest.raises(InputError, match="an evaluation made with other settings, curve"):
        evaluate_people(default_priors(network), replace(CONFIG, curve=(4.0,)), left[0], CPU)
    with torch.no_grad():
        network.vertex_head.last.bias += 1
    with pytest.raises(InputError, match="an evaluation made with other settings, priors"):
        evaluate_people(default_priors(network), CONFIG, left[0], CPU)
    with torch.no_grad():
        network.vertex_head.last.bias -= 1
    assert (left[0] / METRICS).read_bytes() == before


def test_a_place_that_is_no_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="found a file"):
            evaluate_people(default_priors(None), CONFIG, place, CPU)


def test_each_stage_goes_on_from_the_one_before(hand, network):
    person = capture_person(CONFIG.capture, "ordinary", FIRST_PERSON, CPU)
    batch = estimated_batch(hand, person, "wild", CONFIG.capture, 0.0)
    crop = crop_of(batch)
    made = dict(reconstructions(hand, crop, default_priors(network), METHODS, CONFIG.adapt))
    assert tuple(made) == METHODS
    stages = ("raw", "calibrated", "one_shot")
    raw, calibrated, one_shot = (made[Method("learned", stage)].gaussians.colors for stage in stages)
    gains = (calibrated - calibrated.mean(0)) / (raw - raw.mean(0))
    clear = ((raw - raw.mean(0)).abs() > 0.02).all(1) & ((calibrated > 0) & (calibrated < 1)).all(1)
    assert float(gains[clear].std(0).max()) < 1e-2  # one gain and one offset a channel
    assert not torch.allclose(calibrated, one_shot, atol=0.01)
    (alone,) = reconstructions(hand, crop, default_priors(network), METHODS[:1], CONFIG.adapt)
    assert torch.equal(alone[1].gaussians.colors, made[METHODS[0]].gaussians.colors)
