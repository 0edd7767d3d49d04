"""The projection as an operator: what it refuses, and what it does with unchecked values."""

import pytest
import torch
from projection_runs import OPTIONS, run
from rasterization_scenes import covariances, ordinary_scene

from oasis_warp.ops._runtime.records import Tables
from oasis_warp.ops.projection import Projection, project

N = 19
TENSORS = "means", "quats", "scales", "opacities", "viewmats", "Ks"


def spoiled(tensor, value, place):
    """A copy with one value replaced; `place` counts along the first axis."""
    copy = tensor.clone()
    copy.view(len(copy), -1)[place, -1] = value
    return copy


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 2e15])
@pytest.mark.parametrize("name", [*TENSORS, "covars"])
@pytest.mark.parametrize("place", [0, -1])
def test_values_that_are_not_finite_are_refused_by_name(name, value, place, dtype):
    scene = ordinary_scene(40, n=N, dtype=dtype)
    covars = covariances(scene) if name == "covars" else None
    if name == "covars":
        covars = spoiled(covars, value, place)
    else:
        scene = scene.with_(**{name: spoiled(getattr(scene, name), value, place)})
    with pytest.raises(ValueError, match=rf"^{name}: expected finite values below 1e\+15, got 1 of"):
        run(scene, covars, validate=True)


@pytest.mark.parametrize("place", [0, 7, 8, 18])
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("quats", 0.0, "quats: expected rows that are not zero, got 1 zero rows"),
        ("opacities", 1.25, "opacities: expected values in .0, 1., got 0.* to 1.25"),
        ("opacities", -0.5, "opacities: expected values in .0, 1., got -0.5 to"),
    ],
)
def test_a_value_out_of_range_is_refused_wherever_it_stands(name, value, words, place, dtype):
    scene = ordinary_scene(41, n=N, dtype=dtype)
    tensor = getattr(scene, name).clone()
    tensor[place] = value
    with pytest.raises(ValueError, match=words):
        run(scene.with_(**{name: tensor}), validate=True)


@pytest.mark.parametrize("entry", [(0, 0), (1, 1)])
def test_a_focal_length_of_zero_is_refused(entry, dtype):
    scene = ordinary_scene(42, n=N, dtype=dtype)
    Ks = scene.Ks.clone()
    Ks[1, entry[0], entry[1]] = 0
    with pytest.raises(ValueError, match="Ks: expected focal lengths other than 0"):
        run(scene.with_(Ks=Ks), validate=True)


def test_a_negative_variance_is_refused(dtype):
    scene = ordinary_scene(43, n=N, dtype=dtype)
    covars = covariances(scene)
    covars[17, 1, 1] *= -1
    with pytest.raises(ValueError, match="covars: expected variances of at least 0, got 1 matrices"):
        run(scene, covars, validate=True)


def test_values_are_looked_at_where_there_is_nothing_to_project(dtype):
    scene = ordinary_scene(44, n=N, dtype=dtype)
    none = scene.with_(**{k: getattr(scene, k)[:0] for k in ("means", "quats", "scales", "opacities")})
    run(none, validate=True)
    with pytest.raises(ValueError, match="viewmats: expected finite"):
        run(none.with_(viewmats=spoiled(scene.viewmats, float("nan"), 0)), validate=True)


def test_extreme_values_within_the_limits_are_accepted(dtype):
    scene = ordinary_scene(45, n=N, dtype=dtype)
    opacities = scene.opacities.clone()
    opacities[0], opacities[1] = 0.0, 1.0
    scales = scene.scales.clone()
    scales[2], scales[3] = 9e14, 0.0
    quats = scene.quats.clone()
    quats[4] = torch.tensor([0.0, 1e-30, 0.0, 0.0])
    checked = run(scene.with_(opacities=opacities, scales=scales, quats=quats), validate=True)
    assert all(torch.isfinite(t).all() for t in [*checked[0], *checked[1].values()])


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["means", "quats", "scales"])
def test_unchecked_a_bad_gaussian_is_not_drawn_and_harms_no_other(name, value, dtype, device):
    scene = ordinary_scene(46, n=N, dtype=dtype, device=device)
    bad = getattr(scene, name).clone()
    bad[5] = value
    names = "means", "quats", "scales"
    got, want = run(scene.with_(**{name: bad}), by=names), run(scene, by=names)
    assert all(torch.isfinite(g).all() for g in got[1].values())
    assert not got[0].radii[:, 5].any() and not got[0].tables().boxes[:, 5].any()
    others = torch.arange(N, device=device) != 5
    fields = (*Projection._fields[:-1], *Tables._fields)
    for field, a, b in zip(fields, *((*p[:-1], *p.tables()) for p in (got[0], want[0])), strict=True):
        assert torch.equal(a[:, others], b[:, others]), field
    for key in names:
        assert torch.equal(got[1][key][others], want[1][key][others]), key


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"quats": None}, "covars: expected either covars, or quats and scales"),
        ({"covars": torch.zeros(N, 3, 3)}, "covars: expected either covars, or quats and scales"),
        ({"quats": torch.zeros(N - 1, 4)}, r"quats: expected shape \[19, 4\]"),
        ({"scales": torch.zeros(N, 3, dtype=torch.float64)}, r"scales: expected shape \[19, 3\], torch.float32"),
        ({"opacities": torch.zeros(N - 1)}, r"opacities: expected shape \[19\]"),
        ({"Ks": torch.zeros(1, 3, 3)}, r"Ks: expected shape \[2, 3, 3\]"),
        ({"viewmats": torch.zeros(2, 3, 4)}, r"viewmats: expected shape \[2, 4, 4\]"),
    ],
)
def test_arrays_that_a_kernel_would_run_out_of_are_refused(changes, words):
    scene = ordinary_scene(47, n=N)
    named = {k: getattr(scene, k) for k in TENSORS} | {"covars": None} | changes
    with pytest.raises(ValueError, match=words):
        project(**named, width=scene.width, height=scene.height, **OPTIONS)
