"""The rasterizer's adjoint against finite differences of the float64 build.

Finite differences are safe where no decision changes within a step. The scenes are therefore checked first: no alpha
within 1e-3 of the cut-off or the cap, no transmittance near the stop, no two depths closer than 1e-3 and no centre at
the Jacobian's clamp, while gradcheck's steps of 1e-6 move any of them by about 1e-5 at the most.
"""

import pytest
import torch
from rasterization_scenes import frontal_scene

from oasis_warp.core.types import Camera
from oasis_warp.ops import rasterization
from oasis_warp.reference import rasterization as twin

MARGIN = 1e-3
pytestmark = pytest.mark.usefixtures("as_shipped")  # hundreds of calls, and the checks cost more than they do


def is_safe(scene):
    camera = Camera(scene.viewmats[0], scene.Ks[0], scene.width, scene.height)
    alpha = twin.dense_layers(twin.project(twin.Gaussians(*scene.gaussians), camera), camera).alphas
    after = torch.cumprod(1 - alpha.clamp(max=twin.ALPHA_MAX), -1)
    u = scene.means[:, :2] / scene.means[:, 2:]
    focal, centre = scene.Ks[0, [0, 1], [0, 1]], scene.Ks[0, :2, 2]
    size = torch.tensor([scene.width, scene.height], dtype=torch.float64)
    edges = [-centre / focal - 0.15 * size / focal, (size - centre) / focal + 0.15 * size / focal]
    depths = scene.means[:, 2].sort().values
    return (
        all(bool(((alpha - edge).abs() > MARGIN * edge).all()) for edge in (twin.ALPHA_MIN, twin.ALPHA_MAX))
        and bool((after > 2 * twin.TRANSMITTANCE_STOP).all())
        and all(bool(((u - edge).abs() > MARGIN).all()) for edge in edges)
        and bool((depths.diff() > MARGIN).all())
    )


def safe_scene(seed, n=5, opacity=(0.3, 0.9), size=7):
    """The first of many small scenes that passes `is_safe`."""
    for attempt in range(200):
        g = torch.Generator().manual_seed(1000 * seed + attempt)

        def uniform(*shape, low, high, g=g):
            return torch.rand(*shape, generator=g, dtype=torch.float64) * (high - low) + low

        means = torch.cat([uniform(n, 2, low=-0.9, high=0.9), uniform(n, 1, low=1.5, high=3.0)], -1)
        scene = frontal_scene(
            means, uniform(n, 3, low=0.1, high=0.5), uniform(n, low=opacity[0], high=opacity[1]),
            width=size, height=size - 1, focal=6.0, seed=1000 * seed + attempt,
        )  # fmt: skip
        if is_safe(scene):
            return scene
    raise AssertionError("no safe scene among 200")


def gradcheck(scene, device, **options):
    """Check the gradients of three random sums over image and alpha; of every pixel apart it would take ten times."""
    names = "means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"
    scene = scene.to(device)

    def random_sums(means, quats, scales, opacities, colors, viewmats, backgrounds):
        image, alphas, _ = rasterization(
            means, quats, scales, opacities, colors, viewmats, scene.Ks, scene.width, scene.height,
            backgrounds=backgrounds, validate=False, **options,
        )  # fmt: skip
        pixels = torch.cat([image, alphas], -1).flatten()
        g = torch.Generator().manual_seed(0)
        return torch.randn(3, len(pixels), generator=g, dtype=torch.float64).to(device) @ pixels

    inputs = [getattr(scene, name).clone().requires_grad_() for name in names]
    return torch.autograd.gradcheck(random_sums, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, nondet_tol=0.0)


@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_those_of_finite_differences(seed, device):
    assert gradcheck(safe_scene(seed), device)


@pytest.mark.parametrize("mode", ["D", "RGB+ED"])
def test_gradients_of_depth_are_those_of_finite_differences(mode, device):
    scene = safe_scene(4)
    if mode == "D":
        scene = scene.with_(backgrounds=torch.zeros(1, 3, dtype=torch.float64))
    assert gradcheck(scene, device, render_mode=mode)


def test_gradients_beyond_the_clamp_of_the_jacobian_are_those_of_finite_differences(device):
    scene = safe_scene(5, n=4)
    shift = torch.tensor([[1.6, 0.0, 0.0], [0.0, -1.9, 0.0], [0, 0, 0], [0, 0, 0]], dtype=torch.float64)
    scene = scene.with_(means=scene.means + shift, scales=scene.scales + 0.8)
    assert is_safe(scene)
    assert gradcheck(scene, device)


def test_a_capped_layer_gives_no_gradient_to_opacity_or_shape(device):
    # One wide layer of opacity 1: sigma is below 1e-3, and the cap acts, in every pixel.
    scene = frontal_scene([[0.0, 0.0, 2.0]], 200.0, 1.0, width=5, height=5, focal=4.0).to(device)
    inputs = [t.clone().requires_grad_() for t in (*scene.gaussians, scene.colors)]
    image, *_ = rasterization(*inputs, scene.viewmats, scene.Ks, 5, 5)
    *shape, colors = torch.autograd.grad(image.sum(), inputs)
    assert not any(g.any() for g in shape)
    assert torch.allclose(colors, torch.full_like(colors, 25 * twin.ALPHA_MAX), rtol=1e-12)


def test_backward_twice_through_one_graph_gives_the_same(device):
    scene = safe_scene(7).to(device)
    means = scene.means.clone().requires_grad_()
    image, *_ = rasterization(
        means, *scene.gaussians[1:], scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height
    )
    first = torch.autograd.grad(image.sum(), means, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(image.sum(), means)[0])
