"""The light that posed vertices receive, and what stays on them of the photo's shade."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar import sky
from oasis_warp.avatar.sky import arriving, arriving_before, exposure, harmonic_basis, in_crevices, largest_nearby
from oasis_warp.core import rotation, surface
from oasis_warp.core.mirror import mirror_light, mirror_points
from oasis_warp.core.types import HandLight
from oasis_warp.ops import face_rotations
from oasis_warp.ops.corner_reading import Corners
from oasis_warp.ops.sky_exposure import sky_directions
from oasis_warp.ops.vertex_light import Coarse, InPhoto, Rules, light_vertices

GAMMA = 2.2
"""Light is sRGB to this power, nearly."""
WEAK, DEEP = 0.3, 0.6
"""Differences of shade from 1 up to which it is relief or tone of the skin itself, and from which it is a sharp shadow,
gloss, or another part of the hand. Set by eye on one thumb-up photo with gashes, creases and a red spot."""
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
HALF_HAND, SAME_PARALLAX, OTHER_PARALLAX = 0.08, math.radians(2), math.radians(7)
"""Half the width of a hand [m]; angles by which picture and photo see its halves from another side, up to which the
Gaussians' shade stays and from which it is gone where the photo may show another part of the hand: beside outlines the
fit is off by some pixels, and what lay behind a thumb had the thumb's edge. Set by eye on 4 hands of docs/looks.md."""
NEAREST = 1e-4
"""Least distance of a camera from the middle of the hand, of which a direction is taken [m]."""
MIN_LIGHT = 1e-6
"""Least share of the light that shade makes up for: deep in a fist hardly any arrives."""
_RULES = Rules(
    GAMMA, sky.LEAST_LIGHT, sky.IN_HOLLOWS, sky.IN_CREVICES, sky.DEEP_INSIDE, sky.OUTSIDE, TURNED_AWAY, AS_IN_PHOTO,
    OTHER_POSE, SAME_POSE, SAME_SKY, OTHER_SKY, SAME_BESIDE, OTHER_BESIDE, WEAK, DEEP,
)  # fmt: skip


class SurfaceLight(NamedTuple):
    """A light, and the properties of the lit surface that do not depend on the pose."""

    light: HandLight
    normals: Float[Tensor, "V 3"]
    """Unit normals of the surface at rest."""
    seen: Float[Tensor, "V"] | None = None
    """Share of the sky that each vertex saw in the photo; None where no shade depends on it."""
    photo_eye: Float[Tensor, "3"] | None = None
    """From the middle of the hand to the photo's camera [m]; None where the view changes no colour."""
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
    eye = None if light.photo_eye is None else mirror_points(light.photo_eye)
    return light._replace(light=mirror_light(light.light), normals=mirror_points(light.normals), photo_eye=eye)


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
    eye = None if center is None or light.facing is None else offset_to_camera(photo, center)
    seen = None if light.shade is None else posed_lighting(rest, photo, faces, light).exposure
    return SurfaceLight(light, surface.vertex_normals(rest, faces), None if seen is None else seen[..., 0], eye)


def offset_to_camera(vertices: Float[Tensor, "*B V 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "*B 3"]:
    """From the middle of the posed hand to a camera at `center`."""
    return center - vertices.mean(-2)


def view_shares(photo_eye: Float[Tensor, "3"], eye: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 2"]:
    """Shares of the photo's shade that stay in a picture of the hand from there: anywhere, and where it is in doubt.

    Where it is in doubt, a camera that is nearer than the photo's is elsewhere, too.
    """
    nearness = [1 / place.norm(dim=-1, keepdim=True).clamp_min(NEAREST) for place in (photo_eye, eye)]
    before, now = (place * near for place, near in zip((photo_eye, eye), nearness, strict=True))
    turned = (before - now).square().sum(-1) + (HALF_HAND * (nearness[0] - nearness[1])).square()[..., 0]
    wide = ((before * now).sum(-1) - OTHER_VIEW) / (SAME_VIEW - OTHER_VIEW)
    close = (OTHER_PARALLAX**2 - turned) / (OTHER_PARALLAX**2 - SAME_PARALLAX**2)
    return torch.stack([wide, close], -1).clamp(0, 1)


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


def vertex_light(
    light: HandLight, on: Lighting, seen: Float[Tensor, "V"] | None = None, viewed: Float[Tensor, "*B 2"] | None = None
) -> Float[Tensor, "*B V 5"]:
    """`vertex_light_in_steps`, in one kernel where no gradient is asked."""
    if kernels_can_run(on.normals, viewed, *light):
        return _vertex_light_at_once(light, on, seen, viewed)
    return vertex_light_in_steps(light, on, seen, viewed)


def kernels_can_run(*tensors: Tensor | None) -> bool:
    """Whether the kernels of light take these: they are float32, and have no gradients."""
    given = [tensor for tensor in tensors if tensor is not None]
    asked = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given)
    return not asked and all(tensor.dtype == torch.float32 for tensor in given)


def vertex_light_in_steps(
    light: HandLight, on: Lighting, seen: Float[Tensor, "V"] | None = None, viewed: Float[Tensor, "*B 2"] | None = None
) -> Float[Tensor, "*B V 5"]:
    """Factors of the sRGB colours of vertices, then the shares of deep and of weak shade that stay, 0 without any.

    `shading`, with the shade of the light, which is smooth; then `remaining_shade` times the first of `view_shares`,
    and where the photo is in doubt times the second. Where the shade of the light is deep, weak shade goes with it: in
    a shadow photos show little but noise, which was a bright scab without the shadow.
    """
    of_vertices = shading(light, on)
    if light.facing is None:
        return torch.cat([of_vertices, torch.zeros_like(of_vertices[..., :2])], -1)
    stays = remaining_shade(light, on, seen)
    if viewed is not None:
        stays = stays * viewed[..., None, :1]
    if light.shade is not None:
        of_vertices = of_vertices * (1 + stays[..., :1] * (light.shade - 1))
        deep, weak = stays.split(1, -1)
        of_deep = (((light.shade - 1).abs().amax(-1, keepdim=True) - WEAK) / (DEEP - WEAK)).clamp(0, 1)
        stays = torch.cat([deep, torch.lerp(weak, torch.minimum(weak, deep), of_deep)], -1)
    if viewed is not None and light.doubt is not None:
        stays = stays * (1 - light.doubt[:, None] * (1 - viewed[..., None, 1:]))
    return torch.cat([of_vertices, stays], -1)


def _vertex_light_at_once(
    light: HandLight, on: Lighting, seen: Float[Tensor, "V"] | None, viewed: Float[Tensor, "*B 2"] | None
) -> Float[Tensor, "*B V 5"]:
    batch, mesh = on.normals.shape[:-2], sky.sky_mesh(on.normals.device)
    in_sky = on.exposure is not None and light.albedo is not None

    def flat(values: Tensor | None) -> Tensor | None:
        return None if values is None or not in_sky else values.reshape(-1, *values.shape[len(batch) :])

    photo = None
    if light.facing is not None:
        photo = InPhoto(light.facing, light.shade, light.doubt, seen if in_sky else None)
    found = light_vertices(
        on.normals.reshape(-1, *on.normals.shape[-2:]), light.harmonics, light.limits, _RULES,
        Coarse(mesh.vertices, mesh.nearby, mesh.corners), flat(on.exposure), light.albedo, flat(on.closeness), photo,
        None if viewed is None else viewed.expand(*batch, 2).reshape(-1, 2),
    )  # fmt: skip
    return found.view(*batch, *found.shape[1:])


def rotate_light(light: HandLight, rotation: Float[Tensor, "3 3"]) -> HandLight:
    """The same light after the world is rotated by `rotation`."""
    facing = None if light.facing is None else light.facing @ rotation.T
    directions = sky_directions(rotation.device).directions.to(light.harmonics)
    before, after = (harmonic_basis(d, len(light.harmonics)) for d in (directions, directions @ rotation.T))
    return light._replace(harmonics=torch.linalg.lstsq(after, before @ light.harmonics).solution, facing=facing)
