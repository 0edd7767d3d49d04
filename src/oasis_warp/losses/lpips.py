"""LPIPS (Zhang et al. 2018) on AlexNet, from weights on the user's disk; nothing is downloaded, no code is executed."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from oasis_warp.core.errors import InputError

LAYERS = (
    # channels, kernel, stride, padding, whether a pooling comes before
    (64, 11, 4, 2, False), (192, 5, 1, 2, True), (384, 3, 1, 1, True), (256, 3, 1, 1, False), (256, 3, 1, 1, False),
)  # fmt: skip
PLACES = (0, 3, 6, 8, 10)
"""Of the convolutions in torchvision's `features`."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of LPIPS's input layer, for images in [-1, 1]."""


class Lpips(nn.Module):
    """Distance of two images in AlexNet's features; frozen, differentiable in the images."""

    def __init__(self):
        super().__init__()
        before, self.convolutions, self.lines = 3, nn.ModuleList(), nn.ParameterList()
        for channels, kernel, stride, padding, _ in LAYERS:
            self.convolutions.append(nn.Conv2d(before, channels, kernel, stride, padding))
            self.lines.append(nn.Parameter(torch.zeros(channels)))
            before = channels
        self.requires_grad_(False)

    def forward(
        self, images: Float[Tensor, "N H W 3"], targets: Float[Tensor, "N H W 3"], masks: Float[Tensor, "N H W"]
    ) -> Float[Tensor, "N"]:
        """LPIPS of the pictures, what lies outside `masks` made equal."""
        both = torch.cat([images * masks[..., None], targets * masks[..., None]]).permute(0, 3, 1, 2)
        shift, scale = (both.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        x, total = (2 * both - 1 - shift) / scale, images.new_zeros(len(images))
        for convolution, line, (*_, pooled) in zip(self.convolutions, self.lines, LAYERS, strict=True):
            x = convolution(nn.functional.max_pool2d(x, 3, 2) if pooled else x).relu()
            unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            a, b = unit.chunk(2)
            total = total + ((a - b).square() * line[:, None, None]).sum(1).mean((1, 2))
        return total


def load_lpips(backbone: Path, heads: Path) -> Lpips:
    """LPIPS from torchvision's AlexNet (alexnet-owt-7be5be79.pth) and LPIPS's own linear layers (alex.pth, 6 KB).

    Raises:
        InputError: a file is missing, or holds something else.
    """
    network = Lpips()
    trunk, lines = _read(backbone), _read(heads)
    try:
        for k, (place, convolution) in enumerate(zip(PLACES, network.convolutions, strict=True)):
            convolution.load_state_dict({key: trunk[f"features.{place}.{key}"] for key in ("weight", "bias")})
            network.lines[k].data.copy_(lines[f"lin{k}.model.1.weight"].flatten())
    except (KeyError, RuntimeError) as error:
        raise InputError(f"{backbone}, {heads}: expected AlexNet and LPIPS's layers, missing {error}.") from error
    return network


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise InputError(f"{path}: expected weights of LPIPS, found no such file; leave LPIPS out or give its path.")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises what its readers do: pickle, zip and runtime errors
        raise InputError(f"{path}: expected weights of LPIPS, got another format ({type(error).__name__}).") from error
