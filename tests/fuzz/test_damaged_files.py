"""A few damaged files of every kind; `long_run.py` beside this reads thousands."""

import os

import pytest
from fuzz import targets

from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.data.splat_files import read_splats
from oasis_warp.datasets.readers import read_selection
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion import read_motion

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


@pytest.mark.slow
@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", ["mano", "data_sets"])
def test_damaged_models_and_annotations_are_refused_in_one_sentence_or_read(name, tmp_path):
    assert outcomes(getattr(targets, name)(tmp_path), 40, tmp_path) <= {"refused", "taken"}


READERS = {
    ".png": read_photo, ".safetensors": Avatar.load, ".ply": read_splats, ".splat": read_splats, ".spz": read_splats,
    ".bvh": lambda path: read_motion(path, targets.small_avatar(lit=False)), ".json": read_selection,
}  # fmt: skip


@pytest.mark.timeout(20)
@pytest.mark.parametrize("suffix", READERS)
def test_no_reader_waits_for_a_pipe(suffix, tmp_path):
    os.mkfifo(tmp_path / f"a{suffix}")
    with pytest.raises(InputError):
        READERS[suffix](tmp_path / f"a{suffix}")
