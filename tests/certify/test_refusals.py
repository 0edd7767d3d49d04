"""Every bad argument is refused by its name, and a pass on in silence is found."""

import pytest
import torch

from oasis_warp import ops
from oasis_warp.certify.families import FAMILIES
from oasis_warp.certify.refusals import refusals

pytestmark = pytest.mark.usefixtures("as_shipped")


def full_scene(family):
    cases = (family.case("ordinary", seed) for seed in range(100))
    return next(c for c in cases if all(t.numel() for t in c.floats.values()) and set(family.indices) <= set(c.others))


@pytest.mark.parametrize("name", FAMILIES)
def test_bad_values_shapes_and_indices_are_refused_by_name(name, device):
    family = FAMILIES[name]
    found = refusals(family, full_scene(family), device)
    assert {m.check.split(" not ")[0] for m in found} >= {"NaN and infinities", "wrong shapes"}
    assert not [m for m in found if not m.passed]


def test_an_operator_that_does_not_look_is_found(monkeypatch):
    family = FAMILIES["face_rotations"]
    right = ops.face_rotations
    monkeypatch.setattr(ops, "face_rotations", lambda **given: right(**given, validate=False))
    found = refusals(family, full_scene(family), torch.device("cpu"))
    assert sum(not m.passed for m in found if m.check.startswith("NaN")) == 6
