"""Image encoders: our own convolutional pyramid, and DINOv2 (Oquab et al. 2024) with frozen weights.

The published `model.safetensors` of facebook/dinov2-small, -base and -large (Apache-2.0) are read as they are, from a
file of the user's; nothing is downloaded.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention

from oasis_warp.core.errors import InputError
from oasis_warp.core.published_files import published_file
from oasis_warp.network.attention import join_heads, split_heads


class ImageFeatures(NamedTuple):
    """Feature maps of B crops."""

    aligned: Float[Tensor, "B C h w"]
    """Read at the projections of points."""
    deep: Float[Tensor, "B D y x"]
    """For the global token, and for tokens that are not aligned with geometry."""
    fine: Float[Tensor, "B E S S"] | None
    """Read at the projections too, at the crop's full resolution, if the encoder has such a map."""


def resampled(
    image: Float[Tensor, "B S S 3"], mask: Float[Tensor, "B S S"], size: int
) -> tuple[Float[Tensor, "B 3 s s"], Float[Tensor, "B 1 s s"]]:
    """The crop at the encoder's resolution, channels first: colours times mask, and mask.

    Times mask before and not after the resampling, so that the background does not bleed over the hand's outline.
    """
    planes = torch.cat([(image * mask[..., None]).permute(0, 3, 1, 2), mask[:, None]], dim=1)
    if planes.shape[-1] != size:
        planes = interpolate(planes, size=(size, size), mode="bilinear", antialias=planes.shape[-1] > size)
    return planes[:, :3], planes[:, 3:]


STAGES = ((64, 2), (128, 2), (256, 3))
"""Channels and blocks at strides 4, 8 and 16."""
FINE = 12
"""Learned channels at full resolution, beside the colours themselves."""
MEAN, SPREAD = 0.5, 0.25
"""Rough mean and spread of skin's sRGB values; the encoder sees (image - MEAN) / SPREAD."""


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


PATCH, GRID = 14, 37
"""Side of a patch [px], and of the grid that the position table was trained for."""
IMAGENET_MEAN, IMAGENET_SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Size(NamedTuple):
    """Size of one vision transformer."""

    width: int
    layers: int
    heads: int


SIZES = {"dinov2-small": Size(384, 12, 6), "dinov2-base": Size(768, 12, 12), "dinov2-large": Size(1024, 24, 16)}

_NAMES = (
    ("embeddings.cls_token", "cls"), ("embeddings.position_embeddings", "position"),
    ("embeddings.patch_embeddings.projection.", "patch."), ("layernorm.", "norm."), ("encoder.layer.", "blocks."),
    ("attention.q_proj", "query"), ("attention.k_proj", "key"), ("attention.v_proj", "value"),
    ("attention.o_proj", "output"), ("attention.attention.", ""), ("attention.output.dense", "output"),
    ("layer_scale1.lambda1", "scale1"), ("layer_scale2.lambda1", "scale2"), ("mlp.", ""),
)  # fmt: skip
"""Published names, in both spellings, and ours; replaced in this order."""


class TransformerBlock(nn.Module):
    """Attention and perceptron, each scaled channel by channel."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width, eps=1e-6), nn.LayerNorm(width, eps=1e-6)
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.output = nn.Linear(width, width)
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.scale1, self.scale2 = nn.Parameter(torch.ones(width)), nn.Parameter(torch.ones(width))

    def forward(self, x: Float[Tensor, "B N C"]) -> Float[Tensor, "B N C"]:
        """Refined tokens."""
        y = self.norm1(x)
        q, k, v = (split_heads(part(y), self.heads) for part in (self.query, self.key, self.value))
        x = x + self.scale1 * self.output(join_heads(scaled_dot_product_attention(q, k, v)))
        return x + self.scale2 * self.fc2(nn.functional.gelu(self.fc1(self.norm2(x))))


class DinoV2Encoder(nn.Module):
    """Patch features of the last layer; frozen. The background is hidden behind the mean colour."""

    mean: Tensor
    spread: Tensor

    def __init__(self, name: str, image_size: int):
        super().__init__()
        if image_size % PATCH:
            raise ValueError(f"image_size: expected a multiple of {PATCH}, got {image_size}. Patches are that wide.")
        width, layers, heads = SIZES[name]
        self.image_size, self.name = image_size, name
        self.aligned_channels = self.deep_channels = width
        self.cls = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(torch.zeros(1, GRID * GRID + 1, width))
        self.patch, self.norm = nn.Conv2d(3, width, PATCH, PATCH), nn.LayerNorm(width, eps=1e-6)
        self.blocks = nn.ModuleList(TransformerBlock(width, heads) for _ in range(layers))
        # Buffers, because a recording on CUDA cannot bring numbers of the host to the device.
        for buffer, values in {"mean": IMAGENET_MEAN, "spread": IMAGENET_SPREAD}.items():
            self.register_buffer(buffer, torch.tensor(values)[:, None, None], persistent=False)
        self.requires_grad_(False)

    @torch.no_grad()
    def forward(self, image: Float[Tensor, "B S S 3"], mask: Float[Tensor, "B S S"]) -> ImageFeatures:
        """Feature maps of crops (sRGB in [0, 1]) and masks."""
        colors, inside = resampled(image, mask, self.image_size)
        x = self.patch((colors - self.mean * inside) / self.spread)
        grid = x.shape[-2:]
        table = self.position[:, 1:].unflatten(1, (GRID, GRID)).permute(0, 3, 1, 2)
        table = interpolate(table, size=grid, mode="bicubic", align_corners=False)
        tokens = (x + table).flatten(2).transpose(1, 2)
        first = (self.cls + self.position[:, :1]).expand(len(x), -1, -1)
        tokens = torch.cat([first.to(tokens.dtype), tokens], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        features = self.norm(tokens)[:, 1:].transpose(1, 2).unflatten(2, grid)
        return ImageFeatures(features, features, None)

    def load(self, path: Path) -> None:
        """Fill in published weights.

        Raises:
            InputError: no such file, another SHA-256 than it should have, another format, or another network's.
        """
        published_file(path, self.name)
        try:
            published = load_file(path)
        except SafetensorError as error:
            raise InputError(
                f"{path}: expected the weights of DINOv2, got another format or a file cut short ({error})."
            ) from error
        state = {_our_name(name): tensor.float() for name, tensor in published.items() if "mask_token" not in name}
        if wrong := differing_tensors(self.state_dict(), state):
            raise InputError(
                f"{path}: expected a DINOv2 of width {self.position.shape[-1]} and {len(self.blocks)} layers without "
                f"registers, but {len(wrong)} tensors differ, {wrong[0]} first; give the file of that size."
            )
        self.load_state_dict(state)


def differing_tensors(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> list[str]:
    """Names of tensors that only one of the two has, or whose shapes differ."""
    shapes, others = ({name: tensor.shape for name, tensor in tensors.items()} for tensors in (own, given))
    return sorted(name for name in shapes.keys() | others.keys() if shapes.get(name) != others.get(name))


def _our_name(name: str) -> str:
    name = name.removeprefix("dinov2.")
    for published, ours in _NAMES:
        name = name.replace(published, ours)
    return name
