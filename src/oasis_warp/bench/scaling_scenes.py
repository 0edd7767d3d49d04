"""Seeded scenes of any size: a surface covered by as many Gaussians as asked for, and two that load a rasterizer most.

Float32, made on the CPU, as in `scenes`.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import OPACITY, THICKNESS, surface_frames
from oasis_warp.bench.scenes import Scene, cameras_around, frontal, hand_parts

SPREAD = 0.6
"""Standard deviation of a surfel over the root of its share of the surface: the hand's Gaussians have 0.5 to 0.7."""
UNEVEN = 0.25
"""Standard deviation of the logarithm of that."""
TILE = 8
"""Side of the tile that `one_tile` fills [px]."""


def surface(n: int, size: int = 512, n_views: int = 1, seed: int = 0) -> Scene:
    """`n` surfels spread evenly over the posed hand, smaller the more there are: they cover it as densely for any n.

    Args:
        n: Gaussians.
        size: Side of the pictures [px].
        n_views: Cameras, all round.
        seed: Of places, sizes and colours.
    """
    generator = torch.Generator().manual_seed(seed)
    hand, _, _, posed, _ = hand_parts(generator)
    corners = posed[hand.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends = (normals.norm(dim=-1).double() / 2).cumsum(0)
    area = float(ends[-1])
    # One in each n-th of the surface, by area along the list of faces.
    places = (torch.arange(n, dtype=torch.float64) + torch.rand(n, dtype=torch.float64, generator=generator)) * area / n
    face = torch.searchsorted(ends, places).clamp_max(len(ends) - 1)
    frames = surface_frames(normalize(normals, dim=-1), corners[:, 1] - corners[:, 0])
    turn = 2 * math.pi * torch.rand(n, generator=generator)
    spread = SPREAD * math.sqrt(area / n) * torch.exp(UNEVEN * torch.randn(n, 2, generator=generator))
    cameras = cameras_around(posed, size, n_views)
    viewmats, Ks = (torch.stack([getattr(camera, name) for camera in cameras]) for name in ("viewmat", "K"))
    return Scene(
        f"surface {n}", seed, points_on(corners[face], generator), turned_about_z(frames[face], turn),
        torch.cat([spread, THICKNESS * spread.amin(-1, keepdim=True)], -1), torch.full((n,), OPACITY),
        torch.rand(n, 3, generator=generator), viewmats, Ks, torch.zeros(n_views, 3), size, size,
    )  # fmt: skip


def points_on(corners: Float[Tensor, "N 3 3"], generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """A random point on each triangle, all of it equally likely (Osada et al. 2002, section 4.1)."""
    root, along = torch.rand(2, len(corners), 1, generator=generator)
    root = root.sqrt()
    return (1 - root) * corners[:, 0] + root * (1 - along) * corners[:, 1] + root * along * corners[:, 2]


def turned_about_z(quats: Float[Tensor, "N 4"], angles: Float[Tensor, "N"]) -> Float[Tensor, "N 4"]:
    """Quaternions wxyz of frames turned about their own third axis [rad]."""
    w, x, y, z = quats.unbind(-1)
    c, s = (0.5 * angles).cos(), (0.5 * angles).sin()
    return torch.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], -1)


def one_tile(n: int = 100_000, size: int = 512, seed: int = 0) -> Scene:
    """`n` Gaussians of a pixel each, faint, and all in one tile: nearly all of its list is drawn in every pixel."""
    generator = torch.Generator().manual_seed(seed)
    corner = size // 2 // TILE * TILE
    pixels = corner + 0.7 + (TILE - 1.4) * torch.rand(n, 2, generator=generator)
    depths = 1 + torch.rand(n, generator=generator)
    means = before_pixels(pixels, depths, size)
    return frontal(
        "one tile", seed, means, torch.randn(n, 4, generator=generator), depths[:, None] * torch.full((n, 3), 1e-5),
        torch.full((n,), 2 / 255), torch.rand(n, 3, generator=generator), size,
    )  # fmt: skip


def giants(n: int = 1000, size: int = 512, seed: int = 0) -> Scene:
    """`n` Gaussians wider than the picture: every tile lists all, and they are too faint for a pixel to end early."""
    generator = torch.Generator().manual_seed(seed)
    pixels = size * torch.rand(n, 2, generator=generator)
    depths = 1 + torch.rand(n, generator=generator)
    scales = depths[:, None] * (1.5 + 0.3 * torch.rand(n, 3, generator=generator))
    scales[:, 2] *= 0.01  # flat to the view
    opacities = 0.005 + 0.004 * torch.rand(n, generator=generator)
    level = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4)
    return frontal(
        "giants", seed, before_pixels(pixels, depths, size), level, scales, opacities,
        torch.rand(n, 3, generator=generator), size,
    )  # fmt: skip


def before_pixels(pixels: Tensor, depths: Tensor, size: int) -> Tensor:
    """Points that the camera of `frontal` sees at `pixels`."""
    center = size / 2 - 0.2
    return torch.cat([(pixels - center) / size * depths[:, None], depths[:, None]], -1)


def crop(scene: Scene, left: int, top: int, side: int) -> Scene:
    """A square part of the first camera's picture as a picture of its own."""
    K = scene.Ks[:1].clone()
    K[:, 0, 2] -= left
    K[:, 1, 2] -= top
    return replace(
        scene, viewmats=scene.viewmats[:1], Ks=K, backgrounds=scene.backgrounds[:1], width=side, height=side
    )  # fmt: skip
