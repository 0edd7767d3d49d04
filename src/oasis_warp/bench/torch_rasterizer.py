"""The rasterizer as one would write it in torch: a list of every Gaussian in every pixel, differentiated by torch.

The peer that the kernels are timed against, and an implementation apart from theirs to check them by, at sizes where
pixels x Gaussians does not fit into memory. Shares no code with the kernels; the rules are gsplat 1.5.3's.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.bench.scenes import Scene
from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops._runtime.rules import Rules

ALPHA_MAX = 0.9990000128746033
EPS2D = 0.30000001192092896
"""Both, as all thresholds, are float32 numbers in either precision."""
JACOBIAN_LIMIT = 0.3
FRAGILE = {"alpha_min": 3e-4, "alpha_max": 3e-4, "stop": 2e-3}
"""Relative distance to a threshold within which float32 may decide otherwise than float64."""
SHORTEST_LIST = 8
"""Layers a pixel of the smallest group; each next group holds lists twice as long, so padding at most doubles them."""


class Splats(NamedTuple):
    """Gaussians on the image plane, those in front of the near plane only, nearest first."""

    index: Int[Tensor, "M"]
    centers: Float[Tensor, "M 2"]
    whitenings: Float[Tensor, "M 3"]
    """h, l, k of y = (h dx, k (dy - l dx)), whose squared length is the exponent times -2."""
    extents: Float[Tensor, "M 2"]
    """Half sides of the box that the Gaussian can reach [px]."""


class Pairs(NamedTuple):
    """Every Gaussian in every pixel of its box, pixel after pixel, front to back."""

    splat: Int[Tensor, "P"]
    pixel: Int[Tensor, "P"]
    alphas: Float[Tensor, "P"]
    """Not yet cut or capped."""


def splat(scene: Scene, rules: Rules, near_plane: float) -> Splats:
    """EWA projection (Zwicker et al. 2001); determinant by Cauchy-Binet, the conic as its Cholesky factor."""
    viewmat, K = scene.viewmats[0], scene.Ks[0]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    points = scene.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    index = ((points[:, 2] >= near_plane) & (scene.opacities >= rules.alpha_min)).nonzero()[:, 0]
    index = index[torch.argsort(points[index, 2], stable=True)]
    x, y, z = points[index].unbind(-1)
    margin_x, margin_y = JACOBIAN_LIMIT * 0.5 * scene.width / fx, JACOBIAN_LIMIT * 0.5 * scene.height / fy
    u = torch.minimum(torch.maximum(x / z, -cx / fx - margin_x), (scene.width - cx) / fx + margin_x)
    v = torch.minimum(torch.maximum(y / z, -cy / fy - margin_y), (scene.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).unflatten(-1, (2, 3))
    p, q = (jacobian @ viewmat[:3, :3] @ to_matrix(scene.quats[index]) * scene.scales[index, None]).unbind(1)
    pp, pq, qq = (p * p).sum(-1), (p * q).sum(-1), (q * q).sum(-1)
    determinant = torch.linalg.cross(p, q).square().sum(-1) + EPS2D * (pp + qq) + EPS2D**2
    a, c = pp + EPS2D, qq + EPS2D
    reach = (2 * (scene.opacities[index].detach() / rules.alpha_min).log()).sqrt().clamp_max(rules.extent_sigmas)
    return Splats(
        index,
        torch.stack([fx * x / z + cx, fy * y / z + cy], -1),
        torch.stack([a.rsqrt(), pq / a, (a / determinant).sqrt()], -1),
        reach[:, None] * torch.stack([a, c], -1).detach().sqrt(),
    )


def list_pairs(scene: Scene, splats: Splats) -> Pairs:
    """Pairs of splats and the pixels whose centres their boxes hold."""
    centers = splats.centers.detach()
    size = torch.tensor([scene.width, scene.height], device=centers.device)
    low = (centers - splats.extents - 0.5).ceil().clamp(min=torch.zeros_like(centers), max=size).long()
    high = ((centers + splats.extents - 0.5).floor() + 1).clamp(min=torch.zeros_like(centers), max=size).long()
    sides = (high - low).clamp_min(0)
    counts = sides.prod(-1)
    which = torch.repeat_interleave(counts)
    place = torch.arange(len(which), device=which.device) - (counts.cumsum(0) - counts)[which]
    x = low[which, 0] + place % sides[which, 0]
    y = low[which, 1] + place // sides[which, 0]
    pixel, order = torch.sort(y * scene.width + x, stable=True)  # splats come nearest first
    which, x, y = which[order], x[order], y[order]
    dx, dy = (torch.stack([x, y], -1) + 0.5 - splats.centers[which]).unbind(-1)
    h, slope, k = splats.whitenings[which].unbind(-1)
    exponents = -0.5 * ((h * dx) ** 2 + (k * (dy - slope * dx)) ** 2)
    return Pairs(which, pixel, scene.opacities[splats.index[which]] * torch.exp(exponents))


def transmittances(
    alphas: Float[Tensor, "P"], pixel: Int[Tensor, "P"], n_pixels: int
) -> Float[Tensor, "P"]:
    """Product of 1 - alpha over the pairs of the same pixel up to and with each pair.

    Pixels are grouped by the length of their lists, and each group is padded to a matrix.
    """
    counts = torch.bincount(pixel, minlength=n_pixels)
    rank = torch.arange(len(pixel), device=pixel.device) - (counts.cumsum(0) - counts)[pixel]
    after = torch.zeros_like(alphas)
    longest, length, done = int(counts.max()), SHORTEST_LIST, 0
    while done < longest:
        rows = ((counts > done) & (counts <= length)).nonzero()[:, 0]
        row_of = torch.full_like(counts, -1)
        row_of[rows] = torch.arange(len(rows), device=rows.device)
        member = (row_of[pixel] >= 0).nonzero()[:, 0]
        where = row_of[pixel[member]], rank[member]
        padded = alphas.new_zeros(len(rows), length).index_put(where, alphas[member])
        after = after.index_put((member,), torch.cumprod(1 - padded, 1)[where])
        done, length = length, 2 * length
    return after


class Picture(NamedTuple):
    """A drawn scene, and where rounding may have decided otherwise."""

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W 1"]
    fragile: Bool[Tensor, "H W"]


def draw(scene: Scene, rules: Rules | None = None, near_plane: float = 0.01) -> Picture:
    """`rasterization` of one camera over its background; differentiable in every tensor of the scene but Ks.

    Args:
        scene: In float32 or float64, on any device.
        rules: Thresholds; gsplat's when None.
        near_plane: Gaussians whose centre is nearer are not drawn [m].
    """
    rules = rules or Rules()
    splats = splat(scene, rules, near_plane)
    pairs = list_pairs(scene, splats)
    n_pixels = scene.width * scene.height
    raw = pairs.alphas
    seen = raw >= rules.alpha_min
    if not seen.any():
        image = scene.backgrounds[0].expand(scene.height, scene.width, 3)
        return Picture(image, torch.zeros_like(image[..., :1]), torch.zeros_like(image[..., 0], dtype=torch.bool))
    edge = (raw - rules.alpha_min).abs() < FRAGILE["alpha_min"] * rules.alpha_min
    edge |= (raw - ALPHA_MAX).abs() < FRAGILE["alpha_max"] * ALPHA_MAX
    edge_pixels = pairs.pixel[edge]

    which, pixel = pairs.splat[seen], pairs.pixel[seen]
    alphas = raw[seen].clamp_max(ALPHA_MAX)
    after = transmittances(alphas, pixel, n_pixels)
    stop = rules.transmittance_stop
    near_stop = (after.detach() - stop).abs() < FRAGILE["stop"] * stop
    edge_pixels = torch.cat([edge_pixels, pixel[near_stop]])
    weights = torch.where(after > stop, alphas * after / (1 - alphas), 0)
    colors = scene.colors[splats.index[which]]
    image = colors.new_zeros(n_pixels, 3).index_add(0, pixel, weights[:, None] * colors)
    alpha = colors.new_zeros(n_pixels).index_add(0, pixel, weights)[:, None]
    fragile = torch.zeros(n_pixels, dtype=torch.bool, device=pixel.device).index_fill(0, edge_pixels, True)
    shape = scene.height, scene.width
    return Picture(
        (image + (1 - alpha) * scene.backgrounds[0]).unflatten(0, shape),
        alpha.unflatten(0, shape),
        fragile.unflatten(0, shape),
    )
