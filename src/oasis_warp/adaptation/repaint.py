"""Paint on a photo: find it beside the noise of saving, and fit finer Gaussians under it by least squares."""

from typing import NamedTuple

import cv2
import numpy as np
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
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Camera, CanonicalGaussians, Photo
from oasis_warp.ops import blend_colors
from oasis_warp.render import view_weights

ASPECT_PIXELS = 1.5
"""Tolerance of a scaled copy's proportions, since sides are rounded [px]."""
CERTAIN, POSSIBLE = 0.1, 0.03
"""Colour difference above which a pixel is paint, and above which it is if connected to such a pixel."""
CERTAIN_NOISE, POSSIBLE_NOISE = 12.0, 4.0
"""The same thresholds in units of the noise, where these are larger."""
BUSY_SHARES = (0.25, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
"""Quantiles of local contrast that divide the pixels into bins: compression changes edges most."""
BUSY_WINDOW = 9
"""Window of local contrast, about a JPEG block [px]."""
QUIET_SHARE = 0.3
"""Share of a bin's pixels that are unpainted in any drawing; their differences determine the noise."""
HALO_SHARE, HALO_WINDOW = 0.2, 17
"""Differences below this share of the largest one in this window [px] are halos of compression, not paint."""
SMALLEST = 4
"""Fewest certain pixels of a stroke or dot."""
RIM = 2
"""Width of the soft edge of paint [px]."""
FACING = 0.04, 0.12
"""Cosines between surface and view below which paint says nothing, and above which it is taken as it is."""
MIN_PAINT = 0.02
"""Share of paint from which a pixel's face is cut into finer parts."""
SPACING = 1.0
"""Distance between the finer Gaussians [pixels of the painted picture]."""
RINGS = 4
"""Rings of faces around the paint whose Gaussians are replaced, too. Gaussians of a learned prior reach so far, and
would lay a veil over the paint in other views."""
ZOOMS = (1.0, 2.0)
"""Sizes of the views beside the photo's over its own: the smaller a picture, the more the rasterizer's own blur."""


def match_size(photo: Photo, width: int, height: int, name: str) -> Float[Tensor, "H W 3"]:
    """Scale `photo` to the size of the picture `name`, in [0, 1].

    Raises:
        InputError: the sizes have different proportions.
    """
    rows, columns = photo.rgb.shape[:2]
    if abs(columns * height / rows - width) > ASPECT_PIXELS and abs(rows * width / columns - height) > ASPECT_PIXELS:
        raise InputError(
            f"{name}: {width} x {height} pixels do not have the proportions of {photo.name}, {columns} x {rows}; "
            "paint on the whole photo, without cropping or rotating it."
        )
    return _scaled(photo.rgb.float() / 255, width, height)


def _scaled(picture: Tensor, width: int, height: int) -> Tensor:
    rows, columns = picture.shape[:2]
    if (rows, columns) == (height, width):
        return picture
    how = cv2.INTER_AREA if width < columns else cv2.INTER_CUBIC
    return torch.from_numpy(cv2.resize(picture.numpy(), (width, height), interpolation=how)).clamp(0, 1)


def read_mask(mask: Photo, width: int, height: int) -> Float[Tensor, "H W"]:
    """Scale a user's mask, white or opaque where there is paint, to another size.

    Raises:
        InputError: the sizes have different proportions.
    """
    same = match_size(mask, width, height, "the painted picture")
    return same.mean(-1) if mask.alpha is None else _scaled(mask.alpha, width, height)


def find_paint(photo: Float[Tensor, "H W 3"], painted: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Share of each pixel of `painted` that is paint, from its difference to `photo`.

    The noise of compression and scaling is measured on the pair itself, for each bin of local contrast. Paint consists
    of pixels far above the noise and of pixels above the noise that are connected to them.
    """
    apart = np.abs(photo.numpy() - painted.numpy()).max(-1)
    noise = _noise(photo.numpy(), cv2.GaussianBlur(apart, (0, 0), 1.0))
    near = HALO_SHARE * cv2.dilate(apart, np.ones((HALO_WINDOW, HALO_WINDOW), np.uint8))
    possible = (apart > np.maximum(np.maximum(POSSIBLE, near), POSSIBLE_NOISE * noise)).astype(np.uint8)
    certain = apart > np.maximum(CERTAIN, CERTAIN_NOISE * noise)
    # Close gaps in strokes where the paint has the colour of the photo.
    joined = cv2.morphologyEx(possible, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(joined, connectivity=8)
    sure = np.bincount(labels[certain], minlength=count)
    is_paint = sure >= SMALLEST
    is_paint[0] = False
    paint = is_paint[labels].astype(np.uint8)
    size = 2 * RIM + 1
    grown = cv2.dilate(paint, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return torch.from_numpy(cv2.GaussianBlur(grown.astype(np.float32), (0, 0), RIM / 3))


def _noise(photo: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Typical difference without paint at each pixel."""
    window = np.ones((BUSY_WINDOW, BUSY_WINDOW), np.uint8)
    busy = (cv2.dilate(photo, window) - cv2.erode(photo, window)).max(-1)
    bins = np.searchsorted(np.quantile(busy, BUSY_SHARES), busy)
    quiet = np.zeros(len(BUSY_SHARES) + 1, np.float32)
    for k in np.unique(bins):
        quiet[k] = np.quantile(apart[bins == k], QUIET_SHARE)
    return quiet[bins]


class NoPaintError(ValueError):
    """There is no paint on the surface."""


class RepaintResult(NamedTuple):
    """Gaussians with the paint."""

    gaussians: CanonicalGaussians
    """Those that were not touched are the same bit for bit, in their order; the new ones are the last."""
    n_new: int
    faces: Bool[Tensor, "F"]
    """Faces whose Gaussians are new: those under the paint, and their neighbours."""
    area: float
    """Area of the painted surface at rest [m^2]."""
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
        faces: Faces of the surface.
        rest: Vertices at rest [m].
        posed: Vertices in the photo's pose [m], in the world of the canvas's camera.
        canvas: What was painted.
        steps: Steps of accelerated projected gradient descent.
        progress: Called as work goes on.

    Raises:
        NoPaintError: no paint on the surface.
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
        NoPaintError: there is no paint.
    """
    chosen = torch.zeros(len(faces), dtype=torch.bool, device=faces.device)
    chosen[seen.faces[seen.share > MIN_PAINT]] = True
    if not bool(chosen.any()):
        raise NoPaintError("canvas: expected paint on the hand, got none. Check its mask and its camera.")
    for _ in range(RINGS):
        chosen = with_neighbours(chosen, faces, n_vertices)
    return chosen


def _cameras(camera: Camera, points: Float[Tensor, "K 3"]) -> list[tuple[Camera, float]]:
    """The photo's camera and those beside it, cut to show just `points`; with each the weight of its pixels."""
    turned = [
        (crop_to_points(other, points, zoom), 1 / zoom**2) for other in nearby_cameras(camera, points) for zoom in ZOOMS
    ]
    return [(crop_to_points(camera, points, 1.0), PHOTO_WEIGHT), *turned]
