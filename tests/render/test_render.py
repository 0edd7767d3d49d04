import pytest
import torch

from oasis_warp.core.types import Camera, Gaussians
from oasis_warp.ops import rasterization
from oasis_warp.render.render import render

COLOR = (0.25, 0.5, 1.0)


@pytest.fixture
def scene(device):
    g = torch.Generator().manual_seed(0)
    viewmat, K = torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    viewmat[2, 3] = 2
    gaussians = Gaussians(
        torch.randn(5, 3, generator=g) * 0.3,
        torch.randn(5, 4, generator=g),
        torch.rand(5, 3, generator=g) * 0.2 + 0.05,
        torch.rand(5, generator=g) * 0.8 + 0.1,
        torch.rand(5, 3, generator=g),
    )
    return Gaussians(*(t.to(device) for t in gaussians)), Camera(viewmat.to(device), K.to(device), 17, 15)


@pytest.mark.parametrize("kind", [tuple, torch.tensor])
def test_it_is_the_rasterizer_over_a_plain_background(scene, kind):
    gaussians, camera = scene
    behind = torch.tensor([COLOR], device=camera.K.device)
    images, alphas, _ = rasterization(*gaussians, camera.viewmat[None], camera.K[None], 17, 15, backgrounds=behind)
    for _ in range(2):
        drawn = render(gaussians, camera, background=kind(COLOR))
        assert torch.equal(drawn.image, images[0]) and torch.equal(drawn.alpha, alphas[0, ..., 0])


def test_the_camera_may_be_of_another_type_than_the_gaussians(scene):
    gaussians, camera = scene
    wide = Camera(camera.viewmat.double(), camera.K.double(), 17, 15)
    assert torch.equal(render(gaussians, wide).image, render(gaussians, camera).image)


def test_a_background_that_is_a_tensor_gets_its_gradient(scene):
    gaussians, camera = scene
    background = torch.tensor(COLOR, device=camera.K.device, requires_grad=True)
    drawn = render(gaussians, camera, background=background)
    (gradient,) = torch.autograd.grad(drawn.image.sum(), background)
    assert torch.allclose(gradient, (1 - drawn.alpha).sum().expand(3), rtol=1e-5)
