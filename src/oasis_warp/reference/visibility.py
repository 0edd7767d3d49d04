"""Depth buffer and visibility: every pixel against every face by homogeneous edge functions, points one by one."""

from typing import NamedTuple

import torch
from torch import Tensor

EDGE_PIXELS = 2e-3
"""A ray that passes an edge this close may count as inside or outside [px]: rounding of float32 coordinates."""
NEAR_TIE = 1e-5
"""Relative distance of two depths below which either may be the nearer."""
GRAZING = 1e-3
"""Sine of the angle between a ray and a face below which the depth of the hit is mostly rounding."""


class Hits(NamedTuple):
    """What the rays through the pixels' centres [pixels] meet."""

    depth: Tensor
    face_ids: Tensor
    weights: Tensor
    """Barycentrics [pixels, 3]."""
    sound: Tensor
    """Whether the depth does not hang on rounding."""
    clear: Tensor
    """Whether the face does not, either: no other one is as near."""
    lone: Tensor
    """The same but for copies of the face, which have its corners in some order."""


def cast(vertices, faces, viewmat, K, width, height, near_plane=0.01, slack=1.0) -> Hits:
    """The nearest hit of each pixel's ray; differentiable in the vertices where the face stays the same."""
    corners = (vertices @ viewmat[:3, :3].T + viewmat[:3, 3])[faces]
    columns, rows = torch.arange(width).to(vertices), torch.arange(height).to(vertices)
    x, y = torch.meshgrid(columns + 0.5, rows + 0.5, indexing="xy")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1).reshape(-1, 1, 3)
    a, b, c = corners.unbind(1)
    edges = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 1)
    normal = torch.linalg.cross(b - a, c - a)
    w = (rays[:, :, None] * edges).sum(-1)  # [pixels, faces, 3]
    total = w.sum(-1)
    degenerate = normal.norm(dim=-1) <= 1e-14 * corners.square().sum((-1, -2))
    flat = (total.abs() <= 1e-13 * rays.norm(dim=-1) * normal.norm(dim=-1)) | degenerate
    weights = w / torch.where(flat, 1, total)[..., None]
    depth = torch.where(flat, -1.0, (weights * corners[..., 2]).sum(-1))
    hit = (weights >= 0).all(-1) & (depth > near_plane) & ~flat
    may, surely = margins(w, edges, total, normal, rays, K, depth, near_plane, slack)
    return choose(hit, depth, weights, may & ~degenerate, surely, faces)


def margins(w, edges, total, normal, rays, K, depth, near_plane, slack):
    """For pixels x faces: whether the ray may hit the face, and whether it does beyond doubt."""
    slope = torch.stack([edges[..., 0] / K[0, 0], edges[..., 1] / K[1, 1]], -1).norm(dim=-1)
    inside = (w * total.sign()[..., None] / slope.clamp(min=1e-300)).amin(-1) / (slack * EDGE_PIXELS)
    grazing = total.abs() <= slack * GRAZING * rays.norm(dim=-1) * normal.norm(dim=-1)
    # A sliver's edges are unsafe as a whole: its area is rounding.
    beyond = (depth - near_plane) / (slack * NEAR_TIE * near_plane)
    may = (inside > -1) & ((beyond > -1) | grazing) | grazing & (inside > -1000)
    return may.detach(), ((inside > 1) & (beyond > 1) & ~grazing).detach()


def choose(hit, depth, weights, may, surely, faces) -> Hits:
    """The nearest of all hits of each pixel."""
    n_pixels, n_faces = hit.shape
    if n_faces == 0:
        empty = torch.full((n_pixels,), torch.inf).to(depth)
        yes = torch.ones(n_pixels, dtype=torch.bool)
        return Hits(empty, torch.full((n_pixels,), -1), torch.zeros(n_pixels, 3).to(depth), yes, yes, yes)
    found, face_ids = torch.where(hit, depth, torch.inf).min(-1)
    nothing = found.isinf()
    here = torch.arange(n_pixels)
    limit = found.detach() * (1 + NEAR_TIE)
    nearer = may & (depth <= limit[:, None])
    doubtful = nearer & ~surely
    sound = ~doubtful.any(-1)
    clear = sound & (nearer.sum(-1) <= 1)
    triangle = torch.unique(faces.sort(1).values, dim=0, return_inverse=True)[1]
    lone = sound & ~(nearer & (triangle != triangle[face_ids][:, None])).any(-1)
    picked = torch.where(nothing[:, None], 0, weights[here, face_ids])
    return Hits(found, torch.where(nothing, -1, face_ids), picked, sound, clear, lone)


def depth_map(vertices, faces, viewmat, K, width, height, near_plane=0.01):
    """Depth [H, W], face ids [H, W], barycentrics [H, W, 3]."""
    hits = cast(vertices, faces, viewmat, K, width, height, near_plane)
    return hits.depth.view(height, width), hits.face_ids.view(height, width), hits.weights.view(height, width, 3)


def depth_visibility(points, depth, face_ids, faces, K, viewmat, tau, margin, point_vertices=None, near_plane=0.01):
    """Scores [P] against a given buffer."""
    height, width = depth.shape
    out = []
    for i, (x, y, z) in enumerate(points @ viewmat[:3, :3].T + viewmat[:3, 3]):
        u, v = (K[0, 0] * x / z + K[0, 2]).floor(), (K[1, 1] * y / z + K[1, 2]).floor()
        if z <= near_plane or not (0 <= u < width and 0 <= v < height):
            out.append(0 * z)
            continue
        u, v = int(u), int(v)
        around = face_ids[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        seen = point_vertices is not None and bool((faces[around[around >= 0]] == int(point_vertices[i])).any())
        if seen or face_ids[v, u] < 0:
            out.append(0 * z + 1)
        else:
            out.append(torch.sigmoid((depth[v, u] - z + margin) / tau))
    return torch.stack(out) if out else points.new_zeros(0)


def sound_points(points, hits: Hits, K, viewmat, width, height, named, near_plane=0.01, slack=1.0):
    """Which points [P] have a score that does not hang on rounding; `named` says that `point_vertices` counts."""
    lone, clear = hits.lone.view(height, width), hits.clear.view(height, width)
    x, y, z = (points.detach() @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)
    safe_z = torch.where(z.abs() > 1e-30, z, 1e-30)
    keep = (z - near_plane).abs() > slack * NEAR_TIE * near_plane
    pixel = []
    for q, size, focal, centre in ((x, width, K[0, 0], K[0, 2]), (y, height, K[1, 1], K[1, 2])):
        u = focal * q / safe_z + centre
        border = (u - u.round()).abs() <= slack * EDGE_PIXELS + 1e-6 * u.abs()
        keep &= ~((z > 0) & border & (u > -1) & (u < size + 1))
        pixel.append(u.clamp(0, size - 1).long())
    padded = torch.nn.functional.pad(clear[None, None].double(), (1, 1, 1, 1), value=1.0)
    all_clear = -torch.nn.functional.max_pool2d(-padded, 3, 1)[0, 0] > 0
    return keep & (all_clear if named else lone)[pixel[1], pixel[0]]
