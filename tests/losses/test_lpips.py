"""LPIPS from files; random weights of the right shapes stand in for the published ones."""

import hashlib
import http.server
import threading

import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d

from oasis_warp.core import published_files
from oasis_warp.core.errors import InputError
from oasis_warp.core.published_files import Published, published_file
from oasis_warp.losses.lpips import SCALE, SHIFT, load_lpips

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
    return tmp_path / f"{name}net.pth", tmp_path / f"{name}.pth"


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
    a, b = pictures()
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
    for name in ("whole", "cut", "gone"):
        monkeypatch.setitem(published_files.PUBLISHED, name, Published(name, f"{server}/{name}", 3))
    with pytest.raises(InputError, match=r"here: expected whole, found no such file; download http.*whole \(3 MB\) to"):
        published_file(tmp_path / "here", "whole")
    published_file(tmp_path / "new" / "here", "whole", allow_download=True)
    assert (tmp_path / "new" / "here").read_bytes() == b"weights"
    assert "downloading whole, 3 MB: http" in capsys.readouterr().err
    messages = {"cut": "ended too early|cannot be downloaded", "gone": "cannot be downloaded .*copy it to"}
    for name, message in messages.items():
        with pytest.raises(InputError, match=message):
            published_file(tmp_path / "other", name, allow_download=True)
    assert not (tmp_path / "other").exists() and not list(tmp_path.glob("*.part"))


def test_a_file_of_another_digest_is_refused(tmp_path):
    digest = hashlib.sha256(b"weights").hexdigest()
    (tmp_path / f"net-{digest[:8]}.pth").write_bytes(b"weights")
    published_file(tmp_path / f"net-{digest[:8]}.pth", "alex")
    (tmp_path / f"net-{digest[:8]}.pth").write_bytes(b"weight")
    with pytest.raises(InputError, match=f"expected a SHA-256 that begins with {digest[:8]}, got .* download it again"):
        published_file(tmp_path / f"net-{digest[:8]}.pth", "alex")
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "model.safetensors.sha256").write_text(f"{digest}  model.safetensors\n")
    published_file(tmp_path / "model.safetensors", "dinov2-large")
    (tmp_path / "model.safetensors.sha256").write_text("0" * 64)
    with pytest.raises(InputError, match="begins with 0000000000000000"):
        published_file(tmp_path / "model.safetensors", "dinov2-large")
