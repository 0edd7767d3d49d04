"""Canonical Gaussians in a pose and in a light; no network, no image."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import gaussian_corners
from oasis_warp.avatar.creases import Creases, flat_creases
from oasis_warp.avatar.folds import Opening
from oasis_warp.avatar.vertex_light import (
    GAMMA,
    Lighting,
    SurfaceLight,
    lighting,
    vertex_light,
    view_direction,
    view_share,
)
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandLight
from oasis_warp.ops import RestMesh, pose_mesh_gaussians
from oasis_warp.ops.corner_reading import Corners, read_corners

WEAK, DEEP = 0.3, 0.6
"""Differences of shade from 1 up to which it is relief or tone of the skin itself, and from which it is a sharp shadow,
gloss, or another part of the hand. Set by eye on one thumb-up photo with gashes, creases and a red spot."""
MAX_DETAIL = 0.3
"""Difference of the logarithms of colours up to which detail is skin where it goes against the shade: bright beside a
shadow that is a pixel off, skin would be white where that shadow goes."""
MOST_DETAIL = 0.5
"""Largest difference of the logarithms of colours by which detail changes the skin. Gaussians finer than the photo's
shadows overshoot where a shadow ends: one spot of skin was black. The rest is shade of the photo."""
MIN_COLOR = 1e-3
"""Least colour that has shade: it is a factor."""


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
    of_vertices = vertex_light(light, on, seen, viewed)
    if light.facing is None:
        return _opened(read_corners(of_vertices, corners), opening)
    if canonical.shade is None and opening is None:
        return read_corners(of_vertices[..., :3], corners)
    read = read_corners(of_vertices, corners)
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
