"""Our own image encoder: a small convolutional pyramid, trained from scratch with the rest of the network."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate

from oasis_warp.network.features import ImageFeatures, resampled

STAGES = ((64, 2), (128, 2), (256, 3))
"""Channels and blocks at strides 4, 8 and 16."""
FINE = 12
"""Learned channels at full resolution, beside the colours themselves."""
MEAN, SPREAD = 0.5, 0.25
"""Of skin's sRGB values, roughly; the encoder sees (image - MEAN) / SPREAD."""


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of a map."""

    def forward(self, input: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Each pixel by itself."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class ConvolutionBlock(nn.Module):
    """A wide depthwise convolution, then a perceptron a pixel, with a residual (Liu et al. 2022)."""

    def __init__(self, channels: int, expansion: int = 4):
        super().__init__()
        self.depthwise = nn.Conv2d(channels, channels, 7, padding=3, groups=channels)
        self.norm = nn.LayerNorm(channels)
        self.widen, self.narrow = nn.Linear(channels, expansion * channels), nn.Linear(expansion * channels, channels)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """A map of the same shape."""
        pixels = self.norm(self.depthwise(x).permute(0, 2, 3, 1))
        return x + self.narrow(nn.functional.gelu(self.widen(pixels))).permute(0, 3, 1, 2)


class ConvolutionalEncoder(nn.Module):
    """Features at stride 4 that know of strides 8 and 16, the deepest map, and a thin map at full resolution.

    The background is hidden: what stands behind a hand says nothing of its skin.
    """

    def __init__(self, image_size: int, width: int):
        super().__init__()
        if image_size % 16:
            raise ValueError(f"image_size: expected a multiple of 16, got {image_size}. The deepest stride is 16.")
        self.image_size = image_size
        self.fine_channels, self.deep_channels = 4 + FINE, STAGES[-1][0]
        self.detail = nn.Conv2d(4, FINE, 3, padding=1)
        channels = [self.fine_channels] + [count for count, _ in STAGES]
        strides = (4, 2, 2)
        self.reductions = nn.ModuleList(
            nn.Sequential(nn.Conv2d(before, after, stride, stride), ChannelNorm(after))
            for before, after, stride in zip(channels, channels[1:], strides, strict=False)
        )
        self.stages = nn.ModuleList(
            nn.Sequential(*(ConvolutionBlock(count) for _ in range(blocks))) for count, blocks in STAGES
        )
        self.laterals = nn.ModuleList(nn.Conv2d(count, width, 1) for count, _ in STAGES)
        self.merge = ConvolutionBlock(width, expansion=2)

    def forward(self, image: Float[Tensor, "B S S 3"], mask: Float[Tensor, "B S S"]) -> ImageFeatures:
        """Feature maps of crops (sRGB in [0, 1]) and masks."""
        colors, inside = resampled(image, mask, self.image_size)
        seen = torch.cat([(colors - MEAN * inside) / SPREAD, inside], dim=1)
        fine = torch.cat([seen, nn.functional.gelu(self.detail(seen))], dim=1)
        x, maps = fine, []
        for reduce, stage in zip(self.reductions, self.stages, strict=True):
            x = stage(reduce(x))
            maps.append(x)
        total = self.laterals[-1](maps[-1])
        for lateral, finer in zip(reversed(self.laterals[:-1]), reversed(maps[:-1]), strict=True):
            total = interpolate(total, size=finer.shape[-2:], mode="bilinear") + lateral(finer)
        return ImageFeatures(self.merge(total), maps[-1], fine)
