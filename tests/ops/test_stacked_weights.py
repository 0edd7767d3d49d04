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
    colors = torch.rand(60, 3, generator=torch.Generator().manual_seed(1)).to(device)
    stacked = stack_weights(views)
    apart = torch.cat([blend_colors(view, colors) for view in views])
    off = 0.0 if device.type == "cpu" else 1e-6  # a GPU adds in orders of its own
    torch.testing.assert_close(blend_colors(stacked, colors), apart, atol=off, rtol=0)
    assert torch.equal(stacked.alphas, torch.cat([view.alphas for view in views]))


def test_gradients_of_stacked_pictures_are_the_sums_of_theirs(views, device):
    random = torch.Generator().manual_seed(2)
    colors = torch.rand(60, 3, generator=random).to(device).requires_grad_(True)
    wanted = torch.randn(48, 24, 3, generator=random).to(device)
    (together,) = torch.autograd.grad((blend_colors(stack_weights(views), colors) * wanted).sum(), colors)
    apart = 0.0
    for view, part in zip(views, wanted.split(16), strict=True):
        (own,) = torch.autograd.grad((blend_colors(view, colors) * part).sum(), colors)
        apart = apart + own
    torch.testing.assert_close(together, apart)
    dense = stack_weights(views).matrix.to_dense()
    assert torch.equal(stack_weights(views).transpose.to_dense(), dense.T)


def test_one_picture_is_stacked_as_it_is(views):
    assert stack_weights(views[:1]) is views[0]


def test_pictures_that_do_not_stack_are_refused(views, device):
    other = blend_weights(
        torch.tensor([[0.0, 0.0, 1.0]], device=device), torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
        torch.full((1, 3), 0.01, device=device), torch.ones(1, device=device), torch.eye(4, device=device),
        torch.eye(3, device=device), 24, 16,
    )  # fmt: skip
    with pytest.raises(ValueError, match="of 60 Gaussians, got 24 pixels and 1 Gaussians"):
        stack_weights([views[0], other])
    with pytest.raises(ValueError, match="at least one"):
        stack_weights([])
