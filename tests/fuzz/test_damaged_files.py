"""A few damaged files of every kind; `long_run.py` beside this reads thousands."""

import pytest
from fuzz import targets

SEED = 2026


def outcomes(target: targets.Target, count: int, folder) -> set[str]:
    return {targets.run(target, SEED, index, folder) for index in range(count)}


@pytest.mark.timeout(60)
def test_damaged_avatars_are_refused_in_one_sentence_or_drawn_sanely(tmp_path):
    assert outcomes(targets.avatars(tmp_path, lit=False), 15, tmp_path) == {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_gaussians_are_refused_in_one_sentence_or_shown(tmp_path):
    assert outcomes(targets.splats(tmp_path), 60, tmp_path) == {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_motions_are_refused_in_one_sentence_or_played(tmp_path):
    assert outcomes(targets.motions(tmp_path), 60, tmp_path) == {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_weights_are_refused_in_one_sentence_or_finite(tmp_path):
    assert outcomes(targets.weights(tmp_path), 3, tmp_path) <= {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_landmarks_are_refused_in_one_sentence_or_read(tmp_path):
    target = targets.keypoints(*targets.plain_photo(), targets.small_avatar(lit=False).source_pose, fit=False)
    points = targets.Target({".json": target.files[".points.json"]}, target.mutate, target.read)
    assert outcomes(points, 150, tmp_path) == {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_estimates_are_refused_in_one_sentence_or_read(tmp_path):
    assert outcomes(targets.estimates(), 150, tmp_path) == {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_pictures_are_refused_in_one_sentence_or_read(tmp_path):
    assert outcomes(targets.images(avif=False), 150, tmp_path) == {"refused", "taken"}


@pytest.mark.timeout(60)
def test_damaged_requests_are_answered_or_refused(tmp_path):
    assert outcomes(targets.requests(tmp_path), 150, tmp_path) == {"refused", "taken"}
