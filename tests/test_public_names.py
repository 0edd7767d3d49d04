import subprocess
import sys

import pytest

import oasis_warp


@pytest.mark.parametrize("name", oasis_warp.__all__)
def test_every_public_name_has_a_home_and_a_docstring(name):
    assert getattr(oasis_warp, name).__doc__
    assert name in dir(oasis_warp)


def test_the_list_of_names_is_the_table_of_homes():
    assert sorted(oasis_warp.__all__) == sorted(oasis_warp._HOMES)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = oasis_warp.no_such_name


def test_importing_the_package_loads_neither_torch_nor_warp():
    code = "import sys, oasis_warp; sys.exit(any(m in sys.modules for m in ('torch', 'warp', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
