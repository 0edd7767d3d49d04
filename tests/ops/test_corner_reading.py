import pytest
import torch

from oasis_warp.ops.corner_reading import Corners, read_corners


def scene(device, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(0, 40, (1000, 3), generator=generator, dtype=torch.int32)
    weights, values = torch.rand(1000, 3, generator=generator), torch.randn(2, 3, 40, 5, generator=generator)
    return values.to(device, dtype), Corners(index.to(device), weights.to(device))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fields_are_weighted_sums_with_and_without_gradients(device, dtype):
    """The two ways are different code, and that of a GPU is a third."""
    values, corners = scene(device, dtype)
    expected = (values[..., corners.index.long(), :] * corners.weights.to(dtype)[..., None]).sum(-2)
    for given in (values, values.clone().requires_grad_(), values[0, 0], values.flip(-1).flip(-1)):
        read = read_corners(given, corners)
        assert read.requires_grad == given.requires_grad and read.dtype == dtype
        torch.testing.assert_close(read, expected[0, 0] if given.ndim == 2 else expected)


def test_gradients_are_the_transpose(device):
    values, corners = scene(device, torch.float64)
    given, ones = values[0, 0].requires_grad_(), corners.weights.new_ones(1000, 5).double()
    (gradient,) = torch.autograd.grad(read_corners(given, corners), given, ones)
    expected = torch.zeros(40, dtype=torch.float64, device=device)
    expected.index_add_(0, corners.index.flatten().long(), corners.weights.flatten().double())
    torch.testing.assert_close(gradient, expected[:, None].expand(40, 5))


def test_no_place_and_no_field_are_read(device):
    values, corners = scene(device)
    assert read_corners(values, Corners(corners.index[:0], corners.weights[:0])).shape == (2, 3, 0, 5)
    assert read_corners(values[:0], corners).shape == (0, 3, 1000, 5)
