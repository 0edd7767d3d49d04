"""Differences of pictures: L1, SSIM, and LPIPS from files, for which random weights of the right shapes stand in."""

import hashlib
import http.server
import math
import threading

import pytest
import torch
from disk import trust
from torch.nn.functional import conv2d, max_pool2d

from oasis_warp.core import published_files
from oasis_warp.core.errors import InputError
from oasis_warp.core.published_files import Published, published_file
from oasis_warp.losses import (
    SCALE,
    SHIFT,
    detail_difference,
    load_lpips,
    masked_dssim,
    masked_l1,
    masked_psnr,
    masked_statistics,
    ssim_map,
)
from oasis_warp.ops import masked_l1_on_cuda


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(24, 20, 3, generator=generator, dtype=torch.float64)
    return image, (image + 0.1 * torch.randn(24, 20, 3, generator=generator, dtype=torch.float64)).clamp(0, 1)


def left_half(image):
    mask = torch.zeros(image.shape[:2], dtype=image.dtype)
    mask[:, : image.shape[1] // 2] = 1
    return mask


@pytest.mark.gpu
@pytest.mark.parametrize("size", [(1, 1), (24, 20), (130, 101)])
@pytest.mark.parametrize("covered", [0.0, 0.001, 0.5])
def test_the_kernels_of_the_mean_difference_do_what_torch_does(size, covered):
    """In a mask of less than one pixel too, where pixels agree, and where a value is no number."""
    generator = torch.Generator().manual_seed(0)
    image, target = (torch.rand(*size, 3, generator=generator) for _ in range(2))
    mask = covered * torch.rand(*size, generator=generator)
    target[0, 0, 0] = image[0, 0, 0]

    def found(*pictures):
        leaf = pictures[0].clone().requires_grad_()
        loss = masked_l1(leaf, *pictures[1:])
        (3 * loss).backward()
        return loss.detach(), leaf.grad

    given = [part.cuda() for part in (image, target, mask)]
    assert masked_l1_on_cuda(*given) is not None
    got, again, want = found(*given), found(*given), found(*(part.double() for part in (image, target, mask)))
    for mine, same, theirs in zip(got, again, want, strict=True):
        assert torch.equal(mine, same)
        torch.testing.assert_close(mine.double().cpu(), theirs, rtol=1e-6, atol=1e-12)
    given[0][-1, -1, -1] = float("nan")
    loss, gradient = found(*given)
    assert loss.isnan() and gradient[-1, -1, -1].isnan() and gradient.isnan().sum() == 1



def test_losses_of_equal_images_are_zero(pair):
    image, _ = pair
    mask = torch.ones(image.shape[:2], dtype=image.dtype)
    assert float(masked_l1(image, image, mask)) == 0
    assert abs(float(masked_dssim(image, image, mask))) < 1e-12


def test_what_is_outside_the_mask_does_not_count(pair):
    image, other = pair
    mask = left_half(image)
    changed = other.clone()
    changed[:, image.shape[1] // 2 :] = 0.3
    assert torch.equal(masked_l1(image, other, mask), masked_l1(image, changed, mask))
    assert masked_psnr(image, other, mask) == masked_psnr(image, changed, mask)


def test_psnr_of_a_known_error():
    image = torch.full((4, 5, 3), 0.5)
    assert math.isclose(masked_psnr(image, image + 0.1, torch.ones(4, 5)), 20.0, abs_tol=1e-5)


def test_statistics_inside_a_mask_are_those_of_its_pixels(pair):
    image, _ = pair
    mask = left_half(image)
    pixels = image[:, : image.shape[1] // 2].reshape(-1, 3)
    mean, std = masked_statistics(image, mask, epsilon=0.0)
    torch.testing.assert_close(mean, pixels.mean(0))
    torch.testing.assert_close(std, pixels.std(0, correction=0))


def test_ssim_agrees_with_a_direct_sum_at_an_inner_pixel(pair):
    image, other = pair
    x = torch.arange(11, dtype=torch.float64) - 5
    window = torch.exp(-(x**2) / (2 * 1.5**2))
    weight = (window[:, None] * window / window.sum() ** 2)[..., None]
    a, b = image[5:16, 4:15], other[5:16, 4:15]  # around row 10, column 9
    ma, mb = (weight * a).sum((0, 1)), (weight * b).sum((0, 1))
    va, vb = (weight * a * a).sum((0, 1)) - ma**2, (weight * b * b).sum((0, 1)) - mb**2
    cov = (weight * a * b).sum((0, 1)) - ma * mb
    direct = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    torch.testing.assert_close(ssim_map(image, other)[10, 9], direct.mean(), atol=1e-12, rtol=0)


def test_losses_have_the_right_gradients(pair):
    image, other = (x[:12, :12].clone() for x in pair)
    mask = left_half(image)
    image.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: masked_dssim(x, other, mask), (image,))
    assert torch.autograd.gradcheck(lambda x: masked_l1(x, other, mask), (image,))


def test_an_empty_mask_gives_finite_losses(pair):
    image, other = pair
    nothing = torch.zeros(image.shape[:2], dtype=image.dtype)
    assert float(masked_l1(image, other, nothing)) == 0
    assert math.isfinite(masked_psnr(image, other, nothing))


def pictures(seed=0):
    random = torch.Generator().manual_seed(seed)
    return torch.rand(2, 16, 16, 3, generator=random), torch.ones(2, 16, 16)


def test_equal_pictures_cost_nothing_and_a_plain_shift_next_to_nothing():
    image, mask = pictures()
    assert not detail_difference(image, image, mask).any()
    assert float(detail_difference(image, image + 0.1, mask).max()) < 1e-6


def test_lost_detail_costs_more_than_its_mean_colour_says():
    image, mask = pictures()
    flat = image.mean((1, 2), keepdim=True).expand_as(image)
    shifted = image + (flat - image).abs().mean()
    assert bool((detail_difference(flat, image, mask) > 100 * detail_difference(shifted, image, mask)).all())


def test_what_lies_outside_the_mask_does_not_count():
    image, mask = pictures()
    mask[:, 8:] = 0
    other = image.clone()
    other[:, 8:] = 0
    assert torch.equal(detail_difference(image, 0.5 * image, mask), detail_difference(other, 0.5 * other, mask))


def test_a_coarse_difference_is_felt_at_coarse_scales():
    mask = torch.ones(1, 32, 32)
    flat = torch.full((1, 32, 32, 3), 0.5)
    ramp = flat + 0.01 * torch.arange(32)[:, None, None]
    # slope .01 a pixel at full, .02 at half, .04 at quarter resolution; one of two directions, a third of 6 sums
    assert abs(float(detail_difference(ramp, flat, mask)) - 0.035 / 1) < 0.004


ALEX = ((0, 64, 11, 4, 2), (3, 192, 5, 1, 2), (6, 384, 3, 1, 1), (8, 256, 3, 1, 1), (10, 256, 3, 1, 1))
VGG = tuple((place, channels, 3, 1, 1) for place, channels in (
    (0, 64), (2, 64), (5, 128), (7, 128), (10, 256), (12, 256), (14, 256), (17, 512), (19, 512), (21, 512), (24, 512),
    (26, 512), (28, 512),
))  # fmt: skip
COMPARED = {"alex": [0, 3, 6, 8, 10], "vgg": [2, 7, 14, 21, 28]}
"""Of torchvision's layers, those that the published LPIPS compares."""


@pytest.fixture(params=["alex", pytest.param("vgg", marks=pytest.mark.slow)])
def files(request, tmp_path):
    random, name = torch.Generator().manual_seed(0), request.param
    trunk, heads, before = {"classifier.6.bias": torch.zeros(3)}, {}, 3
    for place, channels, kernel, *_ in {"alex": ALEX, "vgg": VGG}[name]:
        trunk[f"features.{place}.weight"] = torch.randn(channels, before, kernel, kernel, generator=random) / (
            kernel * before**0.5
        )
        trunk[f"features.{place}.bias"] = torch.randn(channels, generator=random)
        if place in COMPARED[name]:
            heads[f"lin{len(heads)}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=random)
        before = channels
    torch.save(trunk, tmp_path / f"{name}net.pth")
    torch.save(heads, tmp_path / f"{name}.pth")
    trust(tmp_path / f"{name}net.pth")
    trust(tmp_path / f"{name}.pth")
    return tmp_path / f"{name}net.pth", tmp_path / f"{name}.pth"


def two_pictures():
    random = torch.Generator().manual_seed(1)
    return (torch.rand(2, 64, 64, 3, generator=random) for _ in range(2))


def test_it_is_the_weighted_distance_of_unit_features(files):
    trunk, heads = (torch.load(path, weights_only=True) for path in files)
    a, b = two_pictures()
    maps, shift, scale = [], torch.tensor(SHIFT)[:, None, None], torch.tensor(SCALE)[:, None, None]
    for image in (a, b):
        x = (2 * image.permute(0, 3, 1, 2) - 1 - shift) / scale
        layers = []
        vgg = files[1].name == "vgg.pth"
        for place, _, _, stride, padding in VGG if vgg else ALEX:
            if place in ((5, 10, 17, 24) if vgg else (3, 6)):
                x = max_pool2d(x, 2, 2) if vgg else max_pool2d(x, 3, 2)
            x = conv2d(x, trunk[f"features.{place}.weight"], trunk[f"features.{place}.bias"], stride, padding).relu()
            if place in COMPARED["vgg" if vgg else "alex"]:
                layers.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        maps.append(layers)
    expected = sum(
        (heads[f"lin{k}.model.1.weight"] * (x - y) ** 2).sum(1).mean((1, 2))
        for k, (x, y) in enumerate(zip(*maps, strict=True))
    )
    torch.testing.assert_close(load_lpips(*files)(a, b, torch.ones(2, 64, 64)), expected)


def test_equal_pictures_are_at_no_distance_and_pictures_learn(files):
    a, b = two_pictures()
    network, mask = load_lpips(*files), torch.ones(2, 64, 64)
    assert not network(a, a, mask).any()
    assert not network(a, b, 0 * mask).any()
    (gradient,) = torch.autograd.grad(network(a.requires_grad_(True), b, mask).sum(), a)
    assert bool(gradient.isfinite().all()) and gradient.any()
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_files_that_hold_something_else_are_refused(files, tmp_path):
    with pytest.raises(InputError, match="none: expected AlexNet, found no such file; download https"):
        load_lpips(tmp_path / "none", files[1])
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match=r"text: expected AlexNet with the SHA-256 7be5be791159472b\.\.\., got"):
        load_lpips(tmp_path / "text", tmp_path / "text")
    trust(tmp_path / "text")
    with pytest.raises(InputError, match="text: expected weights of LPIPS, got another format"):
        load_lpips(tmp_path / "text", tmp_path / "text")
    with pytest.raises(InputError, match="expected (AlexNet|VGG-16) and LPIPS's layers, missing 'features.0.weight'"):
        load_lpips(files[1], files[1])


@pytest.fixture
def server(tmp_path):
    """Serves what lies in `shop`; one of its answers is cut short."""
    (tmp_path / "shop").mkdir()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *arguments):
            super().__init__(*arguments, directory=str(tmp_path / "shop"))

        def log_message(self, *_):
            pass

        def end_headers(self):
            if self.path == "/cut":
                self._headers_buffer = [line for line in self._headers_buffer if b"Content-Length" not in line]
                self.send_header("Content-Length", "999")
            super().end_headers()

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


def test_a_missing_file_is_downloaded_only_where_that_is_allowed(server, tmp_path, monkeypatch, capsys):
    (tmp_path / "shop" / "whole").write_bytes(b"weights")
    (tmp_path / "shop" / "cut").write_bytes(b"weights")
    digest = hashlib.sha256(b"weights").hexdigest()
    for name in ("whole", "cut", "gone"):
        monkeypatch.setitem(published_files.PUBLISHED, name, Published(name, f"{server}/{name}", 3, digest))
    with pytest.raises(InputError, match=r"here: expected whole, found no such file; download http.*whole \(3 MB\) to"):
        published_file(tmp_path / "here", "whole")
    published_file(tmp_path / "new" / "here", "whole", allow_download=True)
    assert (tmp_path / "new" / "here").read_bytes() == b"weights"
    assert "downloading whole, 3 MB: http" in capsys.readouterr().err
    messages = {"cut": "ended too early|cannot be downloaded", "gone": "cannot be downloaded .*copy it to"}
    for name, message in messages.items():
        with pytest.raises(InputError, match=message):
            published_file(tmp_path / "other", name, allow_download=True)
    monkeypatch.setitem(published_files.PUBLISHED, "whole", Published("whole", f"{server}/whole", 3, 64 * "0"))
    with pytest.raises(InputError, match="other: expected whole with the SHA-256 0000000000000000"):
        published_file(tmp_path / "other", "whole", allow_download=True)
    assert not (tmp_path / "other").exists() and not list(tmp_path.glob("*.part"))


def test_a_file_of_another_digest_is_refused_unless_its_user_trusts_it(tmp_path, monkeypatch):
    path, digest = tmp_path / "model.safetensors", hashlib.sha256(b"weights").hexdigest()
    monkeypatch.setitem(published_files.PUBLISHED, "dinov2-large", Published("DINOv2", "https://there", 3, digest))
    path.write_bytes(b"weights")
    published_file(path, "dinov2-large")
    path.write_bytes(b"weight")  # cut
    with pytest.raises(InputError, match=rf"expected DINOv2 with the SHA-256 {digest[:16]}\.\.\., got .*sha256 if you"):
        published_file(path, "dinov2-large")
    trust(path)
    published_file(path, "dinov2-large")
    path.write_bytes(b"weights")  # no longer what was trusted
    with pytest.raises(InputError, match=f"got {digest[:16]}"):
        published_file(path, "dinov2-large")
