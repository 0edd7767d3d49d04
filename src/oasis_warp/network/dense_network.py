"""The dense network: a photo and 21 landmarks -> class, surface point, normal, albedo and finger of every pixel.

A U-Net (Ronneberger et al. 2015) with residual blocks at high resolution, wide depthwise convolutions (Liu et al. 2022)
at an eighth and a sixteenth, and one self-attention at a sixteenth. It is fully convolutional.

Its weights are safetensors in half precision; loading executes nothing. The metadata have one entry, "oasis-dense": a
JSON object with `version`, `widths`, `depths`, `creator` and `notes`.
"""

import itertools
import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional as F

from oasis_warp import __version__
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file
from oasis_warp.data.tensor_file import open_tensors, read_entry, read_tensors

WIDTHS = (24, 48, 80, 160, 256)
"""Channels at full size, a half, a quarter, an eighth and a sixteenth."""
DEPTHS = (1, 1, 2, 3, 2)
"""Blocks of the encoder at each of these sizes; the decoder has one each."""
FIRST_WIDE = 3
"""The first of these sizes that has wide blocks."""
NORM_GROUPS = 8
STRIDE = 16
"""Sides of a picture are multiples of this."""
HEADS = {"classes": 4, "surface": 3, "log_scale": 1, "normal": 3, "albedo": 3, "finger": 6}
"""Output channels, in their order."""
BACKGROUND, HAND, ARM, FRONT = range(HEADS["classes"])
"""Classes of pixels. ARM is the forearm and clothes; FRONT is what hides the hand, another hand included."""
SURFACE_UNIT = 0.1
"""Length that a surface coordinate of 1 stands for [m]."""
LOG_SCALES = (-6.0, 2.0)
"""Range of the logarithm of the surface point's scale."""
HEAT_WIDTH = 0.02
"""Standard deviation of a landmark's heat map, over the width of the picture."""
_FAR = -1e4


class DensePrediction(NamedTuple):
    """What the network says about each pixel."""

    classes: Float[Tensor, "B 4 H W"]
    """Logits of BACKGROUND, HAND, ARM and FRONT."""
    surface: Float[Tensor, "B 3 H W"]
    """Point on the mean hand at rest [`SURFACE_UNIT`]."""
    log_scale: Float[Tensor, "B H W"]
    """Logarithm of the scale of the surface point's Laplace distribution, in the same unit."""
    normal: Float[Tensor, "B 3 H W"]
    """Unit normal in the camera's frame."""
    albedo: Float[Tensor, "B 3 H W"]
    """Diffuse reflectance in the encoding of sRGB, in [0, 1]."""
    finger: Float[Tensor, "B 6 H W"]
    """Logits of palm and back, thumb, index, middle, ring and little finger."""


class _Norm(nn.GroupNorm):
    """Group norm in the precision of its input; torch's own writes float32 under autocast, which takes longer."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return F.group_norm(x, self.num_groups, self.weight.to(x.dtype), self.bias.to(x.dtype), self.eps)


class _Residual(nn.Module):
    """Two 3 x 3 convolutions with a skip connection."""

    def __init__(self, width: int):
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.norm_first = _Norm(NORM_GROUPS, width)
        self.second = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.norm_second = _Norm(NORM_GROUPS, width)

    def forward(self, x: Tensor) -> Tensor:
        y = F.silu(self.norm_first(self.first(x)))
        return F.silu(x + self.norm_second(self.second(y)))


class _Wide(nn.Module):
    """A 7 x 7 depthwise convolution and a perceptron per pixel, with a skip connection."""

    def __init__(self, width: int):
        super().__init__()
        self.depthwise = nn.Conv2d(width, width, 7, 1, 3, groups=width, bias=False)
        self.norm = _Norm(1, width)
        self.rise = nn.Conv2d(width, 3 * width, 1)
        self.fall = nn.Conv2d(3 * width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.fall(F.silu(self.rise(self.norm(self.depthwise(x)))))


class _Attention(nn.Module):
    """Self-attention over all pixels, with a skip connection."""

    def __init__(self, width: int, heads: int = 8):
        super().__init__()
        self.heads = heads
        self.norm = _Norm(1, width)
        self.inputs = nn.Conv2d(width, 3 * width, 1)
        self.output = nn.Conv2d(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        batch, width, rows, columns = x.shape
        q, k, v = (
            part.reshape(batch, self.heads, width // self.heads, rows * columns).transpose(2, 3)
            for part in self.inputs(self.norm(x)).chunk(3, 1)
        )
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(2, 3).reshape(batch, width, rows, columns)
        return x + self.output(mixed)


def _block(level: int) -> nn.Module:
    return _Wide(WIDTHS[level]) if level >= FIRST_WIDE else _Residual(WIDTHS[level])


def _joined(inputs: int, width: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(inputs, width, 3, 1, 1, bias=False), _Norm(NORM_GROUPS, width), nn.SiLU()
    )  # fmt: skip


class DenseNetwork(nn.Module):
    """See the module."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _joined(3, WIDTHS[0])
        self.landmark_stem = nn.Conv2d(21, WIDTHS[1], 3, 1, 1)
        self.encoder = nn.ModuleList(
            nn.Sequential(*(_block(level) for _ in range(depth))) for level, depth in enumerate(DEPTHS)
        )
        steps = list(itertools.pairwise(WIDTHS))
        self.down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, 2, 1, bias=False), _Norm(NORM_GROUPS, b)) for a, b in steps
        )
        self.attention = nn.Sequential(_Attention(WIDTHS[-1]), _Wide(WIDTHS[-1]))
        self.up = nn.ModuleList(_joined(a + b, a) for a, b in reversed(steps))
        self.decoder = nn.ModuleList(_block(level) for level in reversed(range(len(WIDTHS) - 1)))
        self.head = nn.Conv2d(WIDTHS[0], sum(HEADS.values()), 1)

    def forward(self, image: Float[Tensor, "B 3 H W"], landmarks: Float[Tensor, "B 21 2"]) -> DensePrediction:
        """Predict every pixel.

        Args:
            image: sRGB in [0, 1] of a right hand, or of a mirrored left one; sides are multiples of `STRIDE`.
            landmarks: In pixels of `image`; NaN for those that are not known.
        """
        *skipped, x = self.encode(image, landmarks)
        for join, block in zip(self.up, self.decoder, strict=True):
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = block(join(torch.cat([x, skipped.pop()], 1)))
        parts = dict(zip(HEADS, self.head(x).float().split(list(HEADS.values()), 1), strict=True))
        parts["log_scale"] = parts["log_scale"][:, 0].clamp(*LOG_SCALES)
        parts["normal"] = F.normalize(parts["normal"], dim=1, eps=1e-4)
        parts["albedo"] = parts["albedo"].sigmoid()
        return DensePrediction(**parts)

    def encode(self, image: Float[Tensor, "B 3 H W"], landmarks: Float[Tensor, "B 21 2"]) -> list[Tensor]:
        """Features at full size, a half, a quarter, an eighth and a sixteenth, the last after the self-attention."""
        rows, columns = (side // 2 for side in image.shape[2:])
        found, x = [], self.stem(image * 2 - 1)
        for level, blocks in enumerate(self.encoder):
            if level:
                x = self.down[level - 1](x)
            if level == 1:
                x = x + self.landmark_stem(heat_maps(landmarks / 2, rows, columns).to(x.dtype))
            x = blocks(x)
            found.append(x)
        return [*found[:-1], self.attention(found[-1])]


def heat_maps(landmarks: Float[Tensor, "B N 2"], height: int, width: int) -> Float[Tensor, "B N H W"]:
    """A Gaussian at each landmark [px]; zero where it is NaN."""
    rows, columns = (torch.arange(n, device=landmarks.device, dtype=landmarks.dtype) + 0.5 for n in (height, width))
    at = landmarks.nan_to_num(nan=_FAR).clamp(_FAR, -_FAR)
    x, y = ((line - at[..., k, None]) / (HEAT_WIDTH * width) for k, line in enumerate((columns, rows)))
    return torch.exp(-0.5 * y[..., :, None] ** 2) * torch.exp(-0.5 * x[..., None, :] ** 2)


FORMAT = "oasis-dense"
VERSION = 1


def save_dense_network(path: Path | str, network: DenseNetwork, *, notes: str = "") -> None:
    """Write the weights, all or nothing.

    Raises:
        ValueError: half precision cannot hold a weight.
        InputError: `path` cannot be written.
    """
    stored = {name: tensor.detach().cpu().half().contiguous() for name, tensor in network.state_dict().items()}
    broken = [name for name, tensor in stored.items() if not bool(tensor.isfinite().all())]
    if broken:
        raise ValueError(f"network: expected weights that float16 can hold, got others in {broken[0]}.")
    header = {
        "version": VERSION, "widths": WIDTHS, "depths": DEPTHS, "creator": f"oasis_warp {__version__}", "notes": notes,
    }  # fmt: skip
    write_file(path, save(stored, {FORMAT: json.dumps(header, sort_keys=True)}))


def load_dense_network(path: Path | str) -> DenseNetwork:
    """The network of a file that `save_dense_network` wrote, in float32 on the CPU, for inference.

    Raises:
        InputError: no such file, another format, another version or other sizes, or weights that are damaged.
    """
    path = Path(path)
    with _opened(path) as file:
        _checked_header(path, file)
        network = DenseNetwork()
        network.load_state_dict(read_tensors(path, file, network.state_dict(), "copy it again"))
    return network.eval()


def read_dense_header(path: Path | str) -> dict[str, Any]:
    """What a file of `save_dense_network` says of itself.

    Raises:
        InputError: as `load_dense_network`.
    """
    path = Path(path)
    with _opened(path) as file:
        return _checked_header(path, file)


def _opened(path: Path) -> AbstractContextManager[Any]:
    return open_tensors(path, "the dense network's weights", "give another path")


def _checked_header(path: Path, file: Any) -> dict[str, Any]:
    header = read_entry(path, file, FORMAT, "copy it again")
    expected = {"version": VERSION, "widths": list(WIDTHS), "depths": list(DEPTHS)}
    if header is None or not expected.items() <= header.items():
        raise InputError(
            f"{path}: expected the weights of a dense network of version {VERSION}, got another file; give one that "
            "`oasis pretrain --task dense` wrote."
        )
    return header
