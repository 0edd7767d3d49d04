"""Depth buffer and visibility in plain torch: every pixel against every face, by solving for the point it hits."""

import torch


def depth_map(vertices, faces, viewmat, K, width, height, near_plane=0.01):
    corners = (vertices @ viewmat[:3, :3].T + viewmat[:3, 3])[faces]
    columns, rows = torch.arange(width).to(vertices), torch.arange(height).to(vertices)
    x, y = torch.meshgrid(columns + 0.5, rows + 0.5, indexing="xy")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    # corners^T w = ray has the barycentrics of the hit as w / sum(w), at depth 1 / sum(w).
    w = torch.linalg.solve(corners.transpose(1, 2), rays.reshape(-1, 1, 3, 1))[..., 0]
    depth = 1 / w.sum(-1)
    weights = w * depth[..., None]
    hit = (weights >= 0).all(-1) & (depth > near_plane)
    depth, face_ids = torch.where(hit, depth, torch.inf).min(-1)
    weights = weights[torch.arange(len(weights)), face_ids]
    nothing = depth.isinf()
    face_ids[nothing], weights[nothing] = -1, 0
    return depth.view(height, width), face_ids.view(height, width), weights.view(height, width, 3)


def depth_visibility(points, depth, face_ids, faces, K, viewmat, tau, margin, point_vertices=None, near_plane=0.01):
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
