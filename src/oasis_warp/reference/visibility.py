"""Depth maps and the visibility of points: rays through pixel centres against triangles, by homogeneous edge functions.

With `dense`, the default, each face is paired with every pixel and may cross the plane of the camera; without, it is
paired with the pixels of its box. Each pixel keeps its nearest hit.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from oasis_warp.core.types import Camera
from oasis_warp.reference.rasterization import all_pixels, pixels_between

EDGE_PIXELS = 2e-3
"""A ray that passes an edge this close may count as inside or outside [px]: rounding of float32 coordinates."""
NEAR_TIE = 1e-5
"""Relative difference of two depths below which either may be the nearer."""
GRAZING = 1e-3
"""Sine of the angle between a ray and a face below which the depth of the hit is mostly rounding."""


class Rays(NamedTuple):
    """Rays through the centres of pixels, and the faces that they may hit: each with each [R, F], or a list [L]."""

    rays: Tensor
    """Directions with z = 1."""
    edges: Tensor
    """Normals of the planes through the camera and the edges of the faces [F, 3, 3]."""
    normals: Tensor
    """Normals of the faces, twice their areas long [F, 3]."""
    degenerate: Tensor
    """[F]"""
    weights: Tensor
    """Barycentrics of the hits."""
    depths: Tensor
    """-1 where the ray lies in the plane of the face or the face is degenerate."""
    pixel: Tensor
    face: Tensor | None
    """Face of each pair, where rays and faces are listed."""


class Hits(NamedTuple):
    """The nearest face of each pixel [H, W]."""

    depth: Tensor
    """Infinite over the background."""
    face_ids: Tensor
    """-1 over the background."""
    barycentrics: Tensor
    """[H, W, 3]"""


class Certainty(NamedTuple):
    """What of `Hits` does not depend on rounding [H, W]."""

    sound: Tensor
    """The depth."""
    clear: Tensor
    """The face too: no other one is as near."""
    lone: Tensor
    """The same, but for copies of the face, which have its corners in some order."""


def cast(vertices: Tensor, faces: Tensor, camera: Camera, near_plane: float = 0.01, dense: bool = True) -> Rays:
    """Every ray that may hit a face, and where it meets the plane of the face."""
    K, width, height = camera.K, camera.width, camera.height
    corners = (vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[faces]
    if dense:
        face, which, pixels = None, slice(None), all_pixels(width, height).to(faces.device)
    else:
        beyond = (corners[..., 2] > near_plane).all(1).nonzero()[:, 0]
        xy = corners[beyond, :, :2] / corners[beyond, :, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
        face, pixels = pixels_between(xy.amin(1), xy.amax(1), width, height)
        face = which = beyond[face]
    directions = (pixels + 0.5 - K[:2, 2]) / K[[0, 1], [0, 1]]
    rays = torch.cat([directions, torch.ones_like(directions[:, :1])], -1)
    rays = rays[:, None] if dense else rays
    # The ray meets the triangle a, b, c at the barycentrics w / sum(w) (Olano and Greer 1997).
    a, b, c = corners.unbind(1)
    edges = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 1)
    normals = torch.linalg.cross(b - a, c - a)
    degenerate = normals.norm(dim=-1) <= 1e-14 * corners.square().sum((-1, -2))
    w = (rays[..., None, :] * edges[which]).sum(-1)
    total = w.sum(-1)
    flat = (total.abs() <= 1e-13 * rays.norm(dim=-1) * normals.norm(dim=-1)[which]) | degenerate[which]
    weights = w / torch.where(flat, 1, total)[..., None]
    depths = torch.where(flat, -1, (weights * corners[which][..., 2]).sum(-1))
    return Rays(rays, edges, normals, degenerate, weights, depths, pixels[:, 1] * width + pixels[:, 0], face)


def nearest_hits(rays: Rays, camera: Camera, near_plane: float = 0.01) -> Hits:
    """The nearest hit of each pixel; of equal depths that on the first face."""
    n_pixels, shape = camera.width * camera.height, (camera.height, camera.width)
    depths = torch.where((rays.weights >= 0).all(-1) & (rays.depths > near_plane), rays.depths, torch.inf)
    depths, weights = pad(depths, (0, 1), value=torch.inf), pad(rays.weights, (0, 0, 0, 1))  # a last one for no hit
    if rays.face is None:
        depth, face = depths.min(-1)
        weights = weights[torch.arange(n_pixels, device=face.device), face]
    else:
        values, last = depths.detach()[:-1], len(rays.face)
        nearest = values.new_full((n_pixels,), torch.inf).scatter_reduce(0, rays.pixel, values, "amin")
        wins = (values == nearest[rays.pixel]).nonzero()[:, 0]
        first = torch.full_like(nearest, last, dtype=torch.int64)
        first = first.scatter_reduce(0, rays.pixel[wins], wins, "amin")
        depth, face, weights = depths[first], pad(rays.face, (0, 1))[first], weights[first]
    none = depth.isinf()
    weights = torch.where(none[:, None], 0, weights)
    return Hits(depth.view(shape), torch.where(none, -1, face).view(shape), weights.view(*shape, 3))


@torch.no_grad()
def certainty(
    rays: Rays, hits: Hits, faces: Tensor, camera: Camera, near_plane: float = 0.01, slack: float = 1.0
) -> Certainty:
    """Where the nearest hit of dense `rays` does not depend on rounding; `slack` widens what counts as rounding."""
    shape = hits.depth.shape
    if len(faces) == 0:
        return Certainty(*torch.ones(3, *shape, dtype=torch.bool).unbind())
    w = (rays.rays[..., None, :] * rays.edges).sum(-1)
    total = w.sum(-1)
    slope = (rays.edges[..., :2] / camera.K[[0, 1], [0, 1]]).norm(dim=-1)
    inside = (w * total.sign()[..., None] / slope.clamp(min=1e-300)).amin(-1) / (slack * EDGE_PIXELS)
    grazing = total.abs() <= slack * GRAZING * rays.rays.norm(dim=-1) * rays.normals.norm(dim=-1)
    beyond = (rays.depths - near_plane) / (slack * NEAR_TIE * near_plane)
    # A sliver's edges are unsafe as a whole: its area is rounding.
    possible = ((inside > -1) & ((beyond > -1) | grazing) | grazing & (inside > -1000)) & ~rays.degenerate
    certain = (inside > 1) & (beyond > 1) & ~grazing
    nearer = possible & (rays.depths <= hits.depth.view(-1, 1) * (1 + NEAR_TIE))
    triangle = torch.unique(faces.sort(1).values, dim=0, return_inverse=True)[1]
    other = nearer & (triangle != triangle[hits.face_ids.view(-1, 1)])
    sound = ~(nearer & ~certain).any(-1)
    return Certainty(*(part.view(shape) for part in (sound, sound & (nearer.sum(-1) <= 1), sound & ~other.any(-1))))


def depth_map(vertices: Tensor, faces: Tensor, camera: Camera, near_plane: float = 0.01, dense: bool = True) -> Hits:
    """As `oasis_warp.ops.depth_map`; differentiable in the vertices where the face stays the same."""
    return nearest_hits(cast(vertices, faces, camera, near_plane, dense), camera, near_plane)


def pixels_of(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Image coordinates [P, 2] and depths [P] of points; where the depth is 0 the coordinates are large."""
    camera_points = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = camera_points[:, 2]
    safe = torch.where(z.abs() > 1e-30, z, 1e-30)[:, None]
    return camera_points[:, :2] / safe * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], z


def score_points(
    points: Tensor,
    hits: Hits,
    faces: Tensor,
    camera: Camera,
    tau: float = 0.0015,
    margin: float | None = None,
    point_vertices: Tensor | None = None,
    near_plane: float = 0.01,
) -> Tensor:
    """As `oasis_warp.ops.depth_visibility` against a given depth map: scores [P]."""
    xy, z = pixels_of(points, camera)
    size = torch.tensor([camera.width, camera.height], device=points.device)
    pixel = xy.detach().floor()
    inside = (z > near_plane) & ((pixel >= 0) & (pixel < size)).all(-1)
    column, row = torch.where(inside[:, None], pixel, 0).long().unbind(-1)
    depth = hits.depth[row, column]
    shown = hits.face_ids[row, column] < 0
    if point_vertices is not None and len(faces):
        around = pad(hits.face_ids, (1, 1, 1, 1), value=-1).unfold(0, 3, 1).unfold(1, 3, 1)[row, column].flatten(1)
        owned = (faces[around.clamp(min=0)] == point_vertices[:, None, None]).any(-1) & (around >= 0)
        shown = shown | owned.any(-1)
    gap = torch.where(depth.isinf(), z.detach(), depth) - z + (3 * tau if margin is None else margin)
    return torch.where(inside, torch.where(shown, 1, torch.sigmoid(gap / tau)), 0)


@torch.no_grad()
def stable_points(
    points: Tensor, known: Certainty, camera: Camera, named: bool, near_plane: float = 0.01, slack: float = 1.0
) -> Tensor:
    """Whether the score of each point [P] does not depend on rounding; `named` if `point_vertices` are given."""
    xy, z = pixels_of(points, camera)
    size = torch.tensor([camera.width, camera.height], device=points.device)
    border = (xy - xy.round()).abs() <= slack * EDGE_PIXELS + 1e-6 * xy.abs()
    border &= (z > 0)[:, None] & (xy > -1) & (xy < size + 1)
    keep = ((z - near_plane).abs() > slack * NEAR_TIE * near_plane) & ~border.any(-1)
    column, row = torch.minimum(xy.clamp(min=0), size - 1).long().unbind(-1)
    doubtful = max_pool2d((~known.clear)[None, None].double(), 3, 1, padding=1)[0, 0] > 0
    return keep & (~doubtful if named else known.lone)[row, column]


def depth_visibility(
    points: Tensor, vertices: Tensor, faces: Tensor, camera: Camera, near_plane: float = 0.01, dense: bool = True,
    **scoring,
) -> Tensor:  # fmt: skip
    """As `oasis_warp.ops.depth_visibility`: scores [P]; `scoring` are arguments of `score_points`."""
    hits = depth_map(vertices, faces, camera, near_plane, dense)
    return score_points(points, hits, faces, camera, near_plane=near_plane, **scoring)
