"""Canonical Gaussians in a pose and in a light; no network, no image."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import gaussian_corners
from oasis_warp.avatar.creases import Creases, flat_creases
from oasis_warp.avatar.folds import Opening
from oasis_warp.avatar.sky import arriving, arriving_before, exposure, harmonic_basis, in_crevices, largest_nearby
from oasis_warp.core import rotation, surface
from oasis_warp.core.mirror import mirror_light, mirror_points
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandLight
from oasis_warp.ops import RestMesh, face_rotations, pose_mesh_gaussians
from oasis_warp.ops.corner_reading import Corners, read_corners
from oasis_warp.ops.sky_exposure import sky_directions

GAMMA = 2.2
"""Light is sRGB to this power, nearly."""
AS_IN_PHOTO, TURNED_AWAY = math.cos(math.radians(5)), math.cos(math.radians(20))
"""Cosines of the angle by which skin has turned from where the photo shows it, up to which its shade stays as it is and
from which it is gone."""
SAME_POSE, OTHER_POSE = 0.9, 0.5
"""Shares of the hand that face as in the photo, from which deep shade and that of the light stay, and up to which they
are gone on all of it: a palm that kept them beside fingers that did not had two tones. The named poses have .3 to .7 on
ten photos of same_hand, those that are nearly the photo's pose .65 to .7."""
SAME_SKY, OTHER_SKY = 0.08, 0.25
"""How much more of the sky skin sees than in the photo, up to which its shade stays and from which it is gone: what
cast it has moved. Where it sees less, nothing that was there has gone, and palm lines stay in a fist. Buffers of 3 mm
err by .05; a finger that lies on the palm hides .5 and more."""
SAME_BESIDE, OTHER_BESIDE = 0.02, 0.08
"""The same where the photo may show another part of the hand: what it showed there goes as soon as that part moves.
Set by eye on the print of a finger tip, half straightened, in one photo of tests/data/photos/same_hand."""
SAME_VIEW, OTHER_VIEW = math.cos(math.radians(10)), math.cos(math.radians(35))
"""Cosines of the angle between the directions from which photo and picture see the hand, up to which shade stays and
from which it is gone: seen from another side, what a photo shows on a slant, in gloss or a pixel off is a stain. Chosen
on 24 hands of same_hand from 45 degrees on, as docs/looks.md says."""
WEAK, DEEP = 0.3, 0.6
"""Differences of shade from 1 up to which it is relief or tone of the skin itself, and from which it is a sharp shadow,
gloss, or another part of the hand. Set by eye on one thumb-up photo with gashes, creases and a red spot."""
MAX_DETAIL = 0.3
"""Difference of the logarithms of colours up to which detail is skin where it goes against the shade: bright beside a
shadow that is a pixel off, skin would be white where that shadow goes."""
MOST_DETAIL = 0.5
"""Largest difference of the logarithms of colours by which detail changes the skin. Gaussians finer than the photo's
shadows overshoot where a shadow ends: one spot of skin was black. The rest is shade of the photo."""
MIN_LIGHT = 1e-6
"""Least share of the light that shade makes up for: deep in a fist hardly any arrives."""
MIN_COLOR = 1e-3
"""Least colour that has shade: it is a factor."""


class SurfaceLight(NamedTuple):
    """A light, and the properties of the lit surface that do not depend on the pose."""

    light: HandLight
    normals: Float[Tensor, "V 3"]
    """Unit normals of the surface at rest."""
    seen: Float[Tensor, "V"] | None = None
    """Share of the sky that each vertex saw in the photo; None where no shade depends on it."""
    photo_view: Float[Tensor, "3"] | None = None
    """Unit direction from the middle of the hand to the photo's camera; None where the view changes no colour."""
    corners: Corners | None = None
    """Of the surface's Gaussians, if they are known."""


class Lighting(NamedTuple):
    """Normals and sky exposure of the vertices of posed surfaces."""

    normals: Float[Tensor, "*B V 3"]
    """Unit, in the world of the photo's camera."""
    exposure: Float[Tensor, "*B V 4"] | None
    """As `sky.exposure`; None where the hand hides nothing of the light."""
    closeness: Float[Tensor, "*B V"] | None = None
    """Of each vertex to other skin, 0 to 1; None where none is near."""


def mirror_surface_light(light: SurfaceLight) -> SurfaceLight:
    """The same in the mirrored world."""
    view = None if light.photo_view is None else mirror_points(light.photo_view)
    return light._replace(light=mirror_light(light.light), normals=mirror_points(light.normals), photo_view=view)


def posed_lighting(
    rest: Float[Tensor, "V 3"], posed: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], light: HandLight
) -> Lighting:
    """`Lighting` of a posed surface in `light`; its normals are those at rest, rotated as Gaussians are."""
    vertex_quats = face_rotations(rest, posed, faces, validate=False).vertex_quats
    return lighting(posed, vertex_quats, surface.vertex_normals(rest, faces), light)


def lighting(
    posed: Float[Tensor, "*B V 3"],
    quats: Float[Tensor, "*B V 4"],
    normals: Float[Tensor, "V 3"],
    light: HandLight,
    closeness: Float[Tensor, "*B V"] | None = None,
) -> Lighting:
    """The same for vertices rotated by `quats`; exposure is a constant to derivatives."""
    facing = rotation.rotate(quats, normals.expand_as(posed))
    return Lighting(facing, None if light.albedo is None else exposure(posed, facing, quats, light), closeness)


def with_photo(
    light: HandLight,
    rest: Float[Tensor, "V 3"],
    photo: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    center: Float[Tensor, "3"] | None = None,
) -> SurfaceLight:
    """`light` on a surface, given its vertices at rest and in the photo that the light's shade is of.

    With the `center` of the photo's camera, for pictures from other sides.
    """
    view = None if center is None or light.facing is None else view_direction(photo, center)
    seen = None if light.shade is None else posed_lighting(rest, photo, faces, light).exposure
    return SurfaceLight(light, surface.vertex_normals(rest, faces), None if seen is None else seen[..., 0], view)


def view_direction(vertices: Float[Tensor, "*B V 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "*B 3"]:
    """Unit direction from the middle of the posed hand to a camera at `center`."""
    return torch.nn.functional.normalize(center - vertices.mean(-2), dim=-1)


def view_share(photo_view: Float[Tensor, "3"], view: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Share of the photo's shade that stays in a picture of the hand from this direction."""
    return (((photo_view * view).sum(-1) - OTHER_VIEW) / (SAME_VIEW - OTHER_VIEW)).clamp(0, 1)


def with_todays_light(
    version: int,
    light: HandLight,
    albedo: Float[Tensor, "3"],
    rest: Float[Tensor, "V 3"],
    photo: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
) -> HandLight:
    """Convert the light of a file of an older version to today's rules of what the hand hides.

    The photo's own view stays as it is: there the shade makes up for the difference. Elsewhere the shade goes.
    """
    hidden = light._replace(albedo=albedo)
    on = posed_lighting(rest, photo, faces, hidden)
    assert on.exposure is not None, "there is an albedo"
    arrived = arriving_before(version, on.exposure[..., 1:], albedo).clamp_min(MIN_LIGHT)
    factor = (arrived / arriving(on.exposure[..., 1:], albedo)).pow(1 / GAMMA)
    shade = factor if light.shade is None else light.shade * factor
    return hidden._replace(shade=shade, facing=on.normals if light.facing is None else light.facing)


def shading(light: HandLight, on: Lighting) -> Float[Tensor, "*B V 3"]:
    """Factor of the sRGB colours of vertices, without any shade."""
    received = harmonic_basis(on.normals, len(light.harmonics)) @ light.harmonics
    least, most = light.limits.unbind(0)
    received = torch.minimum(torch.maximum(received, least), most)
    if on.exposure is not None and light.albedo is not None:
        received = received * arriving(on.exposure[..., 1:], light.albedo)
        if on.closeness is not None:
            received = received * in_crevices(on.closeness, on.exposure)
    return received.pow(1 / GAMMA)


def remaining_shade(light: HandLight, on: Lighting, seen: Float[Tensor, "V"] | None) -> Float[Tensor, "*B V 2"]:
    """Shares of deep and of weak shade that stay on vertices which saw this share of the sky in the photo.

    For deep shade the change of the sky is the largest one nearby. Beside the outline of a finger the palm behind sees
    most of the sky, with the finger or without; what is much darker or brighter there is the finger or its shadow.
    Where the photo is in doubt, weak shade may be the finger, too. Deep shade also ends with the photo's pose, on all
    of the hand at once.
    """
    assert light.facing is not None, "comes with any shade"
    cosine = (on.normals * light.facing).sum(-1, keepdim=True)
    stays = ((cosine - TURNED_AWAY) / (AS_IN_PHOTO - TURNED_AWAY)).clamp(0, 1)
    held = ((stays.mean(-2, keepdim=True) - OTHER_POSE) / (SAME_POSE - OTHER_POSE)).clamp(0, 1)
    if on.exposure is None or seen is None:
        return torch.cat([stays * held, stays], -1)
    change = (on.exposure[..., 0] - seen).clamp_min(0)
    nearby = largest_nearby(change)
    doubt = torch.zeros_like(change) if light.doubt is None else light.doubt
    change = torch.stack([nearby, torch.lerp(change, nearby, doubt)], -1)
    same, other = SAME_SKY + (SAME_BESIDE - SAME_SKY) * doubt, OTHER_SKY + (OTHER_BESIDE - OTHER_SKY) * doubt
    left = ((other[..., None] - change) / (other - same)[..., None]).clamp(0, 1)
    return torch.cat([stays * held, stays], -1) * left


def shading_factors(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    light: HandLight,
    on: Lighting,
    seen: Float[Tensor, "V"] | None = None,
    viewed: Float[Tensor, "*B"] | None = None,
    opening: Opening | None = None,
    corners: Corners | None = None,
) -> Float[Tensor, "*B N 3"]:
    """Factors by which `light`, and the `opening` of folds, multiply the colours of Gaussians.

    Without `seen` those in the photo itself; `viewed` is the `view_share`, 1 if not given. Painted folds are as in
    the photo as far as its weak shade stays. The `corners` are those of all Gaussians, found if not given.
    """
    if corners is None:
        corners = gaussian_corners(faces, canonical)
    of_vertices = shading(light, on)
    if light.facing is None:
        return _opened(read_corners(of_vertices, corners), opening)
    stays = remaining_shade(light, on, seen)
    if viewed is not None:
        stays = stays * viewed[..., None, None]
    if light.shade is not None:  # all of it is smooth, or of pixels beside outlines
        of_vertices = of_vertices * (1 + stays[..., :1] * (light.shade - 1))
    if canonical.shade is None and opening is None:
        return read_corners(of_vertices, corners)
    read = read_corners(torch.cat([of_vertices, stays], -1), corners)
    of_deep, of_weak = read[..., 3:4], read[..., 4:]
    factors = _opened(read[..., :3], opening, of_weak)
    if canonical.shade is None:
        return factors
    if opening is not None:
        of_weak = of_weak.index_copy(-2, opening.index, of_weak.index_select(-2, opening.index) * (1 - opening.share))
    beyond = canonical.shade - 1
    deep = ((beyond.abs().amax(-1, keepdim=True) - WEAK) / (DEEP - WEAK)).clamp(0, 1)
    return factors * (1 + torch.lerp(of_weak, of_deep, deep) * beyond)


def _opened(
    factors: Float[Tensor, "*B N 3"], opening: Opening | None, stays: Float[Tensor, "*B N 1"] | None = None
) -> Float[Tensor, "*B N 3"]:
    if opening is None:
        return factors
    gone = 1 if stays is None else 1 - stays.index_select(-2, opening.index)
    return _times_exp(factors, opening.index, opening.logs + opening.painted * gone)


def _times_exp(
    factors: Float[Tensor, "*B N 3"], index: Int[Tensor, "M"], logs: Float[Tensor, "*B M 3"]
) -> Float[Tensor, "*B N 3"]:
    return factors.index_copy(-2, index, factors.index_select(-2, index) * logs.exp())


def in_even_light(canonical: CanonicalGaussians, light: HandLight) -> CanonicalGaussians:
    """The same without light that depends on the direction."""
    return canonical._replace(colors=(canonical.colors * light.even.pow(1 / GAMMA)).clamp(0, 1), shade=None)


def with_shade_baked(canonical: CanonicalGaussians) -> CanonicalGaussians:
    """The same with shade multiplied into the colours: what the photo shows, without its light."""
    if canonical.shade is None:
        return canonical
    return canonical._replace(colors=canonical.colors * canonical.shade, shade=None)


def split_shade(
    shown: Float[Tensor, "M 3"], shade: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Colours and shade whose product is `shown`; where a colour would end at 1, the shade exceeds `shade`."""
    shown = shown.clamp_min(MIN_COLOR)
    colors = (shown / shade).clamp(MIN_COLOR, 1)
    return colors, shown / colors


def with_photo_colors(
    canonical: CanonicalGaussians,
    changed: Bool[Tensor, "N"],
    shown: Float[Tensor, "M 3"],
    trust: Float[Tensor, "M 1"] | None = None,
) -> CanonicalGaussians:
    """The same, with the colours that the photo shows of some Gaussians, in the shade that these have.

    A share `trust` of the change becomes colour, all of it if not given; the rest becomes shade. With `trust`, a change
    that only undoes the present shade does not become colour either, nor does more than `MOST_DETAIL`.
    """
    if canonical.shade is None:
        return canonical._replace(colors=canonical.colors.masked_scatter(changed[:, None], shown))
    shade = canonical.shade[changed]
    if trust is not None:
        news = (shown.clamp_min(MIN_COLOR) / (canonical.colors[changed] * shade).clamp_min(MIN_COLOR)).log()
        most = -shade.log()
        back = (news - news.clamp(-MAX_DETAIL, MAX_DETAIL)).clamp(most.clamp(max=0), most.clamp(min=0))
        shade = shade * (news - (trust * (news - back)).clamp(-MOST_DETAIL, MOST_DETAIL)).exp()
    colors, shade = split_shade(shown, shade)
    return canonical._replace(
        colors=canonical.colors.masked_scatter(changed[:, None], colors),
        shade=canonical.shade.masked_scatter(changed[:, None], shade),
    )


def rotate_light(light: HandLight, rotation: Float[Tensor, "3 3"]) -> HandLight:
    """The same light after the world is rotated by `rotation`."""
    facing = None if light.facing is None else light.facing @ rotation.T
    directions = sky_directions(rotation.device).directions.to(light.harmonics)
    before, after = (harmonic_basis(d, len(light.harmonics)) for d in (directions, directions @ rotation.T))
    return light._replace(harmonics=torch.linalg.lstsq(after, before @ light.harmonics).solution, facing=facing)


def pose_gaussians(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    rest_vertices: Float[Tensor, "V 3"] | RestMesh,
    posed_vertices: Float[Tensor, "*B V 3"],
    light: SurfaceLight | None = None,
    center: Float[Tensor, "3"] | None = None,
    opening: Opening | None = None,
    closeness: Float[Tensor, "*B V"] | None = None,
    creases: Creases | None = None,
) -> Gaussians:
    """Gaussians that follow the surface from `rest_vertices` to `posed_vertices` (the paper's appendix B.1).

    Face Gaussians keep their barycentrics, rotate by the blended rotation of the face's corners and grow with the root
    of the face's area. Vertex Gaussians rotate with their vertex and grow with the faces around it together. None gets
    smaller than at rest, unlike in the paper: skin is pressed together in one direction, and gaps would open in the
    other. Values are not checked here: the caller has checked the pose. A surface that is posed many times is given as
    its `rest_mesh`. If `posed_vertices` have a leading axis of poses, so have means, quats and scales. With a `light`,
    so have the colours: they are drawn in it, without the part that the posed surface hides. With the `center` of a
    camera, shade fades as that camera leaves the side of the photo; without, it is as the photo's camera saw it. With
    an `opening`, folds over bent joints are open in that light. With the `closeness` of the `posed_vertices` to other
    skin, little light comes between fingers that touch. With `creases`, those in stretched skin are flat.
    """
    means, quats, scales, vertex_quats = pose_mesh_gaussians(
        rest_vertices, posed_vertices, faces, canonical.face_index, canonical.barycentrics, canonical.vertex_index,
        canonical.offsets, canonical.quats, canonical.scales, with_vertex_quats=light is not None,
    )  # fmt: skip
    scales = torch.maximum(scales, canonical.scales)
    colors = canonical.colors
    if light is not None and vertex_quats is not None:
        on = lighting(posed_vertices, vertex_quats, light.normals, light.light, closeness)
        viewed = None
        if center is not None and light.photo_view is not None:
            viewed = view_share(light.photo_view, view_direction(posed_vertices, center))
        factors = shading_factors(canonical, faces, light.light, on, light.seen, viewed, opening, light.corners)
        if creases is not None:
            factors = _times_exp(factors, creases.index, flat_creases(creases, posed_vertices))
        colors = (colors * factors).clamp(0, 1)
    return Gaussians(means, quats, scales, canonical.opacities, colors)
