"""Gaussians given by covariances instead of quaternions and scales: `covars` of the rasterizer."""

import pytest
import torch
from rasterization_scenes import ordinary_scene
from test_rasterization_gradcheck import safe_scene

from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import rasterization


def covariances(scene):
    half = to_matrix(torch.nn.functional.normalize(scene.quats, dim=-1)) * scene.scales[:, None]
    return half @ half.mT


def draw(scene, covars, **options):
    return rasterization(
        scene.means, None, None, scene.opacities, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height,
        backgrounds=scene.backgrounds, covars=covars, **options,
    )  # fmt: skip


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-6), (torch.float64, 1e-12)])
def test_covariances_draw_what_their_quaternions_and_scales_draw(dtype, bound, device):
    scene = ordinary_scene(21, n=200).to(torch.float64)
    exact = covariances(scene)
    scene, covars = scene.to(device=device, dtype=dtype), exact.to(device=device, dtype=dtype)
    expected, alphas, _ = rasterization(
        *scene.gaussians, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height,
        backgrounds=scene.backgrounds,
    )  # fmt: skip
    got, got_alphas, meta = draw(scene, covars)
    assert (got - expected).norm() <= bound * expected.norm()
    assert (got_alphas - alphas).norm() <= bound * alphas.norm()
    assert (meta["radii"] > 0).any()


def test_quats_and_scales_are_not_read_beside_covariances(device):
    scene = ordinary_scene(22).to(device)
    covars = covariances(scene)
    poison = torch.full_like(scene.quats, float("nan"))
    got, *_ = rasterization(
        scene.means, poison, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, scene.width,
        scene.height, backgrounds=scene.backgrounds, covars=covars,
    )  # fmt: skip
    assert torch.equal(got, draw(scene, covars)[0])


@pytest.mark.usefixtures("as_shipped")
def test_gradients_by_covariances_are_those_of_finite_differences(device):
    scene = safe_scene(23).to(device)
    weights = torch.randn(3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(device)

    def total(half):
        return (draw(scene, half @ half.mT, validate=False)[0] * weights).sum()

    half = to_matrix(torch.nn.functional.normalize(scene.quats, dim=-1)) * scene.scales[:, None]
    half = half.detach().requires_grad_()
    assert torch.autograd.gradcheck(total, half, eps=1e-6, atol=1e-6, rtol=1e-5, nondet_tol=0.0)


def test_the_gradient_by_a_covariance_is_symmetric(device):
    scene = ordinary_scene(24, dtype=torch.float64).to(device)
    covars = covariances(scene).requires_grad_()
    (g,) = torch.autograd.grad(draw(scene, covars)[0].square().sum(), covars)
    torch.testing.assert_close(g, g.mT, rtol=1e-12, atol=1e-12 * float(g.abs().max()))


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
        draw(ordinary_scene(25), **change)
