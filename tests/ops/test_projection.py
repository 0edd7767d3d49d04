"""Projection: the vector kernels of the CPU against the generic float64 one, and laws that both obey."""

import pytest
import torch
from rasterization_scenes import (
    CONDITIONS,
    OPTIONS,
    assert_equal_bits,
    covariances,
    incoming,
    ordinary_scene,
    run,
    stiff_scene,
)

from oasis_kernels.constants import Rules
from oasis_warp.ops import projection as module
from oasis_warp.ops._runtime.records import Tables
from oasis_warp.ops._runtime.rules import using
from oasis_warp.ops.projection import Projection, project

# Both kernels compute in float64: what differs is the rounding of the stored float32, 6e-8 relative.
ROUNDING = 2e-7


NAMES = (*Projection._fields[:-1], *Tables._fields)


def assert_same(vectors, generic):
    """A float32 projection and its gradients against float64 ones: values one by one, gradients by rel-L2."""
    (got, g_got), (want, g_want) = vectors, generic
    for name, a, b in zip(NAMES, (*got[:-1], *got.tables()), (*want[:-1], *want.tables()), strict=True):
        if a.dtype == torch.int32:
            assert torch.equal(a, b), name
            continue
        if name == "centers":  # what is whole depends on the rounding of large coordinates, the sum does not
            a, b = (t[..., :2].double() + t[..., 2:].double() for t in (a, b))
        assert torch.isfinite(a).all(), name
        scale = float(b.abs().max()) if b.numel() else 0.0
        atol = 1e-7 if name == "centers" else 1e-12 * scale  # the remainder is rounded as a number of up to 1 pixel
        torch.testing.assert_close(a.double(), b.double(), rtol=ROUNDING, atol=atol, msg=name)
    for name, b in g_want.items():
        error = float((g_got[name].double() - b).norm() / b.norm().clamp_min(1e-300))
        assert error <= ROUNDING, f"{name}: {error:.1e}"


def both(scene, **options):
    return run(scene.to("cpu", torch.float32), **options), run(scene.to("cpu", torch.float64), **options)


@pytest.mark.parametrize("seed", range(4))
def test_vectors_equal_the_generic_kernel_on_ordinary_scenes(seed):
    assert_same(*both(ordinary_scene(seed, n=100 + 7 * seed, cameras=1 + seed)))


@pytest.mark.parametrize("name", CONDITIONS)
def test_vectors_equal_the_generic_kernel_on_stiff_scenes(name):
    assert_same(*both(stiff_scene(name)))


@pytest.mark.parametrize(
    "options",
    [
        {"near_plane": 2.9, "far_plane": 3.3},
        {"radius_clip": 6.0},
        {"eps2d": 0.0},
        {"near_plane": 50.0, "far_plane": 60.0},
    ],
    ids=["planes", "radius clip", "no low-pass", "nothing drawn"],
)
def test_vectors_cull_what_the_generic_kernel_culls(options):
    scene = ordinary_scene(5, n=150, cameras=2)
    (got, g_got), (want, g_want) = both(scene, **options)
    assert not (want.radii > 0).all() or "eps2d" in options
    assert_same((got, g_got), (want, g_want))


def test_vectors_bear_needles_whose_determinant_would_cancel_in_float64():
    scene = ordinary_scene(18, n=30)
    scales = torch.tensor([3e5, 1e-4, 1e-4]).repeat(30, 1)
    (vectors, _), (generic, _) = both(scene.with_(scales=scales))
    xx, xy, yy = generic.covars2d.unbind(-1)
    det = generic.conics[..., 0] * generic.conics[..., 2] - generic.conics[..., 1] ** 2
    assert (generic.radii > 0).any() and not torch.allclose((xx * yy - xy * xy) * det, torch.ones_like(det))
    got, want = vectors.tables().whitenings, generic.tables().whitenings
    torch.testing.assert_close(got.double(), want, rtol=ROUNDING, atol=0.0)


@pytest.mark.parametrize("n", [0, 1, 7, 8, 9, 15, 16, 17])
def test_the_first_gaussians_do_not_depend_on_how_many_follow(n, dtype):
    scene = ordinary_scene(8, n=40, cameras=2, dtype=dtype)
    few = scene.with_(**{k: getattr(scene, k)[:n] for k in ("means", "quats", "scales", "opacities")})
    per_gaussian = "means", "quats", "scales"
    arguments = [scene.Ks, scene.width, scene.height]
    results = []
    for s in (few, scene):
        inputs = {k: getattr(s, k).clone().requires_grad_() for k in per_gaussian}
        out = project(*inputs.values(), s.opacities, s.viewmats, *arguments, **OPTIONS)
        given = [g[:, : len(s.means)] for g in incoming_like(scene, out)]
        gradients = torch.autograd.grad(out[:3], list(inputs.values()), given)
        values = (*out[:-1], *out.tables())
        results.append([*(t.detach()[:, :n] for t in values), *(g[:n] for g in gradients)])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def incoming_like(scene, projection):
    """`incoming` for all Gaussians of `scene`, in the types of `projection`."""
    g = torch.Generator().manual_seed(0)
    shape = len(scene.viewmats), len(scene.means)
    sizes = [(*shape, 2), (*shape, 3), shape]
    return [torch.randn(size, generator=g).to(out) for size, out in zip(sizes, projection, strict=False)]


def test_gaussians_that_are_not_drawn_pass_on_the_gradient_of_depth_only(dtype, device):
    scene = ordinary_scene(14, n=19, dtype=dtype, device=device)
    inputs = [getattr(scene, k).clone().requires_grad_() for k in ("means", "quats", "scales")]
    out = project(
        *inputs, scene.opacities, scene.viewmats, scene.Ks, scene.width, scene.height,
        **(OPTIONS | {"near_plane": 100.0, "far_plane": 200.0}),
    )  # fmt: skip
    assert not out.radii.any() and not any(t.any() for t in (out.means2d, out.covars2d, out.conics, out.tables().boxes))
    g_means, g_quats, g_scales = torch.autograd.grad(out[:3], inputs, incoming(out))
    towards = scene.viewmats[:, None, 2, :3] * incoming(out)[2][..., None]
    torch.testing.assert_close(g_means, towards.sum(0))
    assert not g_quats.any() and not g_scales.any()


def test_rules_decide_what_is_drawn_and_how_far_it_reaches(dtype, device):
    scene = ordinary_scene(15, dtype=dtype, device=device)
    plain, _ = run(scene)
    with using(Rules(alpha_min=0.3)):
        strict, _ = run(scene)
    with using(Rules(extent_sigmas=1.0)):
        narrow, _ = run(scene)
    drawn = (plain.radii > 0).all(-1)
    assert torch.equal((strict.radii > 0).all(-1) & drawn, (scene.opacities >= 0.3) & (strict.radii > 0).all(-1))
    assert not strict.radii[:, scene.opacities < 0.3].any() and strict.radii.any()
    sigma = narrow.covars2d[..., [0, 2]].sqrt()
    wide = sigma[(narrow.radii > 0).all(-1) & (scene.opacities > 0.9)]
    radii = narrow.radii[(narrow.radii > 0).all(-1) & (scene.opacities > 0.9)]
    assert len(wide) and torch.equal(radii, wide.ceil().int())


GUARD = 64
"""Elements on either side of a guarded tensor."""


def guarded(like, fill):
    """Memory for a tensor like this one in the middle of a larger one, and that one."""
    whole = torch.full((like.numel() + 2 * GUARD,), fill, dtype=like.dtype)
    return whole[GUARD : GUARD + like.numel()].view(like.shape), whole


@pytest.mark.parametrize("n", [1, 7, 8, 13, 16, 519])
@pytest.mark.parametrize("with_covars", [False, True], ids=["quats", "covars"])
def test_nothing_is_read_or_written_beside_the_arrays(n, with_covars, monkeypatch):
    wholes = []

    def surround(make):
        def made(*arguments):
            plain, inner = make(*arguments), []
            for tensor in plain:
                middle, whole = guarded(tensor, 77)
                wholes.append(whole)
                inner.append(middle)
            return type(plain)(inner)

        return made

    monkeypatch.setattr(module, "empty_outputs", surround(module.empty_outputs))
    monkeypatch.setattr(module, "empty_gradients", surround(module.empty_gradients))

    def amid_nan(t):
        middle, _ = guarded(t, float("nan"))
        return middle.copy_(t)

    scene = ordinary_scene(16, n=n, cameras=2)
    covars = covariances(scene) if with_covars else None
    plain = run(scene, covars)
    scene = scene.with_(**{k: amid_nan(v) for k, v in scene.tensors.items()})
    # What lies around the inputs is NaN: to read it would fail the check of values or change a result.
    assert_equal_bits(run(scene, amid_nan(covars) if with_covars else None, validate=True), plain)
    assert len(wholes) == 2 * (6 + 5)
    for whole in wholes:
        assert (whole[:GUARD] == 77).all() and (whole[-GUARD:] == 77).all()


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
        ("quats", 0.0, "quats: expected nonzero rows, got 1 zero rows"),
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
