"""Look for holes in an avatar from any side."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import OPACITY, place_anchors
from oasis_warp.core.camera import orbit_camera
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map

COVERED = 0.9
"""Alpha from which a pixel counts as covered."""
COVERAGE_POSES = ("rest", "fist", "pinch", "point")
COVERAGE_VIEWS = 8


@torch.no_grad()
def coverage(avatar: Avatar, size: int = 256) -> Float[Tensor, "P C"]:
    """Share of the posed mesh's silhouette with alpha >= 0.9, for each pose and each of 8 views around it.

    The wrist's rim, where opacity fades out on purpose, is not part of the silhouette; where a learned prior made
    Gaussians fainter, it is.
    """
    faces, anchors = avatar.hand.faces, place_anchors(avatar.hand, avatar.rest)
    solid = torch.zeros(len(avatar.rest.vertices), device=avatar.device)
    solid[anchors.vertex_index] = anchors.opacities[: len(anchors.vertex_index)]
    solid_faces = (solid[faces] >= OPACITY - 1e-4).all(1)
    shares = torch.zeros(len(COVERAGE_POSES), COVERAGE_VIEWS)
    for p, name in enumerate(COVERAGE_POSES):
        pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, name))
        vertices = avatar.mesh(pose).vertices
        for c in range(COVERAGE_VIEWS):
            camera = orbit_camera(vertices, 2 * math.pi * c / COVERAGE_VIEWS, size=size)
            ids = depth_map(vertices, faces, camera.viewmat, camera.K, size, size).face_ids
            inside = (ids >= 0) & solid_faces[ids.clamp_min(0).long()]
            alpha = avatar.render(camera, pose).alpha
            shares[p, c] = (alpha[inside] >= COVERED).float().mean()
    return shares
