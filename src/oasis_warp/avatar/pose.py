"""Carry canonical Gaussians into a pose; no network, no image."""

from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.lighting import lit_colors
from oasis_warp.core import rotation
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandLight
from oasis_warp.ops import RestMesh, face_rotations, pose_on_mesh


def pose_gaussians(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    rest_vertices: Float[Tensor, "V 3"] | RestMesh,
    posed_vertices: Float[Tensor, "*B V 3"],
    light: tuple[HandLight, Float[Tensor, "V 3"]] | None = None,
) -> Gaussians:
    """Gaussians that follow the surface from `rest_vertices` to `posed_vertices` (the paper's appendix B.1).

    Face Gaussians keep their barycentrics, turn by the blended rotation of the face's corners and grow with the root
    of the face's area; vertex Gaussians turn with their vertex and grow with the faces around it together. Values are
    not checked here: who poses has checked the pose. A surface that is posed many times is given as its `rest_mesh`.
    With an axis of poses before `posed_vertices`, means, quats and scales have it too, and colours where there is a
    `light`: it comes with the unit normals of the rest surface, and colours are drawn in it.
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
    colors = canonical.colors
    if light is not None:
        source, normals = light
        directions = rotation.rotate(turned.vertex_quats, normals.expand_as(posed_vertices))
        colors = lit_colors(canonical, faces, source, directions)
    return Gaussians(means, quats, scales, canonical.opacities, colors)
