"""Bring a photo's own detail into an avatar: finer Gaussians where it shows more than the ones there can."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from oasis_warp.avatar.anchors import RIM_FADE
from oasis_warp.avatar.densify import densify, parts_for_spacing
from oasis_warp.avatar.observe import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Camera, CanonicalGaussians, Evidence
from oasis_warp.ops import blend_colors
from oasis_warp.render.render import render
from oasis_warp.training.carried import (
    PHOTO_WEIGHT,
    Canvas,
    Seen,
    View,
    beside,
    carried,
    cut,
    fit_colors,
    look,
    read,
    with_neighbours,
)
from oasis_warp.training.views import freeze_view

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
"""Of a pixel that counts, from which its face may be cut."""
THICKNESS = 0.45e-3
"""Standard deviation of finer Gaussians across the surface [m]. The surface that carries Gaussians lies below the skin,
which coarse ones reach because they are thick: with thin ones fingers lose half a millimetre. With .6 mm none is lost,
but outlines get rough."""
MIN_ALPHA = 0.05
"""Below it a pixel says nothing about the colour of the hand."""
STEPS = 15
"""Of the colours' fit, which starts at the colours of the photo; 40 come to the same."""
SHRUNK = 2
"""The pictures that are fitted are also fitted this many times smaller: from afar the rasterizer widens fine Gaussians,
and those in front would hide more of the others than they do from near."""


class Sharpened(NamedTuple):
    """Gaussians with the photo's detail."""

    gaussians: CanonicalGaussians
    """Those that were not touched are the same bit for bit, in their order; the new ones are the last."""
    n_new: int
    losses: tuple[float, ...]
    """Mean squared colour difference over all views, of every step; none where nothing was missing."""


@torch.no_grad()
def sharpen(
    hand: HandModel, gaussians: CanonicalGaussians, evidence: Evidence, progress: Progress = silent
) -> Sharpened:
    """Replace Gaussians by finer ones where the picture of `evidence` shows more than they do.

    A face whose picture differs from the avatar's is cut into as many parts as it takes to show what is there; faces
    around it are cut as well, so that finer Gaussians fade into coarser ones. The colours minimise the squared
    difference of pictures that are linear in them: the photo in its own view, and what the surface carries of it in
    four views beside, in both sizes. At outlines, on a slant and where the wrist ends the avatar stays as it is.

    Args:
        hand: Whose surface it is.
        gaussians: Fitted to the photo, perhaps in a smaller picture of it.
        evidence: The photo, as large as its detail.
        progress: Called as work goes on.
    """
    rest, posed, camera = evidence.rest.vertices, evidence.posed.vertices, evidence.camera
    faces = hand.faces.to(posed.device)
    old = pose_gaussians(gaussians, faces, rest, posed)
    canvas = Canvas(evidence.image, _faded_in(evidence.mask), camera)
    seen = look(posed, faces, canvas, FACING)
    fading = torch.cdist(rest, rest[hand.rim.to(rest.device)]).amin(1) < FADE_REACH * RIM_FADE
    fading = with_neighbours(fading[faces].any(1), faces, len(rest))
    seen = seen._replace(share=torch.where(fading[seen.faces.clamp_min(0)], 0, seen.share))
    spacing = _wanted_spacing(canvas, seen, render(old, camera).image, len(faces))
    missing = spacing.isfinite()
    if not bool(missing.any()):
        return Sharpened(gaussians, 0, ())
    around = with_neighbours(missing, faces, len(rest))
    _, depth = project(camera, posed)
    pixel = depth[faces].mean(1) / camera.K[0, 0]
    # A face of one part would keep its vertices' Gaussians, which reach into the faces beside it.
    parts = torch.where(around, parts_for_spacing(rest, faces, spacing * pixel).clamp_min(2), 1)
    dense, changed, n_new = densify(gaussians, rest, faces, parts, thickness=THICKNESS)
    new = pose_gaussians(dense, faces, rest, posed)
    share, color = read(canvas, seen, new.means[changed])
    start = torch.lerp(dense.colors[changed], color, share[:, None])
    still = torch.where(changed[:, None], 0, dense.colors)
    points, views = posed[faces[around]].flatten(0, 1), []
    for other, weight in ((camera, PHOTO_WEIGHT), *((other, 1.0) for other in beside(camera, points))):
        near = _divisible(cut(other, points, 1.0))
        image, alpha = render(old, near)
        alpha = alpha.clamp_min(MIN_ALPHA)[..., None]
        target = alpha * carried(image / alpha, canvas, seen, posed, faces, near)
        small = _pooled(target) / _pooled(alpha)
        for goal, shown, scale in ((target / alpha, near, 1), (small, _smaller(near), SHRUNK)):
            weights = freeze_view(new, shown)
            # Coverage is not to be fitted: in a small picture the rasterizer draws outlines wider.
            goal = goal * weights.alphas - blend_colors(weights, still)
            views.append(View(weights, goal, weight * scale**2))
    learned, losses = fit_colors(views, start, changed, STEPS, progress)
    return Sharpened(dense._replace(colors=still.masked_scatter(changed[:, None], learned)), n_new, losses)


def _faded_in(mask: Float[Tensor, "S S"]) -> Float[Tensor, "S S"]:
    """Share of each pixel that is surely hand, growing from the border over a width of `RIM`."""
    rim = max(1, round(RIM * len(mask)))
    inner = inner_mask(mask, 2 * rim)
    return avg_pool2d(inner[None, None], 2 * rim + 1, stride=1, padding=rim)[0, 0]


def _wanted_spacing(canvas: Canvas, seen: Seen, drawn: Tensor, n_faces: int) -> Float[Tensor, "F"]:
    """Distance between Gaussians with which each face would show the picture [px]; infinite where it does already."""

    def worst(error: Float[Tensor, "S S 3"]) -> Float[Tensor, "F"]:
        local = avg_pool2d((error.square().mean(-1) * seen.share)[None, None], 3, stride=1, padding=1)[0, 0].sqrt()
        counted = seen.share > MIN_SHARE
        values = torch.zeros(n_faces, dtype=local.dtype, device=local.device)
        return values.scatter_reduce_(0, seen.faces[counted], local[counted], "amax")

    spacing = torch.full((n_faces,), torch.inf, device=drawn.device)
    short = worst(drawn - canvas.image) > TOLERANCE
    for finer in SPACINGS:
        spacing = torch.where(short, finer, spacing)
        short = short & (worst(_sampled(canvas.image, finer) - canvas.image) > TOLERANCE)
    return spacing


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
