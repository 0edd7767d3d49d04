"""Fit your own Gaussians to a picture: the rasterizer as an ordinary torch function.

    python examples/train_gaussians.py
    python examples/train_gaussians.py --gaussians 4000 --steps 500 --device cuda

Starts from random Gaussians in front of a camera, minimises the mean squared error, prints how closely the rendering
matches the picture, and writes both side by side.
"""

import math
from dataclasses import dataclass
from importlib.resources import as_file
from pathlib import Path

import torch
import tyro
from torch.nn.functional import interpolate, mse_loss

from oasis_warp import rasterization, read_photo
from oasis_warp.assets import asset
from oasis_warp.data.pictures import to_uint8, write_picture


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to fit, and how long."""

    gaussians: int = 1500
    size: int = 128
    """Side of the picture [px]."""
    steps: int = 150
    device: str = "cpu"
    seed: int = 0
    out: Path = Path("fitted.png")


def main(options: Options) -> None:
    """Make Gaussians, train them, draw them."""
    n, size, device = options.gaussians, options.size, torch.device(options.device)
    with as_file(asset("photos", "palm_open_left_02.png")) as bundled:
        photo = read_photo(bundled).rgb.float().permute(2, 0, 1)[None] / 255
    target = interpolate(photo, size=(size, size), mode="area")[0].permute(1, 2, 0).to(device)

    random = torch.Generator().manual_seed(options.seed)
    means = torch.rand(n, 3, generator=random) * 2 - 1  # a box two metres wide, three metres from the camera
    quats = torch.randn(n, 4, generator=random)
    parameters = [means, quats, torch.full((n, 3), -3.5), torch.zeros(n), torch.zeros(n, 3)]
    means, quats, log_scales, logits, colors = (p.to(device).requires_grad_() for p in parameters)
    optimizer = torch.optim.Adam([means, quats, log_scales, logits, colors], lr=0.03)

    viewmats = torch.eye(4, device=device)[None]
    viewmats[:, 2, 3] = 3.0
    Ks = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1.0]], device=device)[None]
    for step in range(options.steps):
        render, _, _ = rasterization(
            means, quats, log_scales.exp(), logits.sigmoid(), colors.sigmoid(), viewmats, Ks, size, size
        )
        loss = mse_loss(render[0], target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step == options.steps - 1:
            print(f"step {step}: {-10 * math.log10(loss.item()):.1f} dB")
    write_picture(options.out, to_uint8(torch.cat([target, render[0].detach()], dim=1).cpu()))
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main(tyro.cli(Options))
