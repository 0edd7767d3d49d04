"""Geometry-aligned projection and aggregation: what the feature map says at each posed point (equations 1 and 2)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, grid_sample, pad

NEAR = 0.01
"""Depth up to which a point counts as behind the camera [m]."""


def project_batch(
    points: Float[Tensor, "B P 3"], viewmat: Float[Tensor, "B 4 4"], K: Float[Tensor, "B 3 3"], size: int
) -> tuple[Float[Tensor, "B P 2"], Bool[Tensor, "B P"]]:
    """Where points fall in a square image of `size` pixels, its corners at 0 and 1, and which fall inside.

    A point behind the camera is not inside and lies at (0, 0).
    """
    local = points @ viewmat[:, :3, :3].transpose(1, 2) + viewmat[:, None, :3, 3]
    in_front = local[..., 2] > NEAR
    homogeneous = local @ K.transpose(1, 2)
    uv = homogeneous[..., :2] / torch.where(in_front, homogeneous[..., 2], 1)[..., None] / size
    uv = torch.where(in_front[..., None], uv, 0)
    return uv, in_front & ((uv >= 0) & (uv <= 1)).all(-1)


def sample(planes: Float[Tensor, "B C H W"], uv: Float[Tensor, "B P 2"]) -> Float[Tensor, "B P C"]:
    """Bilinear reading of `planes` at `uv`, 0 beyond their edge.

    In the precision of `uv`: bfloat16 could not tell one pixel from the next.
    """
    read = grid_sample(planes.to(uv.dtype), (2 * uv - 1)[:, None], align_corners=False)
    return read[:, :, 0].transpose(1, 2)


class Aggregation(nn.Module):
    """Distance-weighted mean of K x K bilinear samples, one cell apart, round each projection (equation 2).

    Samples lie at fixed offsets from the point, so their weights are the same for all points: the weighted sum of
    samples is one sample of the map convolved with the weights, at 1 / K^2 of the work. A sample counts by the share
    of its bilinear footprint that lies inside the map, so that none is clamped to the border.
    """

    def __init__(self, neighborhood: int):
        super().__init__()
        self.reach = neighborhood // 2
        self.log_sigma = nn.Parameter(torch.zeros(()))
        """Logarithm of the fall-off, in cells: one cell at first."""

    def weights(self) -> tuple[Float[Tensor, "K K"], Float[Tensor, "K K"]]:
        """The weights w = exp(-d / sigma), whose sum is left to the samples that count, and dw / d log sigma."""
        offset = torch.arange(-self.reach, self.reach + 1, dtype=self.log_sigma.dtype, device=self.log_sigma.device)
        with torch.no_grad():
            distance = torch.hypot(offset[:, None], offset) / self.log_sigma.exp()
            weights = torch.exp(-distance)
        return weights, weights * distance

    def forward(self, planes: Float[Tensor, "B C H W"], uv: Float[Tensor, "B P 2"]) -> Float[Tensor, "B P C"]:
        """Point-aligned features at `uv` (edges at 0 and 1), which lie inside the image."""
        batch, channels, height, width = planes.shape
        border = self.reach + 1
        kernel, slope = (w[None, None].to(planes.dtype) for w in self.weights())
        learning = torch.is_grad_enabled() and self.log_sigma.requires_grad

        def spread(single: Tensor) -> Tensor:  # one cell wider on every side than the map, for points on its edge
            padded = pad(single, (border,) * 4)
            total = conv2d(padded, kernel)
            if learning:  # its one weight's gradient is a second convolution; asked of the first it takes 20 times that
                total = total + (self.log_sigma - self.log_sigma.detach()) * conv2d(padded.detach(), slope)
            return total

        total = spread(planes.reshape(batch * channels, 1, height, width))
        total = total.reshape(batch, channels, *total.shape[2:])
        count = spread(planes.new_ones(1, 1, height, width)).expand(batch, -1, -1, -1)
        inner = torch.stack(
            [(part * n + 1) / (n + 2) for part, n in zip(uv.unbind(-1), (width, height), strict=True)], -1
        )
        return sample(total, inner) / sample(count, inner).clamp_min(1e-6)
