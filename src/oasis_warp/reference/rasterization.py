"""The rasterizer: the Gaussians in each pixel, blended front to back.

By default each Gaussian is paired with the pixels of its box, and the pairs are listed by pixel. With `dense` it is
paired with every pixel, in a matrix, so that no error of a box can hide. Thresholds are the float32 constants of gsplat
1.5.3, spelled out again.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.core.rotation import to_matrix
from oasis_warp.core.types import Camera

ALPHA_MAX = float(np.float32(0.999))
ALPHA_MIN = float(np.float32(1 / 255))
TRANSMITTANCE_STOP = float(np.float32(1e-4))
JACOBIAN_LIMIT = 0.3
FRAGILE_ALPHA, FRAGILE_STOP = 3e-4, 2e-3
"""Relative distance of an alpha or a transmittance to a threshold within which float32 may decide differently."""
SHORTEST_LIST = 8
"""Layers per pixel of the smallest group of pixels. Lists double in length from group to group: padding at most doubles
them."""


class Rules(NamedTuple):
    """Thresholds, and the options of `rasterization` that decide what is drawn. Lengths are rounded to float32."""

    alpha_min: float = ALPHA_MIN
    transmittance_stop: float = TRANSMITTANCE_STOP
    extent_sigmas: float = 3.33
    near_plane: float = 0.01
    far_plane: float = 1e10
    eps2d: float = 0.3

    def rounded(self) -> tuple[float, float, float]:
        """Near plane, far plane and low-pass variance as float32 numbers."""
        near, far, eps2d = (float(np.float32(value)) for value in self[3:])
        return near, far, eps2d


GSPLAT = Rules()


class Gaussians(NamedTuple):
    """Gaussians by quaternions and scales or, where these are None, by covariances."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"] | None
    scales: Float[Tensor, "N 3"] | None
    opacities: Float[Tensor, "N"]
    covars: Float[Tensor, "N 3 3"] | None = None


class Splats(NamedTuple):
    """Gaussians on the image plane: those between the planes and not too faint, nearest first."""

    index: Int[Tensor, "M"]
    """Indices of the Gaussians."""
    centers: Float[Tensor, "M 2"]
    """[px]."""
    covars: Float[Tensor, "M 3"]
    """xx, xy and yy [px^2], with the low-pass variance."""
    determinants: Float[Tensor, "M"]
    depths: Float[Tensor, "M"]
    opacities: Float[Tensor, "M"]


class Matrix(NamedTuple):
    """Every splat in every pixel."""

    alphas: Float[Tensor, "P M"]
    """Before the cut-off and the cap."""

    def transmittances(self, alphas: Tensor) -> Tensor:
        """Product of 1 - alpha over the layers up to and including each."""
        return torch.cumprod(1 - alphas, -1)

    def total(self, weights: Tensor, values: Float[Tensor, "M D"]) -> Float[Tensor, "P D"]:
        """Weighted sum of the values of the splats in each pixel."""
        return weights @ values

    def any(self, flags: Tensor) -> Bool[Tensor, "P"]:
        """Whether a layer of each pixel has its flag set."""
        return flags.any(-1)


class Pairs(NamedTuple):
    """Pairs of a splat and a pixel, pixel after pixel, front to back; without those that are too faint to count."""

    alphas: Float[Tensor, "L"]
    splat: Int[Tensor, "L"]
    pixel: Int[Tensor, "L"]
    n_pixels: int

    def transmittances(self, alphas: Tensor) -> Tensor:
        """As in `Matrix`. Pixels are grouped by the length of their lists, and each group is padded to a matrix."""
        counts = torch.bincount(self.pixel, minlength=self.n_pixels)
        rank = torch.arange(len(self.pixel), device=self.pixel.device) - (counts.cumsum(0) - counts)[self.pixel]
        after = torch.zeros_like(alphas)
        longest, length, done = int(counts.max()), SHORTEST_LIST, 0
        while done < longest:
            rows = ((counts > done) & (counts <= length)).nonzero()[:, 0]
            row_of = torch.full_like(counts, -1)
            row_of[rows] = torch.arange(len(rows), device=rows.device)
            member = (row_of[self.pixel] >= 0).nonzero()[:, 0]
            where = row_of[self.pixel[member]], rank[member]
            padded = alphas.new_zeros(len(rows), length).index_put(where, alphas[member])
            after = after.index_put((member,), torch.cumprod(1 - padded, 1)[where])
            done, length = length, 2 * length
        return after

    def total(self, weights: Tensor, values: Tensor) -> Tensor:
        """As in `Matrix`."""
        shape = self.n_pixels, values.shape[-1]
        return values.new_zeros(shape).index_add(0, self.pixel, weights[:, None] * values[self.splat])

    def any(self, flags: Tensor) -> Tensor:
        """As in `Matrix`."""
        found = torch.zeros(self.n_pixels, dtype=torch.bool, device=flags.device)
        return found.index_fill(0, self.pixel[flags], True)


class Picture(NamedTuple):
    """An image, its opacity, and the pixels where a decision depends on rounding; `rasterization` gives a batch."""

    image: Float[Tensor, "*C H W D"]
    alphas: Float[Tensor, "*C H W 1"]
    fragile: Bool[Tensor, "*C H W"]


def project(gaussians: Gaussians, camera: Camera, rules: Rules = GSPLAT) -> Splats:
    """EWA projection (Zwicker et al. 2001); the determinant of quaternions and scales by Cauchy-Binet, uncancelled."""
    near, far, eps2d = rules.rounded()
    viewmat, K = camera.viewmat, camera.K
    focal, center = K[[0, 1], [0, 1]], K[:2, 2]
    size = torch.tensor([camera.width, camera.height]).to(K)
    points = gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = points[:, 2]
    index = ((depths >= near) & (depths <= far) & (gaussians.opacities >= rules.alpha_min)).nonzero()[:, 0]
    index = index[torch.argsort(depths[index], stable=True)]
    slopes, z = points[index, :2] / depths[index, None], depths[index]
    margin = 0.5 * JACOBIAN_LIMIT * size / focal
    u, v = torch.clamp(slopes, -center / focal - margin, (size - center) / focal + margin).unbind(-1)
    zero, (fx, fy) = torch.zeros_like(z), focal
    jacobian = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).unflatten(-1, (2, 3))
    rows = jacobian @ viewmat[:3, :3]
    if gaussians.covars is None:
        assert gaussians.quats is not None and gaussians.scales is not None
        p, q = (rows @ to_matrix(gaussians.quats[index]) * gaussians.scales[index, None]).unbind(1)
        xx, xy, yy = (p * p).sum(-1), (p * q).sum(-1), (q * q).sum(-1)
        determinants = torch.linalg.cross(p, q).square().sum(-1) + eps2d * (xx + yy) + eps2d**2
    else:
        covars = gaussians.covars[index]
        image = rows @ ((covars + covars.mT) / 2) @ rows.mT
        xx, xy, yy = image[:, 0, 0], image[:, 0, 1], image[:, 1, 1]
        determinants = (xx + eps2d) * (yy + eps2d) - xy**2
    return Splats(
        index,
        focal * slopes + center,
        torch.stack([xx + eps2d, xy, yy + eps2d], -1),
        determinants,
        z,
        gaussians.opacities[index],
    )


def pixels_between(low: Tensor, high: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Indices of boxes [n, 2], and columns and rows [P, 2] of the pixels whose centres they contain, box after box."""
    size = torch.tensor([width, height], device=low.device)
    first = (low - 0.5).ceil().clamp(min=torch.zeros_like(low), max=size).long()
    end = ((high - 0.5).floor() + 1).clamp(min=torch.zeros_like(low), max=size).long()
    sides = (end - first).clamp_min(0)
    counts = sides.prod(-1)
    which = torch.repeat_interleave(counts)
    rank = torch.arange(len(which), device=which.device) - (counts.cumsum(0) - counts)[which]
    columns = sides[which, 0]
    return which, first[which] + torch.stack([rank % columns, rank // columns], -1)


def all_pixels(width: int, height: int) -> Tensor:
    """Columns and rows [H W, 2], row by row."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([columns, rows], -1).view(-1, 2)


def alphas_at(splats: Splats, which: Tensor | slice, pixels: Tensor) -> Tensor:
    """Opacities times exp(-sigma) at pixel centres; sigma by a Cholesky solve, pivoted on the larger variance."""
    xx, xy, yy = splats.covars.unbind(-1)
    wide = xx >= yy
    pivot = torch.where(wide, xx, yy)
    h, slope, k = pivot.rsqrt()[which], (xy / pivot)[which], (pivot / splats.determinants).sqrt()[which]
    dx, dy = (pixels + 0.5 - splats.centers[which]).unbind(-1)
    along, across = torch.where(wide[which], dx, dy), torch.where(wide[which], dy, dx)
    return splats.opacities[which] * torch.exp(-0.5 * ((h * along) ** 2 + (k * (across - slope * along)) ** 2))


def dense_layers(splats: Splats, camera: Camera) -> Matrix:
    """Every splat in every pixel."""
    pixels = all_pixels(camera.width, camera.height).to(splats.index.device)
    return Matrix(alphas_at(splats, slice(None), pixels[:, None]))


def listed_layers(splats: Splats, camera: Camera, rules: Rules = GSPLAT) -> Pairs:
    """Splats in the pixels whose centres lie in their boxes."""
    reach = (2 * (splats.opacities.detach() / rules.alpha_min).log()).sqrt().clamp_max(rules.extent_sigmas)
    extents, centers = reach[:, None] * splats.covars[:, ::2].detach().sqrt(), splats.centers.detach()
    which, pixels = pixels_between(centers - extents, centers + extents, camera.width, camera.height)
    pixel, order = torch.sort(pixels[:, 1] * camera.width + pixels[:, 0], stable=True)  # splats come nearest first
    which = which[order]
    alphas = alphas_at(splats, which, pixels[order])
    counts = alphas >= (1 - FRAGILE_ALPHA) * rules.alpha_min
    return Pairs(alphas[counts], which[counts], pixel[counts], camera.width * camera.height)


def blend(layers: Matrix | Pairs, rules: Rules = GSPLAT) -> tuple[Tensor, Tensor]:
    """Weights alpha T of the layers and the transmittances behind them.

    The layer that would bring the transmittance to the stop or below is not drawn, nor is any behind it.
    """
    alphas = torch.where(layers.alphas >= rules.alpha_min, layers.alphas.clamp_max(ALPHA_MAX), 0)
    after = layers.transmittances(alphas)
    return torch.where(after > rules.transmittance_stop, alphas * after / (1 - alphas), 0), after


def draw(
    gaussians: Gaussians,
    colors: Float[Tensor, "N D"],
    camera: Camera,
    background: Float[Tensor, "D"] | None = None,
    render_mode: str = "RGB",
    rules: Rules = GSPLAT,
    dense: bool = False,
    slack: float = 1.0,
) -> Picture:
    """The image of one camera; `slack` multiplies the distances to thresholds that make a pixel fragile."""
    splats = project(gaussians, camera, rules)
    layers = dense_layers(splats, camera) if dense else listed_layers(splats, camera, rules)
    weights, after = blend(layers, rules)
    alpha = layers.total(weights, torch.ones_like(splats.depths)[:, None])
    parts = []
    if "RGB" in render_mode:
        image = layers.total(weights, colors[splats.index])
        parts.append(image if background is None else image + (1 - alpha) * background)
    if "D" in render_mode:
        depth = layers.total(weights, splats.depths[:, None])
        covered = alpha > 0
        parts.append(torch.where(covered, depth / torch.where(covered, alpha, 1), 0) if "ED" in render_mode else depth)
    fragile = torch.zeros_like(alpha[:, 0], dtype=torch.bool)
    for values, threshold, width in (
        (layers.alphas, rules.alpha_min, FRAGILE_ALPHA),
        (layers.alphas, ALPHA_MAX, FRAGILE_ALPHA),
        (after, rules.transmittance_stop, FRAGILE_STOP),
    ):
        fragile |= layers.any((values.detach() - threshold).abs() < slack * width * threshold)
    shape = camera.height, camera.width
    return Picture(torch.cat(parts, -1).unflatten(0, shape), alpha.unflatten(0, shape), fragile.view(shape))


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds=None, render_mode="RGB",
    sh_degree=None, covars=None, dense=False, slack=1.0, **rules,
) -> Picture:  # fmt: skip
    """As `oasis_warp.ops.rasterization`; `rules` are fields of `Rules`, for the rest see `draw`."""
    if sh_degree is not None:
        colors = sh_to_rgb(sh_degree, means, colors, viewmats)
    gaussians = Gaussians(means, quats, scales, opacities, covars)
    pictures = [
        draw(
            gaussians, colors[c] if colors.dim() == 3 else colors, Camera(viewmat, K, width, height),
            None if backgrounds is None else backgrounds[c], render_mode, Rules(**rules), dense, slack,
        )
        for c, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True))
    ]  # fmt: skip
    return Picture(*(torch.stack(parts) for parts in zip(*pictures, strict=True)))


def sh_basis(degree: int, directions: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N K"]:
    """Real spherical harmonics along directions of any length, orders -l .. l of degrees l = 0, 1, ..., by recurrence.

    With x + i y = sin(polar) e^(i azimuth), the functions are K_lm P_lm(z) times the real or imaginary part of
    (x + i y)^m, where P_lm is the Legendre function over sin^m. Signs are those of graphics: (-1)^m.
    """
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        real.append(real[-1] * x - imaginary[-1] * y)
        imaginary.append(real[-2] * y + imaginary[-1] * x)
    legendre = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(z, math.prod(range(1, 2 * m, 2)) * (-1) ** m)
        for n in range(m + 1, degree + 1):
            before = legendre[n - 2, m] if n - 2 >= m else torch.zeros_like(z)
            legendre[n, m] = ((2 * n - 1) * z * legendre[n - 1, m] - (n + m - 1) * before) / (n - m)
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            size = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            part = imaginary[k] if m < 0 else real[k]
            columns.append((math.sqrt(2) if m else 1.0) * size * legendre[n, k] * part)
    return torch.stack(columns, -1)


def sh_to_rgb(degree: int, means: Tensor, coefficients: Tensor, viewmats: Tensor) -> Tensor:
    """Colours [C, N, 3] of coefficients [N, K, 3] or [C, N, K, 3], seen from each camera."""
    centres = -(torch.linalg.inv(viewmats[:, :3, :3]) @ viewmats[:, :3, 3:])[..., 0]
    values = sh_basis(degree, means - centres[:, None])
    used = coefficients[..., : (degree + 1) ** 2, :]
    return ((values[..., None] * used).sum(-2) + 0.5).clamp(min=0)
