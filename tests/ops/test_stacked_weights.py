import pytest
import torch

from oasis_warp.ops import blend_colors, blend_weights, stack_weights


@pytest.fixture
def views(device):
    """Three pictures of the same 60 Gaussians, 24 pixels wide."""
    random = torch.Generator().manual_seed(3)
    means = torch.randn(60, 3, generator=random) * 0.1 + torch.tensor([0.0, 0.0, 1.0])
    quats = torch.nn.functional.normalize(torch.randn(60, 4, generator=random), dim=-1)
    scales, opacities = torch.rand(60, 3, generator=random) * 0.02 + 0.005, torch.rand(60, generator=random)
    pictures = []
    for k in range(3):
        K = torch.tensor([[30.0 + 5 * k, 0.0, 12.0], [0.0, 30.0 + 5 * k, 8.0], [0.0, 0.0, 1.0]])
        parts = (means + 0.02 * k, quats, scales, opacities, torch.eye(4), K)
        pictures.append(blend_weights(*(part.to(device) for part in parts), 24, 16))
    return pictures


def test_stacked_pictures_are_the_pictures_below_each_other(views, device):
    random = torch.Generator().manual_seed(1)
    colors = [torch.rand(60, 3, generator=random).to(device) for _ in views]
    stacked = stack_weights(views)
    apart = torch.cat([blend_colors(view, own) for view, own in zip(views, colors, strict=True)])
    off = 0.0 if device.type == "cpu" else 1e-6  # a GPU adds in orders of its own
    torch.testing.assert_close(blend_colors(stacked, torch.cat(colors)), apart, atol=off, rtol=0)
    assert torch.equal(stacked.alphas, torch.cat([view.alphas for view in views]))


def test_gradients_of_stacked_pictures_are_theirs(views, device):
    random = torch.Generator().manual_seed(2)
    colors = torch.rand(3, 60, 3, generator=random).to(device).requires_grad_(True)
    wanted = torch.randn(48, 24, 3, generator=random).to(device)
    (together,) = torch.autograd.grad((blend_colors(stack_weights(views), colors.flatten(0, 1)) * wanted).sum(), colors)
    apart = []
    for view, own, part in zip(views, colors, wanted.split(16), strict=True):
        apart += torch.autograd.grad((blend_colors(view, own) * part).sum(), own)
    torch.testing.assert_close(together, torch.stack(apart))
    dense = stack_weights(views).matrix.to_dense()
    assert torch.equal(stack_weights(views).transpose.to_dense(), dense.T)


def test_pictures_of_different_gaussians_stack(views):
    fewer = blend_weights(
        torch.tensor([[0.0, 0.0, 1.0]]).to(views[0].alphas), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).to(views[0].alphas),
        torch.full((1, 3), 0.01).to(views[0].alphas), torch.ones(1).to(views[0].alphas),
        torch.eye(4).to(views[0].alphas), torch.diag(torch.tensor([30.0, 30.0, 1.0])).to(views[0].alphas), 24, 8,
    )  # fmt: skip
    stacked = stack_weights([fewer, views[0]])
    assert stacked.matrix.shape == (24 * (8 + 16), 61)


def test_one_picture_is_stacked_as_it_is(views):
    assert stack_weights(views[:1]) is views[0]


def test_pictures_that_do_not_stack_are_refused(views, device):
    other = blend_weights(
        torch.tensor([[0.0, 0.0, 1.0]], device=device), torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
        torch.full((1, 3), 0.01, device=device), torch.ones(1, device=device), torch.eye(4, device=device),
        torch.eye(3, device=device), 32, 16,
    )  # fmt: skip
    with pytest.raises(ValueError, match="expected pictures 24 pixels wide, got 32"):
        stack_weights([views[0], other])
    with pytest.raises(ValueError, match="at least one"):
        stack_weights([])
