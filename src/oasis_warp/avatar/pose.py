"""Canonical Gaussians in a pose and in a light; no network, no image."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.avatar.anchors import gaussian_corners
from oasis_warp.avatar.creases import Creases, crease_logs, stretched_share
from oasis_warp.avatar.folds import Folds, Opening, open_folds, opened_by_joints
from oasis_warp.avatar.vertex_light import (
    DEEP,
    GAMMA,
    WEAK,
    Lighting,
    SurfaceLight,
    kernels_can_run,
    lighting,
    offset_to_camera,
    vertex_light,
    view_shares,
)
from oasis_warp.core.types import CanonicalGaussians, Gaussians, HandLight
from oasis_warp.ops import RestMesh, pose_mesh_gaussians
from oasis_warp.ops.corner_reading import Corners, read_corners
from oasis_warp.ops.gaussian_light import OpenFolds, StretchedSkin, light_gaussians

MAX_DETAIL = 0.3
"""Difference of the logarithms of colours up to which detail is skin where it goes against the shade: bright beside a
shadow that is a pixel off, skin would be white where that shadow goes."""
MOST_DETAIL = 0.5
"""Largest difference of the logarithms of colours by which detail changes the skin. Gaussians finer than the photo's
shadows overshoot where a shadow ends: one spot of skin was black. The rest is shade of the photo."""
IN_SHADOW = 0.5, 0.8
"""How dark shade is, as the mean of logarithms, from which less detail in it is skin, and from which none is. It was
orange flecks on one back, in a shadow in which the camera had lost the blue."""
AROUND_LIMITS = 0.05, 10.0
"""Least and most of a light from all around, over its mean: nine harmonics of a small lamp fall below 0 behind it."""
MIN_COLOR = 1e-3
"""Least colour that has shade: it is a factor."""


class Bend(NamedTuple):
    """What bent joints, stretched and compressed skin change in the colours of an avatar's Gaussians."""

    folds: Folds
    angles: Float[Tensor, "*B J 3"]
    """Of the joints [rad]."""
    creases: Creases


def shading_factors(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    light: HandLight,
    on: Lighting,
    seen: Float[Tensor, "V"] | None = None,
) -> Float[Tensor, "*B N 3"]:
    """Factors by which `light` multiplies the colours of Gaussians; without `seen` those in the photo itself."""
    return _factors(canonical, vertex_light(light, on, seen), gaussian_corners(faces, canonical))


def _factors(
    canonical: CanonicalGaussians,
    of_vertices: Float[Tensor, "*B V 5"],
    corners: Corners,
    opening: Opening | None = None,
) -> Float[Tensor, "*B N 3"]:
    """The same, given the `vertex_light`, and what an `opening` of folds multiplies."""
    if canonical.shade is None and opening is None:
        return read_corners(of_vertices[..., :3], corners)
    read = read_corners(of_vertices, corners)
    factors, of_deep, of_weak = read.split([3, 1, 1], -1)
    if opening is not None:  # painted folds are as in the photo as far as its weak shade stays
        gone = 1 - of_weak.index_select(-2, opening.index)
        factors = _times_exp(factors, opening.index, opening.logs + opening.painted * gone)
    if canonical.shade is None:
        return factors
    if opening is not None:
        of_weak = of_weak.index_copy(-2, opening.index, of_weak.index_select(-2, opening.index) * (1 - opening.share))
    beyond = canonical.shade - 1
    deep = ((beyond.abs().amax(-1, keepdim=True) - WEAK) / (DEEP - WEAK)).clamp(0, 1)
    return factors * (1 + torch.lerp(of_weak, of_deep, deep) * beyond)


def _times_exp(
    factors: Float[Tensor, "*B N 3"], index: Int[Tensor, "M"], logs: Float[Tensor, "*B M 3"]
) -> Float[Tensor, "*B N 3"]:
    return factors.index_copy(-2, index, factors.index_select(-2, index) * logs.exp())


def lit_in_steps(
    canonical: CanonicalGaussians,
    of_vertices: Float[Tensor, "*B V 5"],
    corners: Corners,
    bend: Bend | None,
    posed: Float[Tensor, "*B V 3"],
) -> Float[Tensor, "*B N 3"]:
    """The colours of Gaussians under the `vertex_light` of the vertices around them, their `corners`.

    In a `bend`, folds over bent joints are open, creases in stretched skin of the `posed` surface are flat, and
    compressed skin has wrinkles.
    """
    opening = None if bend is None else open_folds(bend.folds, bend.angles)
    factors = _factors(canonical, of_vertices, corners, opening)
    if bend is not None:
        factors = _times_exp(factors, bend.creases.index, crease_logs(bend.creases, posed))
    return (canonical.colors * factors).clamp(0, 1)


def lit(
    canonical: CanonicalGaussians, of_vertices: Float[Tensor, "*B V 5"], corners: Corners, bend: Bend | None,
    posed: Float[Tensor, "*B V 3"],
) -> Float[Tensor, "*B N 3"]:  # fmt: skip
    """`lit_in_steps`, in one kernel where no gradient is asked."""
    angles = None if bend is None else bend.angles
    if not kernels_can_run(of_vertices, canonical.colors, canonical.shade, angles):
        return lit_in_steps(canonical, of_vertices, corners, bend, posed)
    folds = creases = None
    if bend is not None:
        own, opened = bend.folds, opened_by_joints(bend.folds, bend.angles)
        opened = opened.reshape(-1, *opened.shape[-2:])
        folds = OpenFolds(own.row, opened, own.joints, own.between, own.painted, own.change)
        share = stretched_share(bend.creases, posed)
        share = share.reshape(-1, share.shape[-1])
        creases = StretchedSkin(bend.creases.row, share, bend.creases.change, bend.creases.wrinkles)
    found = light_gaussians(
        of_vertices.reshape(-1, *of_vertices.shape[-2:]), corners, canonical.colors, canonical.shade, (WEAK, DEEP),
        folds, creases,
    )  # fmt: skip
    return found.view(*of_vertices.shape[:-2], *found.shape[1:])


def in_even_light(canonical: CanonicalGaussians, light: HandLight) -> CanonicalGaussians:
    """The same without light that depends on the direction."""
    return canonical._replace(colors=(canonical.colors * light.even.pow(1 / GAMMA)).clamp(0, 1), shade=None)


def mean_albedo(canonical: CanonicalGaussians, light: HandLight | None) -> Float[Tensor, "3"]:
    """Reflectance from which light bounces: that of `light` if known, else the mean of the skin in its even light."""
    if light is not None and light.albedo is not None:
        return light.albedo
    level = canonical.colors.new_ones(3) if light is None else light.even
    return (canonical.colors.mean(0) ** GAMMA * level).clamp(0, 1)


def light_around(
    canonical: CanonicalGaussians, light: HandLight | None, harmonics: Float[Tensor, "9 3"]
) -> HandLight:
    """Another light for the same Gaussians, as bright on average as `light`, without any shade."""
    level = canonical.colors.new_ones(3) if light is None else light.even
    around = harmonics.to(level) * level.mean()
    limits = around[0].mean() * around.new_tensor(AROUND_LIMITS)[:, None].expand(2, 3)
    even = around[0].clamp_min(AROUND_LIMITS[0])
    return HandLight(around, limits.contiguous(), even, albedo=mean_albedo(canonical, light))


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
    that only undoes the present shade does not become colour either, nor does one in a shadow, nor more than
    `MOST_DETAIL`.
    """
    if canonical.shade is None:
        return canonical._replace(colors=canonical.colors.masked_scatter(changed[:, None], shown))
    shade = canonical.shade[changed]
    if trust is not None:
        news = (shown.clamp_min(MIN_COLOR) / (canonical.colors[changed] * shade).clamp_min(MIN_COLOR)).log()
        most = -shade.log()
        back = (news - news.clamp(-MAX_DETAIL, MAX_DETAIL)).clamp(most.clamp(max=0), most.clamp(min=0))
        light, dark = IN_SHADOW
        lit = ((shade.log().mean(1, keepdim=True) + dark) / (dark - light)).clamp(0, 1)
        shade = shade * (news - (lit * trust * (news - back)).clamp(-MOST_DETAIL, MOST_DETAIL)).exp()
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
    bend: Bend | None = None,
    closeness: Float[Tensor, "*B V"] | None = None,
) -> Gaussians:
    """Gaussians that follow the surface from `rest_vertices` to `posed_vertices` (the paper's appendix B.1).

    Face Gaussians keep their barycentrics, rotate by the blended rotation of the face's corners and grow with the root
    of the face's area. Vertex Gaussians rotate with their vertex and grow with the faces around it together. None gets
    smaller than at rest, unlike in the paper: skin is pressed together in one direction, and gaps would open in the
    other. Values are not checked here: the caller has checked the pose. A surface that is posed many times is given as
    its `rest_mesh`. If `posed_vertices` have a leading axis of poses, so have means, quats and scales. With a `light`,
    so have the colours: they are drawn in it, without the part that the posed surface hides. With the `center` of a
    camera, shade fades as that camera leaves the side of the photo; without, it is as some degrees beside the photo.
    With a `bend`, folds over bent joints are open in that light, creases in stretched skin flat, and compressed skin
    has wrinkles. With the `closeness` of the `posed_vertices` to other skin, little light comes between fingers that
    touch.
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
        if light.photo_eye is not None and center is not None:
            viewed = view_shares(light.photo_eye, offset_to_camera(posed_vertices, center))
        elif light.photo_eye is not None:
            beside = torch.eye(1, 2, dtype=means.dtype, device=means.device)[0]
            viewed = beside.expand(*posed_vertices.shape[:-2], 2)
        of_vertices = vertex_light(light.light, on, light.seen, viewed)
        corners = light.corners or gaussian_corners(faces, canonical)
        colors = lit(canonical, of_vertices, corners, bend, posed_vertices)
    return Gaussians(means, quats, scales, canonical.opacities, colors)
