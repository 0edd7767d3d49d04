import re
from pathlib import Path

TOP = Path(__file__).parents[1]


def test_no_copyleft_part_of_libigl_is_imported():
    """Its wheel ships GPL binaries beside its MPL core."""
    assert "igl.copyleft" in (TOP / "NOTICE").read_text()
    places = ("src", "kernels", "tests", "studies", "asset_build", "examples")
    files = [file for place in places for file in (TOP / place).rglob("*.py") if file != Path(__file__)]
    assert len(files) > 100
    using = {str(file.relative_to(TOP)) for file in files if re.search(r"\bigl\b", file.read_text())}
    assert not [name for name in using if re.search(r"copyleft|tetgen|cgal", (TOP / name).read_text())]
    assert not [name for name in using if name.startswith(("src", "kernels"))]
