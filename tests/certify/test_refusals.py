"""Every bad argument is refused by its name, and a pass on in silence is found."""

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.certification import full_scene
from oasis_warp.certify.families import FAMILIES
from oasis_warp.certify.refusals import refusals

pytestmark = pytest.mark.usefixtures("as_shipped")


@pytest.mark.parametrize("name", FAMILIES)
def test_bad_values_shapes_and_indices_are_refused_by_name(name, device):
    family = FAMILIES[name]
    found = refusals(family, full_scene(family, 0), device)
    assert {m.check.split(" not ")[0] for m in found} >= {"NaN or Inf", "wrong shapes"}
    assert not [m for m in found if not m.passed]


def test_an_operator_that_does_not_look_is_found(monkeypatch):
    family = FAMILIES["face_rotations"]
    right = ops.face_rotations
    monkeypatch.setattr(ops, "face_rotations", lambda **given: right(**given, validate=False))
    found = refusals(family, full_scene(family, 0), torch.device("cpu"))
    assert sum(not m.passed for m in found if m.check.startswith("NaN")) == 6


@pytest.mark.parametrize("options", [{"mode": "D"}, {"mode": "RGB", "sh_degree": 2}])
def test_colors_that_are_no_numbers_are_refused_by_name_in_every_mode(options):
    family = FAMILIES["rasterization"]
    case = family.case("ordinary", 0, n=5, size=(5, 4), channels=3, **options)
    bad = case.floats["colors"].clone()
    bad.view(-1)[0] = torch.nan
    arguments = case.arguments(torch.float32, torch.device("cpu")) | {"colors": bad.float()}
    with pytest.raises(ValueError, match="^colors: "):
        family.call(arguments)
