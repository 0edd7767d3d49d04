"""Bring the detail of photos into an avatar: finer Gaussians where they show more than the ones there can."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from oasis_warp.adaptation.reprojection import (
    PHOTO_WEIGHT,
    Canvas,
    Source,
    TargetView,
    crop_to_points,
    fit_colors,
    map_surface,
    nearby_cameras,
    overlay_pictures,
    reproject,
    with_neighbours,
)
from oasis_warp.adaptation.unlit import MIN_ALPHA
from oasis_warp.avatar.anchors import RIM_FADE, vertex_to_gaussians
from oasis_warp.avatar.densify import FITTED, densify, parts_for_spacing
from oasis_warp.avatar.observation import faded_in
from oasis_warp.avatar.pose import pose_gaussians, shading_factors, with_photo_colors, with_shade_baked
from oasis_warp.avatar.vertex_light import Lighting, posed_lighting
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Camera, CanonicalGaussians, Gaussians, HandCrop, HandLight
from oasis_warp.ops import blend_colors
from oasis_warp.render import render, view_weights

FACING = 0.3, 0.5
"""Cosines between surface and view below which the photo's detail is left out, and above which it is taken whole."""
RIM = 1 / 256
"""Share of the photo's side, at the mask's border, that may hold background, and over which detail fades in."""
FADE_REACH = 1.25
"""Times the length of the fade at the wrist: nearer to its end faces stay as they are, since parts would not fade."""
TOLERANCE = 3 / 255
"""Colour difference, root mean square over 3 x 3 pixels, that nobody sees."""
SPACINGS = (4.0, 3.0, 2.0)
"""Distances between finer Gaussians to choose from [px]; at 1.5 and 1 they show no more."""
MIN_SHARE = 0.5
"""Least share of hand in a pixel that counts; only faces with such pixels are cut."""
THICKNESS = 0.45e-3
"""Standard deviation of finer Gaussians across the surface [m]. The surface that carries Gaussians lies below the skin,
which coarse ones reach because they are thick: with thin ones fingers lose half a millimetre. With .6 mm none is lost,
but outlines get rough."""
MIN_FACTOR = 0.02
"""Least factor of the light by which colours are divided."""
STEPS = 10
"""Steps of the colour fit. It starts at the colours of the photo; 40 steps give the same result."""
SHRUNK = 2
"""The pictures that are fitted are also fitted this many times smaller: from afar the rasterizer widens fine Gaussians,
and those in front would hide more of the others than they do from near."""


class SharpenResult(NamedTuple):
    """Gaussians with the photos' detail."""

    gaussians: CanonicalGaussians
    """Those that were not touched are the same bit for bit, in their order; the new ones are the last."""
    n_new: int
    losses: tuple[float, ...]
    """Mean squared colour difference over all views, of every step, photo after photo; none where nothing was
    missing."""


@torch.no_grad()
def sharpen(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    crops: Sequence[HandCrop],
    shares: Float[Tensor, "K V"] | None = None,
    trust: Float[Tensor, "K V"] | None = None,
    light: HandLight | None = None,
    progress: Progress = silent,
) -> SharpenResult:
    """Replace Gaussians by finer ones where pictures of the hand show more than they do.

    A face whose picture differs from the avatar's is cut into as many parts as it takes to show what is there. Faces
    around it are cut as well, so that finer Gaussians fade into coarser ones. The colours minimise the squared
    difference of pictures that are linear in them: a photo in its own view, and in four views beside it what the
    surface carries of all photos, in both sizes. Several photos are fitted one after the other, each with the colours
    that it shows best. At outlines, on a slant and where the wrist ends the avatar stays as it is.

    Args:
        hand: Model of the surface.
        gaussians: Fitted to the photos, perhaps in smaller pictures of them.
        crops: Crops of K photos, as large as their detail, with one surface at rest and in one light.
        shares: Share of each photo at each vertex, at most 1 in all; a single photo wholly.
        trust: How far what each shows is skin, 0 to 1, wholly if not given: the rest of the detail is shade, if there
            is any shade.
        light: Light of a single photo, which is then given as taken; without it, photos are in even light. A photo
            divided by a picture of its light would be wrong where a bright finger and a dark hollow share a pixel.
        progress: Called as work goes on.
    """
    rest = crops[0].rest.vertices
    faces = hand.faces.to(rest.device)
    shares = rest.new_ones(1, len(rest)) if shares is None else shares
    fading = torch.cdist(rest, rest[hand.rim.to(rest.device)]).amin(1) < FADE_REACH * RIM_FADE
    fading = with_neighbours(fading[faces].any(1), faces, len(rest))
    sources = [_source(e, faces, fading, own) for e, own in zip(crops, shares, strict=True)]
    on = None if light is None else posed_lighting(rest, sources[0].posed, faces, light)
    old = [pose_gaussians(lit_as_photo(gaussians, faces, light, on), faces, rest, source.posed) for source in sources]
    around, parts = _parts(rest, faces, sources, old)
    if not bool(around.any()):
        return SharpenResult(gaussians, 0, ())
    dense, changed, n_new = densify(gaussians, rest, faces, parts, FITTED._replace(thickness=THICKNESS))
    shown = lit_as_photo(dense, faces, light, on)
    new = [pose_gaussians(shown, faces, rest, source.posed) for source in sources]
    start = overlay_pictures(shown.colors[changed], sources, [there.means[changed] for there in new])
    colors = shown.colors.masked_scatter(changed[:, None], start)
    best = vertex_to_gaussians(shares.T, faces, dense).argmax(1)
    best_of_face = shares[:, faces].mean(-1).argmax(0)
    losses: list[float] = []
    for k in best[changed].unique().tolist():
        fitted = changed & (best == k)
        fixed = torch.where(fitted[:, None], 0, colors)
        points = sources[k].posed[faces[around & (best_of_face == k)]].flatten(0, 1)
        views = _views(sources, k, points, faces, old[k], new[k], fixed)
        learned, of_photo = fit_colors(views, colors[fitted], fitted, STEPS, progress)
        colors, losses = fixed.masked_scatter(fitted[:, None], learned), [*losses, *of_photo]
    if trust is not None:
        trust = vertex_to_gaussians(trust.T, faces, dense).gather(1, best[:, None])[changed]
    if light is not None and on is not None:
        colors = colors / shading_factors(dense._replace(shade=None), faces, light, on).clamp_min(MIN_FACTOR)
    return SharpenResult(with_photo_colors(dense, changed, colors[changed], trust), n_new, tuple(losses))


def _parts(
    rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], sources: Sequence[Source], old: Sequence[Gaussians]
) -> tuple[Bool[Tensor, "F"], Int[Tensor, "F"]]:
    """Faces to be cut, those whose pictures differ and those around them, and into how many parts each is."""
    spacing = torch.stack([
        _wanted_spacing(source, render(there, source.canvas.camera).image, faces)
        for source, there in zip(sources, old, strict=True)
    ]).amin(0)  # fmt: skip
    around = with_neighbours(spacing.isfinite(), faces, len(rest))
    # A face of one part would keep its vertices' Gaussians, which reach into the faces beside it.
    return around, torch.where(around, parts_for_spacing(rest, faces, spacing).clamp_min(2), 1)


def lit_as_photo(
    gaussians: CanonicalGaussians, faces: Int[Tensor, "F 3"], light: HandLight | None, on: Lighting | None
) -> CanonicalGaussians:
    """With the colours that photos show, in `light` if there is one."""
    if light is None or on is None:
        return with_shade_baked(gaussians)
    lit = (gaussians.colors * shading_factors(gaussians, faces, light, on)).clamp(0, 1)
    return gaussians._replace(colors=lit, shade=None)


def _source(
    crop: HandCrop, faces: Tensor, fading: Bool[Tensor, "F"], share: Float[Tensor, "V"]
) -> Source:
    """The photo on its surface, weighted by `share`, and by 0 on `fading` faces."""
    posed, canvas = crop.posed.vertices, Canvas(crop.image, faded_in(crop.mask, RIM), crop.camera)
    seen = map_surface(posed, faces, canvas, FACING)
    ids = seen.faces.clamp_min(0)
    trust = torch.where(fading[ids], 0, (share[faces[ids]] * seen.barycentrics).sum(-1))
    return Source(canvas, seen._replace(share=seen.share * trust), posed)


def _views(
    sources: Sequence[Source], k: int, points: Tensor, faces: Tensor, old: Gaussians, new: Gaussians, fixed: Tensor
) -> list[TargetView]:
    """Pictures of `points` in the pose of source k: in the photo's view and beside it, in both sizes."""
    camera, posed, views = sources[k].canvas.camera, sources[k].posed, []
    for other, weight in ((camera, PHOTO_WEIGHT), *((other, 1.0) for other in nearby_cameras(camera, points))):
        near = _divisible(crop_to_points(other, points, 1.0))
        image, alpha = render(old, near)
        alpha = alpha.clamp_min(MIN_ALPHA)[..., None]
        target = alpha * reproject(image / alpha, sources, posed, faces, near)
        small = _pooled(target) / _pooled(alpha)
        for goal, shown, scale in ((target / alpha, near, 1), (small, _smaller(near), SHRUNK)):
            weights = view_weights(new, shown)
            # Coverage is not to be fitted: in a small picture the rasterizer draws outlines wider.
            goal = goal * weights.alphas - blend_colors(weights, fixed)
            views.append(TargetView(weights, goal, weight * scale**2))
    return views


def _wanted_spacing(source: Source, drawn: Float[Tensor, "S S 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F"]:
    """Distance between Gaussians with which each face would show the picture [m]; infinite where it does already."""
    (image, _, camera), seen = source.canvas, source.seen

    def largest_error(error: Float[Tensor, "S S 3"]) -> Float[Tensor, "F"]:
        local = avg_pool2d((error.square().mean(-1) * seen.share)[None, None], 3, stride=1, padding=1)[0, 0].sqrt()
        counted = seen.share > MIN_SHARE
        values = torch.zeros(len(faces), dtype=local.dtype, device=local.device)
        return values.scatter_reduce_(0, seen.faces[counted], local[counted], "amax")

    spacing = torch.full((len(faces),), torch.inf, device=drawn.device)
    short = largest_error(drawn - image) > TOLERANCE
    for finer in SPACINGS:
        spacing = torch.where(short, finer, spacing)
        short = short & (largest_error(_sampled(image, finer) - image) > TOLERANCE)
    _, depth = project(camera, source.posed)
    return spacing * depth[faces].mean(1) / camera.K[0, 0]


def _sampled(image: Float[Tensor, "S S 3"], spacing: float) -> Float[Tensor, "S S 3"]:
    """What is left of a picture that is known every `spacing` pixels only."""
    planes = image.permute(2, 0, 1)[None]
    few = interpolate(planes, size=[round(n / spacing) for n in image.shape[:2]], mode="bilinear", antialias=True)
    return interpolate(few, size=list(image.shape[:2]), mode="bilinear")[0].permute(1, 2, 0)


def _divisible(camera: Camera) -> Camera:
    return camera._replace(width=camera.width // SHRUNK * SHRUNK, height=camera.height // SHRUNK * SHRUNK)


def _pooled(picture: Float[Tensor, "H W C"]) -> Float[Tensor, "h w C"]:
    return avg_pool2d(picture.permute(2, 0, 1)[None], SHRUNK)[0].permute(1, 2, 0).contiguous()


def _smaller(camera: Camera) -> Camera:
    K = camera.K.clone()
    K[:2] /= SHRUNK
    return Camera(camera.viewmat, K, camera.width // SHRUNK, camera.height // SHRUNK)
