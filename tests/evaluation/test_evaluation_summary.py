"""Tables from numbers of single pictures."""

import pytest

from oasis_warp.evaluation.methods import BASELINE, METHODS, Method, method_name
from oasis_warp.evaluation.metrics import MEASURES
from oasis_warp.evaluation.summary import difference, mean, select, summarise


def picture(person, target, psnr, method=BASELINE, **more):
    about = {"group": "ordinary", "light": "studio", "noise": 1.0, "colors": "raw", "person": person, "target": target}
    return about | method._asdict() | dict.fromkeys(MEASURES) | {"psnr": psnr} | more


def test_a_person_counts_once_however_many_pictures_there_are():
    before = [picture(1, 0, 20.0), picture(1, 1, 20.0), picture(1, 2, 20.0), picture(2, 0, 30.0)]
    after = [picture(1, 0, 23.0), picture(1, 1, 21.0), picture(1, 2, 23.5), picture(2, 0, 29.5)]
    found = difference(after, before, "psnr")
    assert found is not None
    assert found.mean == pytest.approx((2.5 - 0.5) / 2)
    assert found.error == pytest.approx(1.5)  # standard deviation 1.5 sqrt 2 of two people
    assert found.better == 0.5


def test_only_pictures_that_both_have_are_compared():
    assert difference([picture(1, 0, 20.0)], [picture(2, 0, 10.0)], "psnr") is None
    assert difference([picture(1, 0, None)], [picture(1, 0, 10.0)], "psnr") is None
    found = difference([picture(1, 0, 21.0), picture(1, 1, 99.0)], [picture(1, 0, 20.0)], "psnr")
    assert found == (1.0, None, 1.0)


def test_means_leave_out_what_was_not_measured():
    assert mean([picture(1, 0, 20.0), picture(1, 1, None), picture(1, 2, 22.0)], "psnr") == 21.0
    assert mean([picture(1, 0, 20.0)], "lpips") is None


def test_a_row_for_every_method_and_condition_with_its_gain_over_the_baseline():
    one_shot = Method("learned", "one_shot")
    records = [
        picture(1, 0, 24.0, one_shot), picture(1, 0, 20.0), picture(1, 0, 19.0, light="wild"),
        picture(2, 0, 25.0, one_shot), picture(2, 0, 22.0),
    ]  # fmt: skip
    rows = summarise(records)
    assert [(row["light"], row["prior"], row["stage"]) for row in rows] == [
        ("studio", "mean", "calibrated"), ("studio", "learned", "one_shot"), ("wild", "mean", "calibrated"),
    ]  # fmt: skip
    assert rows[0]["gain"] == 0 and rows[1]["gain"] == 3.5 and rows[1]["better"] == 1
    assert rows[1]["gain_error"] == pytest.approx(0.5)
    assert (rows[1]["people"], rows[1]["pictures"], rows[1]["psnr"]) == (2, 2, 24.5)
    assert select(rows, light="wild") == rows[2:]


def test_without_the_baseline_there_is_no_gain():
    (row,) = summarise([picture(1, 0, 20.0, Method("learned", "raw"))])
    assert row["psnr"] == 20 and row["gain"] is None


def test_methods_have_names_of_their_own():
    assert len({method_name(method) for method in METHODS}) == len(METHODS)
    assert method_name(METHODS[-1]) == "learned one-shot"
