"""Carry canonical Gaussians into a pose; no network, no image."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core import rotation, surface
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
    of the face's area; vertex Gaussians turn with their vertex and grow with the mean of the faces around it. Values
    are not checked here: who poses has checked the pose.
    """
    turned = face_rotations(rest_vertices, posed_vertices, faces, validate=False)
    on_faces = slice(len(canonical.vertex_index), None)
    face_means, face_quats, face_scales = pose_on_mesh(
        posed_vertices,
        faces,
        canonical.face_index,
        canonical.barycentrics,
        turned.vertex_quats,
        turned.area_ratio,
        canonical.quats[on_faces],
        canonical.scales[on_faces],
        validate=False,
    )
    index = canonical.vertex_index
    vertex_turn = turned.vertex_quats[index]
    shift = (rotation.to_matrix(vertex_turn) @ canonical.offsets[..., None])[..., 0]
    rest_area = surface.vertex_areas(rest_vertices, faces)[index]
    grown = surface.vertex_areas(posed_vertices, faces)[index] / rest_area
    on_vertices = slice(len(index))
    return Gaussians(
        means=torch.cat([posed_vertices[index] + shift, face_means]),
        quats=torch.cat([rotation.multiply(vertex_turn, canonical.quats[on_vertices]), face_quats]),
        scales=torch.cat([canonical.scales[on_vertices] * grown.sqrt()[:, None], face_scales]),
        opacities=canonical.opacities,
        colors=canonical.colors,
    )


def mirror_gaussians(gaussians: Gaussians) -> Gaussians:
    """The mirror image at the plane x = 0; a rotation R becomes M R M, a quaternion (w, x, -y, -z)."""
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=gaussians.means.dtype, device=gaussians.means.device)
    turn = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=gaussians.means.dtype, device=gaussians.means.device)
    return gaussians._replace(means=gaussians.means * flip, quats=gaussians.quats * turn)
