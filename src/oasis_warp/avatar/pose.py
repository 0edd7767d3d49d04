"""Canonical Gaussians in a pose and in a light; no network, no image."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.core import rotation, surface
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandLight
from oasis_warp.ops import RestMesh, face_rotations, pose_on_mesh

GAMMA = 2.2
"""Light is sRGB to this power, nearly."""
AS_IN_PHOTO, TURNED_AWAY = math.cos(math.radians(5)), math.cos(math.radians(20))
"""Cosines of the angle by which skin has turned from where the photo shows it, up to which its shade stays as it is and
from which it is gone."""
MIN_COLOR = 1e-3
"""Least colour that has shade: it is a factor."""


def shading(light: HandLight, normals: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V 3"]:
    """Factor of the sRGB colours of vertices that face `normals` (unit, in the world of the photo's camera).

    Without the shade of Gaussians.
    """
    received = light.harmonics[0] + normals @ light.harmonics[1:]
    least, most = light.limits.unbind(0)
    factor = torch.minimum(torch.maximum(received, least), most).pow(1 / GAMMA)
    if light.shade is None or light.facing is None:
        return factor
    return factor * (1 + _stays(light.facing, normals) * (light.shade - 1))


def _stays(facing: Float[Tensor, "V 3"], normals: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V 1"]:
    """Share of shade that is left."""
    cosine = (normals * facing).sum(-1, keepdim=True)
    return ((cosine - TURNED_AWAY) / (AS_IN_PHOTO - TURNED_AWAY)).clamp(0, 1)


def shading_factors(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    light: HandLight,
    normals: Float[Tensor, "*B V 3"],
) -> Float[Tensor, "*B N 3"]:
    """What `light` multiplies the colours of Gaussians with, where the vertices face `normals`."""
    of_vertices = shading(light, normals)
    if canonical.shade is None or light.facing is None:
        return _at_gaussians(of_vertices, faces, canonical)
    read = _at_gaussians(torch.cat([of_vertices, _stays(light.facing, normals)], -1), faces, canonical)
    return read[..., :3] * (1 + read[..., 3:] * (canonical.shade - 1))


def _at_gaussians(
    of_vertices: Float[Tensor, "*B V D"], faces: Int[Tensor, "F 3"], canonical: CanonicalGaussians
) -> Float[Tensor, "*B N D"]:
    if of_vertices.ndim == 2:
        return vertex_to_gaussians(of_vertices, faces, canonical)
    of_poses = vertex_to_gaussians(of_vertices.movedim(0, 1).flatten(1), faces, canonical)
    return of_poses.unflatten(1, (-1, of_vertices.shape[-1])).movedim(1, 0)


def in_even_light(canonical: CanonicalGaussians, light: HandLight) -> CanonicalGaussians:
    """The same without light that depends on the direction."""
    return canonical._replace(colors=(canonical.colors * light.even.pow(1 / GAMMA)).clamp(0, 1), shade=None)


def with_shade_baked(canonical: CanonicalGaussians) -> CanonicalGaussians:
    """The same with shade for colour: what the photo shows, without its light."""
    if canonical.shade is None:
        return canonical
    return canonical._replace(colors=canonical.colors * canonical.shade, shade=None)


def split_shade(
    shown: Float[Tensor, "M 3"], shade: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Colours and shade that come to `shown` together; where colours would end at 1, with more shade than `shade`."""
    colors = (shown / shade).clamp(MIN_COLOR, 1)
    return colors, shown.clamp_min(MIN_COLOR) / colors


def with_photo_colors(
    canonical: CanonicalGaussians, changed: Bool[Tensor, "N"], shown: Float[Tensor, "M 3"]
) -> CanonicalGaussians:
    """The same with other looks of some Gaussians in the photo, in the shade that they have there."""
    if canonical.shade is None:
        return canonical._replace(colors=canonical.colors.masked_scatter(changed[:, None], shown))
    colors, shade = split_shade(shown, canonical.shade[changed])
    return canonical._replace(
        colors=canonical.colors.masked_scatter(changed[:, None], colors),
        shade=canonical.shade.masked_scatter(changed[:, None], shade),
    )


def posed_normals(
    rest: Float[Tensor, "V 3"], posed: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """The normals of the rest surface, turned as Gaussians are."""
    turned = face_rotations(rest, posed, faces, validate=False)
    return rotation.rotate(turned.vertex_quats, surface.vertex_normals(rest, faces))


def turn_light(light: HandLight, rotation: Float[Tensor, "3 3"]) -> HandLight:
    """The same light in a world that `rotation` leads to."""
    facing = None if light.facing is None else light.facing @ rotation.T
    return light._replace(harmonics=torch.cat([light.harmonics[:1], rotation @ light.harmonics[1:]]), facing=facing)


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
        colors = (colors * shading_factors(canonical, faces, source, directions)).clamp(0, 1)
    return Gaussians(means, quats, scales, canonical.opacities, colors)
