"""Visibility of lamps and sky on a batch of posed hands, from depth buffers."""

import functools

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.ops import depth_map
from oasis_warp.ops.smoothing import smooth_over_faces
from oasis_warp.synthetic.body import Body
from oasis_warp.synthetic.ops.skin_shading import sky_transfer
from oasis_warp.synthetic.ops.views import Lamps
from oasis_warp.synthetic.posing import PosedPeople
from oasis_warp.synthetic.shots import ShotTensors
from oasis_warp.synthetic.view_and_light import sphere

SKY_DIRECTIONS, SKY_SIZE = 40, 112
"""Number of depth buffers that sample the sky, and their side [px]."""
SKY_DISTANCE = 20.0
"""Distance of their cameras in radii of the hand: the rays are nearly parallel."""
LAMP_SIZE = 256
LAMP_MARGIN = 1.35
"""Radius that a lamp's buffer covers, in radii of the hand: a part of the arm casts shadows, too."""


def look_at(positions: Float[Tensor, "*batch 3"], targets: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """View matrices of cameras at `positions` that look at `targets`, with arbitrary roll."""
    z = torch.nn.functional.normalize(targets - positions, dim=-1)
    least = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).to(z)
    x = torch.nn.functional.normalize(torch.linalg.cross(least, z), dim=-1)
    rows = torch.stack([x, torch.linalg.cross(z, x), z], -2)
    shift = -(rows @ positions[..., None])
    last = torch.zeros_like(rows[..., :1, :])
    bottom = torch.cat([last, torch.ones_like(last[..., :1])], -1)
    return torch.cat([torch.cat([rows, shift], -1), bottom], -2)


def pinhole(focal: Float[Tensor, "*batch"], size: int) -> Float[Tensor, "*batch 3 3"]:
    """Intrinsics of square pictures of `size` pixels with a centred principal point."""
    K = torch.zeros(*focal.shape, 3, 3, device=focal.device)
    K[..., 0, 0] = K[..., 1, 1] = focal
    K[..., 0, 2] = K[..., 1, 2] = size / 2
    K[..., 2, 2] = 1
    return K


def _depths(vertices: Tensor, faces: Tensor, viewmats: Tensor, focals: Tensor, size: int) -> Tensor:
    """Depth buffers of each image's mesh from each of its [B, N] cameras, [B, N, size, size]."""
    batch, n = focals.shape
    vertices = vertices[:, None].expand(-1, n, -1, -1).flatten(0, 1)
    K = pinhole(focals.flatten(), size)
    seen = depth_map(vertices, faces, viewmats.flatten(0, 1), K, size, size, validate=False)
    return seen.depth.unflatten(0, (batch, n))


@functools.cache
def _directions(device: torch.device) -> Tensor:
    return torch.from_numpy(sphere(SKY_DIRECTIONS)).float().to(device)


def see_sky(body: Body, posed: PosedPeople, normals: Tensor) -> Float[Tensor, "B V 10"]:
    """Radiance transfer from the sky to every vertex, with occlusion, smoothed once."""
    directions = _directions(posed.vertices.device)
    radius = posed.radius * 1.02
    away = posed.center[:, None] + directions * (SKY_DISTANCE * radius)[:, None, None]
    viewmats = look_at(away, posed.center[:, None].expand_as(away))
    focals = SKY_DISTANCE * SKY_SIZE / 2 * torch.ones_like(radius)
    coarse = posed.vertices[:, body.coarse_vertices]
    each = focals[:, None].expand(-1, len(directions)).contiguous()
    depths = _depths(coarse, body.coarse_faces, viewmats, each, SKY_SIZE)
    transfer = sky_transfer(posed.vertices, normals, directions, viewmats, focals, depths)
    return smooth_over_faces(transfer, body.faces)


def light_lamps(body: Body, posed: PosedPeople, numbers: ShotTensors) -> Lamps:
    """The lamps of each picture with their depth buffers of the hand."""
    distances = numbers.lamp_distances
    center = posed.center[:, None].expand_as(numbers.lamp_directions)
    positions = center + numbers.lamp_directions * distances[..., None]
    viewmats = look_at(positions, center)
    focals = LAMP_SIZE / 2 * distances / (LAMP_MARGIN * posed.radius)[:, None]
    depths = _depths(posed.vertices, body.faces, viewmats, focals, LAMP_SIZE)
    return Lamps(positions, numbers.lamp_colors, distances, numbers.lamp_spreads, viewmats, focals, depths)


def no_lamps(like: Tensor) -> Lamps:
    """No lamps for each picture of a batch."""
    none = like.new_empty((len(like), 0))
    points, views = like.new_empty((len(like), 0, 3)), like.new_empty((len(like), 0, 4, 4))
    return Lamps(points, points, none, none, views, none, like.new_empty((len(like), 0, 1, 1)))
