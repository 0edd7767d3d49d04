"""LPIPS from files; random weights of the right shapes stand in for the published ones."""

import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d

from oasis_warp.core.errors import InputError
from oasis_warp.losses.lpips import LAYERS, PLACES, SCALE, SHIFT, load_lpips


@pytest.fixture
def files(tmp_path):
    random = torch.Generator().manual_seed(0)
    trunk, heads, before = {"classifier.6.bias": torch.zeros(3)}, {}, 3
    for k, (place, (channels, kernel, *_)) in enumerate(zip(PLACES, LAYERS, strict=True)):
        trunk[f"features.{place}.weight"] = torch.randn(channels, before, kernel, kernel, generator=random) / (
            kernel * before**0.5
        )
        trunk[f"features.{place}.bias"] = torch.randn(channels, generator=random)
        heads[f"lin{k}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=random)
        before = channels
    torch.save(trunk, tmp_path / "alexnet.pth")
    torch.save(heads, tmp_path / "alex.pth")
    return tmp_path / "alexnet.pth", tmp_path / "alex.pth"


def pictures():
    random = torch.Generator().manual_seed(1)
    return (torch.rand(2, 64, 64, 3, generator=random) for _ in range(2))


def test_it_is_the_weighted_distance_of_unit_features(files):
    trunk, heads = (torch.load(path, weights_only=True) for path in files)
    a, b = pictures()
    maps, shift, scale = [], torch.tensor(SHIFT)[:, None, None], torch.tensor(SCALE)[:, None, None]
    for image in (a, b):
        x = (2 * image.permute(0, 3, 1, 2) - 1 - shift) / scale
        layers = []
        for place, stride, padding in zip(PLACES, (4, 1, 1, 1, 1), (2, 2, 1, 1, 1), strict=True):
            x = max_pool2d(x, 3, 2) if place in (3, 6) else x
            x = conv2d(x, trunk[f"features.{place}.weight"], trunk[f"features.{place}.bias"], stride, padding).relu()
            layers.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        maps.append(layers)
    expected = sum(
        (heads[f"lin{k}.model.1.weight"] * (x - y) ** 2).sum(1).mean((1, 2))
        for k, (x, y) in enumerate(zip(*maps, strict=True))
    )
    torch.testing.assert_close(load_lpips(*files)(a, b, torch.ones(2, 64, 64)), expected)


def test_equal_pictures_are_at_no_distance_and_pictures_learn(files):
    a, b = pictures()
    network, mask = load_lpips(*files), torch.ones(2, 64, 64)
    assert not network(a, a, mask).any()
    assert not network(a, b, 0 * mask).any()
    (gradient,) = torch.autograd.grad(network(a.requires_grad_(True), b, mask).sum(), a)
    assert bool(gradient.isfinite().all()) and gradient.any()
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_files_that_hold_something_else_are_refused(files, tmp_path):
    with pytest.raises(InputError, match="none: expected weights of LPIPS, found no such file"):
        load_lpips(tmp_path / "none", files[1])
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="text: expected weights of LPIPS, got another format"):
        load_lpips(tmp_path / "text", files[1])
    with pytest.raises(InputError, match="expected AlexNet and LPIPS's layers, missing 'features.0.weight'"):
        load_lpips(files[1], files[1])
