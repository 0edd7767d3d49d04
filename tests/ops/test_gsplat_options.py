"""Antialiasing, absolute gradients and orthographic cameras, against the definitions that gsplat gives them."""

import pytest
import torch

from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import rasterization

SIZE = 24
EPS2D = 0.3


def scene(dtype=torch.float64, device="cpu", n=30):
    """Gaussians of all sizes, many below a pixel, that overlap and leave the image on all sides."""
    random = torch.Generator().manual_seed(3)
    means = torch.rand(n, 3, generator=random) * torch.tensor([1.2, 1.2, 0.8]) + torch.tensor([-0.6, -0.6, 1.5])
    quats = torch.randn(n, 4, generator=random)
    scales = torch.exp(torch.randn(n, 3, generator=random) * 0.6 - 3.2)
    opacities = torch.rand(n, generator=random) * 0.8 + 0.1
    colors = torch.rand(n, 3, generator=random)
    turned = torch.tensor([[0.98, 0, 0.2, 0.05], [0, 1, 0, -0.1], [-0.2, 0, 0.98, 0.3], [0, 0, 0, 1]])
    viewmats = torch.stack([torch.eye(4), turned])
    Ks = torch.tensor([[[30.0, 0, 12], [0, 28.0, 11], [0, 0, 1]]]).expand(2, 3, 3)
    return [t.to(device, dtype).contiguous() for t in (means, quats, scales, opacities, colors, viewmats, Ks)]


def matrices(conics):
    xx, xy, yy = conics.unbind(-1)
    return torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2))


def test_antialiasing_fades_gaussians_by_the_root_of_the_ratio_of_determinants(device):
    *inputs, Ks = scene(device=device)
    _, _, meta = rasterization(*inputs, Ks, SIZE, SIZE, eps2d=EPS2D, rasterize_mode="antialiased")
    drawn = (meta["radii"] > 0).all(-1)
    blurred = torch.linalg.inv(matrices(meta["conics"][drawn]))
    sharp = blurred - EPS2D * torch.eye(2).to(blurred)
    opacities = inputs[3].expand(2, -1)[drawn]
    expected = opacities * (torch.linalg.det(sharp) / torch.linalg.det(blurred)).clamp_min(0).sqrt()
    torch.testing.assert_close(meta["opacities"][drawn], expected, rtol=1e-9, atol=1e-12)
    assert float((expected / opacities).min()) < 0.7  # some are well below a pixel


def test_an_antialiased_picture_is_the_classic_one_of_faded_gaussians():
    means, quats, scales, opacities, colors, viewmats, Ks = scene()
    one = viewmats[:1], Ks[:1], SIZE, SIZE
    image, alpha, meta = rasterization(means, quats, scales, opacities, colors, *one, rasterize_mode="antialiased")
    faded = meta["opacities"][0]
    plain, plain_alpha, _ = rasterization(means, quats, scales, faded, colors, *one)
    torch.testing.assert_close(image, plain, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(alpha, plain_alpha, rtol=1e-9, atol=1e-9)


def signs(like):
    """Weights of a loss, another one for each number."""
    return torch.sin(torch.arange(like.numel(), dtype=like.dtype, device=like.device)).view(like.shape)


def loss_of(render, alphas):
    return (render * signs(render)).sum() + (alphas * signs(alphas)).sum()


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_absolute_gradients_are_sums_over_pixels_of_magnitudes(device, dtype, mode):
    *inputs, Ks = scene(dtype, device, n=12)
    inputs[0].requires_grad_()
    size = 6
    Ks = Ks * torch.tensor([[0.25], [0.25], [1.0]]).to(Ks)
    arguments = (*inputs, Ks, size, size)
    render, alphas, meta = rasterization(*arguments, render_mode=mode, absgrad=True)
    meta["means2d"].retain_grad()
    loss_of(render, alphas).backward()

    expected = torch.zeros_like(meta["means2d"])
    render, alphas, plain = rasterization(*arguments, render_mode=mode, absgrad=True)  # one node would hide means2d
    by_pixel = (render * signs(render)).sum(-1) + (alphas * signs(alphas)).sum(-1)
    for c in range(2):
        for y in range(size):
            for x in range(size):
                (gradient,) = torch.autograd.grad(by_pixel[c, y, x], plain["means2d"], retain_graph=True)
                expected += gradient.abs()
    rounding = 1e-4 if dtype == torch.float32 else 1e-6
    assert (meta["means2d"].absgrad - expected).norm() <= rounding * expected.norm()
    assert bool((meta["means2d"].absgrad >= meta["means2d"].grad.abs() - rounding * expected.max()).all())


def test_without_a_gradient_nothing_is_recorded():
    *inputs, Ks = scene(n=5)
    _, _, meta = rasterization(*inputs, Ks, SIZE, SIZE, absgrad=True)
    assert not hasattr(meta["means2d"], "absgrad")


def test_an_orthographic_camera_shifts_and_scales_alone(device):
    """The picture does not depend on depth but for the order: J = diag(fx, fy) without slopes."""
    means, quats, scales, opacities, colors, viewmats, Ks = scene(device=device)
    _, _, meta = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, SIZE, SIZE, camera_model="ortho")
    drawn = (meta["radii"] > 0).all(-1)
    assert int(drawn.sum()) > 20
    at = means @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    expected = at[..., :2] * Ks[:, None, [0, 1], [0, 1]] + Ks[:, None, :2, 2]
    torch.testing.assert_close(meta["means2d"][drawn], expected[drawn], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(meta["depths"], at[..., 2], rtol=1e-9, atol=1e-9)

    factor = to_matrix(torch.nn.functional.normalize(quats, dim=1)) * scales[:, None]
    rows = viewmats[:, None, :2, :3] @ (factor @ factor.mT) @ viewmats[:, None, :2, :3].mT
    focal = Ks[:, None, [0, 1], [0, 1]]
    covariance = rows * focal[..., :, None] * focal[..., None, :] + EPS2D * torch.eye(2).to(rows)
    found = torch.linalg.inv(matrices(meta["conics"][drawn]))
    torch.testing.assert_close(found, covariance[drawn], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("option", [{"rasterize_mode": "smooth"}, {"camera_model": "fisheye"}])
def test_what_gsplat_does_not_know_either_or_we_do_not_build_is_refused(option, as_shipped):
    *inputs, Ks = scene(n=2)
    (name,) = option
    with pytest.raises(ValueError, match=name):
        rasterization(*inputs, Ks, SIZE, SIZE, **option)
