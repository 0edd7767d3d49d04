"""Programs of others read what we write, where they are installed: gaussforge from PyPI, splat-transform from npm."""

import shutil
import subprocess

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.export.splat_readers import READERS

from oasis_warp.core.errors import InputError
from oasis_warp.data.splat_files import read_splats
from oasis_warp.export import export_avatar

FORMATS = {".ply": "ply", ".compressed.ply": "compressed.ply", ".splat": "splat", ".spz": "spz", ".sog": "sog"}
"""As gaussforge calls them."""


def by_gaussforge(path, ending, out):
    gaussforge = pytest.importorskip("gaussforge").GaussForge()
    result = gaussforge.convert(path.read_bytes(), FORMATS[ending], "ply")
    assert "error" not in result, result["error"]
    out.write_bytes(result["data"])


def by_splat_transform(path, ending, out):
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("needs `npm install -g @playcanvas/splat-transform`")
    subprocess.run([program, str(path), str(out)], check=True, timeout=200, capture_output=True)


@pytest.mark.slow
@pytest.mark.parametrize("convert", [by_gaussforge, by_splat_transform])
@pytest.mark.parametrize("ending", FORMATS)
def test_other_programs_read_the_same_gaussians(left_hand, tmp_path, ending, convert):
    """A mistake that our writer and our reader share shows."""
    path, out = tmp_path / f"hand{ending}", tmp_path / "again.ply"
    export_avatar(left_hand, path)
    convert(path, ending, out)
    means, _, scales, opacities, colors = READERS[ending](path)
    theirs = READERS[".ply"](out)
    if ending == ".spz" and convert is by_gaussforge:  # it leaves y up in a .ply, where it points down
        means = means * [1, -1, -1]
    away, index = cKDTree(theirs[0]).query(means, 2)
    assert len(theirs[0]) == len(means)
    assert away[:, 0].max() < 1e-5
    alone = away[:, 1] > 3 * away[:, 0] + 1e-4  # the others may be taken for a neighbour
    near = index[alone, 0]
    assert alone.mean() > 0.5
    np.testing.assert_allclose(np.sort(theirs[2][near]), np.sort(scales[alone]), rtol=1e-3)
    np.testing.assert_allclose(theirs[3][near], opacities[alone], atol=4e-3)
    np.testing.assert_allclose(theirs[4][near], colors[alone], atol=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_spz_of_another_program_is_read(right_hand, tmp_path, version):
    gaussforge = pytest.importorskip("gaussforge").GaussForge()
    export_avatar(right_hand, tmp_path / "hand.ply")
    for wanted, name in ((version, "theirs.spz"), (4, "new.spz")):
        result = gaussforge.convert((tmp_path / "hand.ply").read_bytes(), "ply", "spz", spz_version=wanted)
        assert "error" not in result, result["error"]
        (tmp_path / name).write_bytes(result["data"])
    with pytest.raises(InputError, match="versions 2 and 3 are read, not 4"):
        read_splats(tmp_path / "new.spz")
    found, expected = read_splats(tmp_path / "theirs.spz"), read_splats(tmp_path / "hand.ply")
    away, _ = cKDTree(found.means.numpy() * [1, -1, -1]).query(expected.means.numpy())
    assert away.max() < 5e-4  # its steps are a quarter of a millimetre
