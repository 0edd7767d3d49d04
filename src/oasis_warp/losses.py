"""Differences between two images, inside a mask; LPIPS (Zhang et al. 2018) from weights on the user's disk.

No code of theirs is executed.
"""

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from oasis_warp.core.errors import InputError
from oasis_warp.core.published_files import published_file
from oasis_warp.ops import masked_l1_on_cuda

Perceptual = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Distance of N images and N targets inside N masks, one number each."""
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
Trunk = Literal["alex", "vgg"]


def masked_l1(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]) -> Tensor:
    """Mean absolute difference over the pixels of `mask`."""
    mean = masked_l1_on_cuda(image, target, mask)
    if mean is not None:
        return mean
    return ((image - target).abs() * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1))


def masked_statistics(
    image: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"], epsilon: float = 1e-6
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Mean and standard deviation of each channel inside `mask` (the paper's appendix B.3)."""
    weight = mask[..., None] / mask.sum().clamp_min(1)
    mean = (image * weight).sum((0, 1))
    return mean, (((image - mean) ** 2 * weight).sum((0, 1)) + epsilon).sqrt()


@functools.cache
def _blur_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The Gaussian window as a banded matrix: on a CPU two matrix products are 20 times faster than conv2d."""
    x = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    window = torch.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    window = window / window.sum()
    offset = torch.arange(size)[:, None] - torch.arange(size) + SSIM_WINDOW // 2
    inside = (offset >= 0) & (offset < SSIM_WINDOW)
    matrix = torch.where(inside, window[offset.clamp(0, SSIM_WINDOW - 1)], 0)
    return matrix.to(dtype=dtype, device=device)


def _blur(planes: Float[Tensor, "C H W"]) -> Float[Tensor, "C H W"]:
    rows, columns = (_blur_matrix(n, planes.dtype, planes.device) for n in planes.shape[1:])
    return rows @ planes @ columns.T


class SsimTarget(NamedTuple):
    """An image with which many are compared, and its own statistics."""

    image: Float[Tensor, "H W 3"]
    mean: Float[Tensor, "3 H W"]
    square: Float[Tensor, "3 H W"]
    """Mean of the squares."""


def ssim_target(image: Float[Tensor, "H W 3"]) -> SsimTarget:
    """`image` with its own statistics, which `ssim_map` needs."""
    y = image.permute(2, 0, 1)
    return SsimTarget(image, *_blur(torch.cat([y, y * y])).split(3))


def ssim_map(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"] | SsimTarget) -> Float[Tensor, "H W"]:
    """Structural similarity of each pixel (Wang et al. 2004): 11-tap Gaussian window, zero-padded, mean of channels."""
    known = target if isinstance(target, SsimTarget) else ssim_target(target)
    x, y = image.permute(2, 0, 1), known.image.permute(2, 0, 1)
    mx, xx, xy = _blur(torch.cat([x, x * x, x * y])).split(3)
    my, yy = known.mean, known.square
    luminance = (2 * mx * my + SSIM_C1) / (mx * mx + my * my + SSIM_C1)
    structure = (2 * (xy - mx * my) + SSIM_C2) / (xx - mx * mx + yy - my * my + SSIM_C2)
    return (luminance * structure).mean(0)


def masked_dssim(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"] | SsimTarget, mask: Float[Tensor, "H W"]
) -> Tensor:
    """1 - SSIM, mean over the pixels of `mask`."""
    return 1 - (ssim_map(image, target) * mask).sum() / mask.sum().clamp_min(1)


def masked_psnr(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"]) -> float:
    """Peak signal-to-noise ratio over the pixels of `mask` [dB]."""
    error = float((((image - target) ** 2) * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1)))
    return 10 * math.log10(1 / max(error, 1e-12))


SCALES = 3
"""Full, half and quarter resolution."""


def detail_difference(
    images: Float[Tensor, "N H W 3"], targets: Float[Tensor, "N H W 3"], masks: Float[Tensor, "N H W"]
) -> Float[Tensor, "N"]:
    """Mean absolute difference of the images' gradients inside the masks, summed over scales.

    It penalises blur and lost lines, which a mean colour difference hardly notices. It takes the place of LPIPS where
    the weights of LPIPS are not available.
    """
    error = ((images - targets) * masks[..., None]).permute(0, 3, 1, 2)
    weight, total = masks[:, None], images.new_zeros(len(images))
    for scale in range(SCALES):
        if scale:
            error, weight = avg_pool2d(error, 2), avg_pool2d(weight, 2)
        slopes = error.diff(dim=2).abs().sum((1, 2, 3)) + error.diff(dim=3).abs().sum((1, 2, 3))
        total = total + slopes / (6 * weight.sum((1, 2, 3)).clamp_min(1))
    return total


class Layer(NamedTuple):
    """A convolution of a trunk, with what comes before and after it."""

    place: int
    """Place of the convolution in torchvision's `features`."""
    channels: int
    kernel: int
    stride: int
    padding: int
    pooled: bool
    """Whether a pooling comes before."""
    compared: bool
    """Whether its result is compared."""


LAYERS: dict[Trunk, tuple[Layer, ...]] = {
    "alex": (
        Layer(0, 64, 11, 4, 2, False, True), Layer(3, 192, 5, 1, 2, True, True), Layer(6, 384, 3, 1, 1, True, True),
        Layer(8, 256, 3, 1, 1, False, True), Layer(10, 256, 3, 1, 1, False, True),
    ),
    "vgg": tuple(
        Layer(place, channels, 3, 1, 1, pooled, compared)
        for place, channels, pooled, compared in (
            (0, 64, False, False), (2, 64, False, True), (5, 128, True, False), (7, 128, False, True),
            (10, 256, True, False), (12, 256, False, False), (14, 256, False, True),
            (17, 512, True, False), (19, 512, False, False), (21, 512, False, True),
            (24, 512, True, False), (26, 512, False, False), (28, 512, False, True),
        )
    ),
}  # fmt: skip
POOLING = {"alex": (3, 2), "vgg": (2, 2)}
"""Kernel and stride."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Shift and scale of LPIPS's input layer, for images in [-1, 1]."""


class Lpips(nn.Module):
    """Distance of two images in a trunk's features; frozen, differentiable in the images."""

    shift: Tensor
    scale: Tensor

    def __init__(self, trunk: Trunk = "alex"):
        super().__init__()
        self.layers, self.pooling = LAYERS[trunk], POOLING[trunk]
        before, self.convolutions, self.lines = 3, nn.ModuleList(), nn.ParameterList()
        for layer in self.layers:
            self.convolutions.append(nn.Conv2d(before, layer.channels, layer.kernel, layer.stride, layer.padding))
            if layer.compared:
                self.lines.append(nn.Parameter(torch.zeros(layer.channels)))
            before = layer.channels
        for buffer, values in {"shift": SHIFT, "scale": SCALE}.items():  # a recording on CUDA cannot fetch them
            self.register_buffer(buffer, torch.tensor(values)[:, None, None], persistent=False)
        self.requires_grad_(False)

    def forward(
        self, images: Float[Tensor, "N H W 3"], targets: Float[Tensor, "N H W 3"], masks: Float[Tensor, "N H W"]
    ) -> Float[Tensor, "N"]:
        """LPIPS of the pictures, what lies outside `masks` made equal."""
        both = torch.cat([images * masks[..., None], targets * masks[..., None]]).permute(0, 3, 1, 2)
        x, total, lines = (2 * both - 1 - self.shift) / self.scale, images.new_zeros(len(images)), iter(self.lines)
        for convolution, layer in zip(self.convolutions, self.layers, strict=True):
            x = convolution(nn.functional.max_pool2d(x, *self.pooling) if layer.pooled else x).relu()
            if layer.compared:
                unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
                a, b = unit.chunk(2)
                total = total + ((a - b).square() * next(lines)[:, None, None]).sum(1).mean((1, 2))
        return total


def load_lpips(backbone: Path, heads: Path, *, allow_download: bool = False) -> Lpips:
    """LPIPS from torchvision's AlexNet or VGG-16 and LPIPS's own linear layers.

    Args:
        backbone: alexnet-owt-7be5be79.pth or vgg16-397923af.pth; VGG-16 where the name begins with vgg, or holds it.
        heads: alex.pth or vgg.pth, 6 to 7 KB.
        allow_download: Download what is missing.

    Raises:
        InputError: a file is missing, cut short, or holds something else.
    """
    trunk: Trunk = "vgg" if "vgg" in backbone.name else "alex"
    network = Lpips(trunk)
    published_file(backbone, trunk, allow_download=allow_download)
    published_file(heads, f"{trunk}-lines", allow_download=allow_download)
    weights, lines = _read(backbone), _read(heads)
    try:
        for layer, convolution in zip(network.layers, network.convolutions, strict=True):
            convolution.load_state_dict({key: weights[f"features.{layer.place}.{key}"] for key in ("weight", "bias")})
        for k, line in enumerate(network.lines):
            line.data.copy_(lines[f"lin{k}.model.1.weight"].flatten())
    except (KeyError, RuntimeError) as error:
        names = "AlexNet" if trunk == "alex" else "VGG-16"
        raise InputError(f"{backbone}, {heads}: expected {names} and LPIPS's layers, missing {error}.") from error
    return network


def _read(path: Path) -> dict[str, Tensor]:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises what its readers do: pickle, zip and runtime errors
        raise InputError(f"{path}: expected weights of LPIPS, got another format ({type(error).__name__}).") from error
