"""Gaussians given by covariances: their projection, without rank too, and `covars` of the rasterizer."""

import pytest
import torch
from rasterization_scenes import OPTIONS, covariances, frontal_scene, incoming, ordinary_scene, run
from test_projection import assert_same

from oasis_warp.ops import rasterization
from oasis_warp.ops.projection import project

LOW_PASS = float(torch.tensor(OPTIONS["eps2d"], dtype=torch.float32))  # a float32 number in both precisions


def dense(means, covars, viewmats, Ks):
    """J R A R^T J^T + low-pass, xx, xy, yy, with A the symmetric part of `covars`; no slope is clamped."""
    out = []
    for viewmat, K in zip(viewmats, Ks, strict=True):
        R = viewmat[:3, :3]
        x, y, z = (means @ R.T + viewmat[:3, 3]).unbind(-1)
        zero = torch.zeros_like(z)
        rows = [K[0, 0] / z, zero, -K[0, 0] * x / z**2, zero, K[1, 1] / z, -K[1, 1] * y / z**2]
        T = torch.stack(rows, -1).view(-1, 2, 3) @ R
        cov = T @ (0.5 * (covars + covars.mT)) @ T.mT + LOW_PASS * torch.eye(2, dtype=means.dtype)
        out.append(torch.stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]], -1))
    return torch.stack(out)


def inner_scene(seed):
    """Gaussians that all cameras see well inside the image."""
    scene = ordinary_scene(seed, n=30, cameras=3)
    return scene.with_(means=0.3 * scene.means)


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 2e-7), (torch.float64, 1e-13)])
def test_values_and_gradients_are_those_of_a_dense_reference(dtype, error):
    scene = inner_scene(30)
    g = torch.Generator().manual_seed(0)
    # Not symmetric: every entry has its own derivative.
    covars = covariances(scene) + 1e-3 * torch.randn(30, 3, 3, generator=g)
    exact = scene.to(torch.float64)
    inputs = [t.clone().requires_grad_() for t in (exact.means, covars.double(), exact.viewmats)]
    want = dense(*inputs, exact.Ks)
    scene = scene.to(dtype)
    leaves = [t.clone().requires_grad_() for t in (scene.means, covars.to(dtype), scene.viewmats)]
    out = project(
        leaves[0], None, None, scene.opacities, leaves[2], scene.Ks, scene.width, scene.height, covars=leaves[1],
        **OPTIONS,
    )  # fmt: skip
    assert (out.radii > 0).all()
    assert float((out.covars2d - want).detach().norm()) <= error * float(want.detach().norm())
    given = incoming(out)[1]
    got = torch.autograd.grad(out.covars2d, leaves, given)
    for a, b in zip(got, torch.autograd.grad(want, inputs, given), strict=True):
        assert float((a.double() - b).norm()) <= error * float(b.norm())


@pytest.mark.parametrize("seed", range(3))
def test_vectors_equal_the_generic_kernel(seed):
    scene = ordinary_scene(32 + seed, n=90 + seed, cameras=2)
    covars = covariances(scene)
    assert_same(run(scene, covars), run(scene.to(torch.float64), covars.double()))


def test_only_the_symmetric_part_counts_and_gradients_are_symmetric(dtype, device):
    scene = ordinary_scene(37).to(device, dtype)
    covars = covariances(scene)
    # Half and double by powers of two: the mean of the entries is exact.
    covars = 0.5 * (covars + covars.mT)
    lopsided = torch.triu(covars, 1) * 2 + torch.diag_embed(covars.diagonal(dim1=-2, dim2=-1))
    (got, g_got), (want, g_want) = run(scene, lopsided), run(scene, covars)
    assert torch.equal(got.covars2d, want.covars2d) and torch.equal(got.tables().whitenings, want.tables().whitenings)
    assert torch.equal(g_got["covars"], g_want["covars"])
    error = 1e-6 if dtype == torch.float32 else 1e-12
    g = g_got["covars"]
    assert float((g - g.mT).norm()) <= error * float(g.norm())


FLAT = {
    "points": torch.zeros(3, 3),
    "along x": torch.diag(torch.tensor([0.04, 0.0, 0.0])),
    "along y": torch.diag(torch.tensor([0.0, 0.04, 0.0])),
    "along z": torch.diag(torch.tensor([0.0, 0.0, 0.04])),
    "flat": torch.diag(torch.tensor([0.0, 0.04, 0.01])),
    "a line in space": torch.tensor([[1.0, 2, -3], [2, 4, -6], [-3, -6, 9]]) / 64,
    # The float32 matrix nearest to a needle's has eigenvalues below zero: of rounding, 1e-7 of the largest.
    "indefinite by rounding": torch.tensor([[1.0, 1.0, 0.5], [1.0, 1.0 - 2**-23, 0.5], [0.5, 0.5, 0.25]]) / 16,
}


@pytest.mark.parametrize("name", FLAT)
def test_covariances_without_full_rank_are_projected_and_differentiated(name):
    scene = frontal_scene([[0.1, -0.2, 2.0], [-0.3, 0.2, 3.0], [0.0, 0.1, 1.5]], 0.1, 0.8)
    covars = FLAT[name].repeat(3, 1, 1)
    vectors, generic = run(scene.to(torch.float32), covars), run(scene.to(torch.float64), covars.double())
    assert (generic[0].radii > 0).all()
    assert_same(vectors, generic)
    want = dense(scene.means, covars.double(), scene.viewmats, scene.Ks)
    assert float((generic[0].covars2d - want).abs().max()) <= 1e-6 * float(want.abs().max())


def test_a_larger_scale_of_the_world_changes_no_decision():
    scene, far = (frontal_scene([[0.1, -0.2, s * 2.0]], 0.1 * s, 0.8) for s in (1.0, 2.0**20))
    far = far.with_(means=scene.means * 2.0**20)
    got = run(far, covariances(far))[0]
    assert torch.equal(got.radii, run(scene, covariances(scene))[0].radii)


def draw_covariances(scene, covars, **options):
    return rasterization(
        scene.means, None, None, scene.opacities, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height,
        backgrounds=scene.backgrounds, covars=covars, **options,
    )  # fmt: skip


def test_quats_and_scales_are_not_read_beside_covariances(device):
    scene = ordinary_scene(22).to(device)
    covars = covariances(scene)
    poison = torch.full_like(scene.quats, float("nan"))
    got, *_ = rasterization(
        scene.means, poison, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, scene.width,
        scene.height, backgrounds=scene.backgrounds, covars=covars,
    )  # fmt: skip
    assert torch.equal(got, draw_covariances(scene, covars)[0])


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"covars": torch.zeros(60, 3)}, "covars: expected shape"),
        ({"covars": -torch.eye(3).expand(60, 3, 3)}, "covars: expected variances of at least 0"),
        ({"covars": torch.full((60, 3, 3), float("nan"))}, "covars: expected finite"),
        ({"covars": None}, "quats: expected a tensor, got None"),
    ],
)
def test_bad_covariances_are_refused_by_name(change, words):
    with pytest.raises(ValueError, match=words):
        draw_covariances(ordinary_scene(25), **change)
