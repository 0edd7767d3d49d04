"""Carry canonical Gaussians into a pose; no network, no image."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.types import CanonicalGaussians, Gaussians
from oasis_warp.ops import face_rotations, pose_on_mesh


def pose_gaussians(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    rest_vertices: Float[Tensor, "V 3"],
    posed_vertices: Float[Tensor, "V 3"],
) -> Gaussians:
    """Gaussians that follow the surface from `rest_vertices` to `posed_vertices` (the paper's appendix B.1).

    Face Gaussians keep their barycentrics, turn by the blended rotation of the face's corners and grow with the root
    of the face's area; vertex Gaussians turn with their vertex and grow with the faces around it together. Values are
    not checked here: who poses has checked the pose.
    """
    turned = face_rotations(rest_vertices, posed_vertices, faces, validate=False)
    means, quats, scales = pose_on_mesh(
        posed_vertices,
        faces,
        canonical.face_index,
        canonical.barycentrics,
        turned.vertex_quats,
        turned.area_ratio,
        canonical.quats,
        canonical.scales,
        vertex_index=canonical.vertex_index,
        offsets=canonical.offsets,
        vertex_area_ratio=turned.vertex_area_ratio,
        validate=False,
    )
    return Gaussians(means, quats, scales, canonical.opacities, canonical.colors)


def mirror_gaussians(gaussians: Gaussians) -> Gaussians:
    """The mirror image at the plane x = 0; a rotation R becomes M R M, a quaternion (w, x, -y, -z)."""
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=gaussians.means.dtype, device=gaussians.means.device)
    turn = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=gaussians.means.dtype, device=gaussians.means.device)
    return gaussians._replace(means=gaussians.means * flip, quats=gaussians.quats * turn)
