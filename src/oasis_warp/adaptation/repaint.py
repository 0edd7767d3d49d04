"""Bring what was painted on a photo into the Gaussians: finer ones under the paint, colours by least squares."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from oasis_warp.adaptation.reprojection import (
    PHOTO_WEIGHT,
    Canvas,
    Source,
    SurfaceMap,
    TargetView,
    crop_to_points,
    fit_colors,
    map_surface,
    nearby_cameras,
    reproject,
    sample_picture,
    with_neighbours,
)
from oasis_warp.avatar.densify import densify, parts_for_spacing
from oasis_warp.avatar.pose import pose_gaussians, with_photo_colors, with_shade_baked
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Camera, CanonicalGaussians
from oasis_warp.ops import blend_colors
from oasis_warp.render.render import view_weights

FACING = 0.04, 0.12
"""Cosines between surface and view below which paint says nothing, and above which it is taken as it is."""
MIN_PAINT = 0.02
"""Share of paint from which a pixel's face is cut into finer parts."""
SPACING = 1.0
"""Distance between the finer Gaussians [pixels of the painted picture]."""
RINGS = 4
"""Of faces round the paint whose Gaussians are replaced, too: those of a learned prior reach so far, and would lay a
veil over the paint in other views."""
ZOOMS = (1.0, 2.0)
"""Sizes of the views beside the photo's over its own: the smaller a picture, the more the rasterizer's own blur."""


class RepaintResult(NamedTuple):
    """Gaussians with the paint."""

    gaussians: CanonicalGaussians
    """Those that were not touched are the same bit for bit, in their order; the new ones are the last."""
    n_new: int
    faces: Bool[Tensor, "F"]
    """Whose Gaussians are new: under the paint, and their neighbours."""
    area: float
    """Of the painted surface at rest [m^2]."""
    left_out: float
    """Share of the paint on the hand that was left out: on a slant, or beside an edge in front of it."""
    losses: tuple[float, ...]
    """Mean squared colour difference over all views, of every step."""


def repaint(
    gaussians: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    rest: Float[Tensor, "V 3"],
    posed: Float[Tensor, "V 3"],
    canvas: Canvas,
    *,
    steps: int = 40,
    progress: Progress = silent,
) -> RepaintResult:
    """Replace the Gaussians under the paint, and a few rings of faces around it, by finer ones that show it.

    Their colours minimise the squared difference of pictures that are linear in them: in the photo's view the painted
    picture where there is paint and the old avatar elsewhere, in views beside it the same reprojected over the surface.
    What the photo shows on a slant, behind an edge or not at all keeps its look.

    Args:
        gaussians: On the surface at rest.
        faces: Of the surface.
        rest: Vertices at rest [m].
        posed: Vertices in the photo's pose [m], in the world of the canvas's camera.
        canvas: What was painted.
        steps: Of accelerated projected gradient descent.
        progress: Called as work goes on.

    Raises:
        ValueError: no paint on the surface.
    """
    seen = map_surface(posed, faces, canvas, FACING)
    around = _faces_around_paint(seen, faces, len(rest))
    _, depth = project(canvas.camera, posed)
    pixel = depth[faces].mean(1) / canvas.camera.K[0, 0]
    # A face of one part would keep its vertices' Gaussians, which reach into the faces beside it.
    parts = torch.where(around, parts_for_spacing(rest, faces, SPACING * pixel).clamp_min(2), 1)
    dense, changed, n_new = densify(gaussians, rest, faces, parts)

    old, new = (pose_gaussians(with_shade_baked(layer), faces, rest, posed) for layer in (gaussians, dense))
    share, color = sample_picture(canvas, seen, new.means[changed])
    start = torch.lerp(new.colors[changed], color, share[:, None])
    unchanged = torch.where(changed[:, None], 0, new.colors)
    views = []
    for camera, weight in _cameras(canvas.camera, posed[faces[around]].flatten(0, 1)):
        before = blend_colors(view_weights(old, camera), old.colors)
        target = reproject(before, [Source(canvas, seen, posed)], posed, faces, camera)
        weights = view_weights(new, camera)
        views.append(TargetView(weights, target - blend_colors(weights, unchanged), weight))
    learned, losses = fit_colors(views, start, changed, steps, progress)
    if dense.shade is not None:  # paint has none
        lighter = torch.lerp(dense.shade[changed], torch.ones_like(learned), share[:, None])
        dense = dense._replace(shade=dense.shade.masked_scatter(changed[:, None], lighter))
    _, areas = surface.face_normals(rest, faces)
    on = dense.face_index[-n_new:]
    area = float((areas[on] / parts[on].square() * share[-n_new:]).sum())
    left_out = float(1 - seen.share.sum() / (canvas.mask * (seen.faces >= 0)).sum())
    return RepaintResult(with_photo_colors(dense, changed, learned), n_new, around, area, left_out, losses)


def _faces_around_paint(seen: SurfaceMap, faces: Int[Tensor, "F 3"], n_vertices: int) -> Bool[Tensor, "F"]:
    """Faces under the paint, and `RINGS` of neighbours.

    Raises:
        ValueError: there is no paint.
    """
    chosen = torch.zeros(len(faces), dtype=torch.bool, device=faces.device)
    chosen[seen.faces[seen.share > MIN_PAINT]] = True
    if not bool(chosen.any()):
        raise ValueError("canvas: expected paint on the hand, got none. Check its mask and its camera.")
    for _ in range(RINGS):
        chosen = with_neighbours(chosen, faces, n_vertices)
    return chosen


def _cameras(camera: Camera, points: Float[Tensor, "K 3"]) -> list[tuple[Camera, float]]:
    """The photo's camera and those beside it, cut to show just `points`; with each the weight of its pixels."""
    turned = [
        (crop_to_points(other, points, zoom), 1 / zoom**2) for other in nearby_cameras(camera, points) for zoom in ZOOMS
    ]
    return [(crop_to_points(camera, points, 1.0), PHOTO_WEIGHT), *turned]
