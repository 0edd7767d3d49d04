"""DINOv2 (Oquab et al. 2024) as a frozen image encoder; weights come from the user's own file, never from the net.

The published `model.safetensors` of facebook/dinov2-small, -base and -large (Apache-2.0) are read as they are.
"""

from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention

from oasis_warp.core.errors import InputError
from oasis_warp.network.attention import join_heads, split_heads
from oasis_warp.network.features import ImageFeatures, resampled

PATCH, GRID = 14, 37
"""Side of a patch [px], and of the grid that the position table was trained for."""
IMAGENET_MEAN, IMAGENET_SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Size(NamedTuple):
    """Of one vision transformer."""

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

    def __init__(self, name: str, image_size: int):
        super().__init__()
        if image_size % PATCH:
            raise ValueError(f"image_size: expected a multiple of {PATCH}, got {image_size}. Patches are that wide.")
        width, layers, heads = SIZES[name]
        self.image_size = image_size
        self.aligned_channels = self.deep_channels = width
        self.cls = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(torch.zeros(1, GRID * GRID + 1, width))
        self.patch, self.norm = nn.Conv2d(3, width, PATCH, PATCH), nn.LayerNorm(width, eps=1e-6)
        self.blocks = nn.ModuleList(TransformerBlock(width, heads) for _ in range(layers))
        self.requires_grad_(False)

    @torch.no_grad()
    def forward(self, image: Float[Tensor, "B S S 3"], mask: Float[Tensor, "B S S"]) -> ImageFeatures:
        """Feature maps of crops (sRGB in [0, 1]) and masks."""
        colors, inside = resampled(image, mask, self.image_size)
        mean, spread = (colors.new_tensor(v)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_SPREAD))
        x = self.patch((colors - mean * inside) / spread)
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
            InputError: no such file, another format, or weights of another network.
        """
        if not path.is_file():
            raise InputError(f"{path}: expected the weights of DINOv2, found no such file; download model.safetensors.")
        try:
            published = load_file(path)
        except SafetensorError as error:
            raise InputError(
                f"{path}: expected the weights of DINOv2, got another format or a file cut short ({error})."
            ) from error
        state = {_our_name(name): tensor.float() for name, tensor in published.items() if "mask_token" not in name}
        own = self.state_dict()
        wrong = sorted(
            name for name in own.keys() | state.keys()
            if name not in own or name not in state or own[name].shape != state[name].shape
        )  # fmt: skip
        if wrong:
            raise InputError(
                f"{path}: expected a DINOv2 of width {self.position.shape[-1]} and {len(self.blocks)} layers without "
                f"registers, but {len(wrong)} tensors differ, {wrong[0]} first; give the file of that size."
            )
        self.load_state_dict(state)


def _our_name(name: str) -> str:
    name = name.removeprefix("dinov2.")
    for published, ours in _NAMES:
        name = name.replace(published, ours)
    return name
