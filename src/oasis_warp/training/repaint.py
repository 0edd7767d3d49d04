"""Bring what was painted on a photo into the Gaussians: finer ones under the paint, colours by least squares."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from oasis_warp.avatar.densify import densify, parts_for_spacing
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import Camera, CanonicalGaussians
from oasis_warp.ops import BlendWeights, blend_colors, depth_map
from oasis_warp.training.views import freeze_view

GRAZING, FACING = 0.04, 0.12
"""Cosines between surface and view below which paint says nothing, and above which it is taken as it is: on a slant a
pixel is drawn out to a streak."""
STEP = 0.003
"""Depth by which one surface lies behind another rather than slopes away from it [m]."""
FAR = 1e3
"""Stands for an infinite depth where depths are subtracted [m]."""
MIN_PAINT = 0.02
"""Share of paint from which a pixel's face is cut into finer parts."""
SPACING = 1.0
"""Distance between the finer Gaussians [pixels of the painted picture]."""
TURNS = ((0.0, 0.45), (0.0, -0.45), (0.45, 0.0), (-0.45, 0.0))
"""Of the views beside the photo's, about its horizontal and its vertical axis [rad]. Which Gaussian hides which depends
on the view; colours that suit one view alone come out shifted and frayed in others."""
ZOOMS = (1.0, 2.0)
"""Sizes of those views over the photo's: the smaller a picture, the more the rasterizer's own blur."""
PHOTO_WEIGHT = 2.0
"""Of a pixel in the photo's own view, against those beside it."""
PULL = 0.05
"""Weight that holds each new Gaussian at the colour read off the painted picture [pixels]."""
MARGIN = 8
"""Around the repainted faces in each view [px]."""


class Canvas(NamedTuple):
    """A painted picture and the camera that shows the hand so."""

    image: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W"]
    """Share of each pixel that is paint."""
    camera: Camera


class Repainted(NamedTuple):
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


class _Seen(NamedTuple):
    """What the photo's view shows of the surface."""

    faces: Int[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    paint: Float[Tensor, "H W"]
    """Share of each pixel that is paint and can be told what it is painted on."""


class _View(NamedTuple):
    weights: BlendWeights
    goal: Float[Tensor, "H W 3"]
    """What the new Gaussians have to add to the picture."""
    weight: float
    """Of each of its pixels."""


def repaint(
    gaussians: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    rest: Float[Tensor, "V 3"],
    posed: Float[Tensor, "V 3"],
    canvas: Canvas,
    *,
    steps: int = 40,
    progress: Progress = silent,
) -> Repainted:
    """Replace the Gaussians under the paint, and one ring of faces around it, by finer ones that show the paint.

    Their colours minimise the squared difference of pictures that are linear in them: in the photo's view the painted
    picture where there is paint and the old avatar elsewhere, in views beside it the same carried over by the surface.
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
    seen = _look(posed, faces, canvas)
    under = torch.zeros(len(faces), dtype=torch.bool, device=faces.device)
    under[seen.faces[seen.paint > MIN_PAINT]] = True
    if not bool(under.any()):
        raise ValueError("canvas: expected paint on the hand, got none. Check its mask and its camera.")
    around = _with_neighbours(under, faces, len(rest))
    _, depth = project(canvas.camera, posed)
    pixel = depth[faces].mean(1) / canvas.camera.K[0, 0]
    # A face of one part would keep its vertices' Gaussians, which reach into the faces beside it.
    parts = torch.where(around, parts_for_spacing(rest, faces, SPACING * pixel).clamp_min(2), 1)
    dense, changed, n_new = densify(gaussians, rest, faces, parts)

    old, new = (pose_gaussians(layer, faces, rest, posed) for layer in (gaussians, dense))
    share, color = _read(canvas, seen, new.means[changed])
    start = torch.lerp(dense.colors[changed], color, share[:, None])
    still = torch.where(changed[:, None], 0, dense.colors)
    views = []
    for camera, weight in _cameras(canvas.camera, posed[faces[around]].flatten(0, 1)):
        before = blend_colors(freeze_view(old, camera), old.colors)
        target = _painted(before, canvas, seen, posed, faces, camera)
        weights = freeze_view(new, camera)
        views.append(_View(weights, target - blend_colors(weights, still), weight))
    learned, losses = _fit(views, start, changed, steps, progress)
    _, areas = surface.face_normals(rest, faces)
    on = dense.face_index[-n_new:]
    on_hand = (canvas.mask * (seen.faces >= 0)).sum()
    return Repainted(
        dense._replace(colors=still.masked_scatter(changed[:, None], learned)),
        n_new,
        around,
        float((areas[on] / parts[on].square() * share[-n_new:]).sum()),
        float(1 - seen.paint.sum() / on_hand),
        losses,
    )


def _look(posed: Tensor, faces: Tensor, canvas: Canvas) -> _Seen:
    camera = canvas.camera
    seen = depth_map(posed, faces, camera.viewmat, camera.K, camera.width, camera.height)
    ids, depth = seen.face_ids.long(), seen.depth.clamp_max(FAR)
    before = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    center = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    facing = (surface.vertex_normals(posed, faces) * normalize(center - posed, dim=-1)).sum(-1)
    cosine = (facing[faces[ids.clamp_min(0)]] * seen.barycentrics).sum(-1)
    trust = ((cosine - GRAZING) / (FACING - GRAZING)).clamp(0, 1)
    return _Seen(ids, depth, canvas.mask * trust * ((ids >= 0) & (depth - before < STEP)))


def _with_neighbours(chosen: Bool[Tensor, "F"], faces: Tensor, n_vertices: int) -> Bool[Tensor, "F"]:
    """`chosen` and every face that shares a vertex with them."""
    at = torch.zeros(n_vertices, dtype=torch.bool, device=faces.device)
    at[faces[chosen].flatten()] = True
    return at[faces].any(1)


def _read(canvas: Canvas, seen: _Seen, points: Float[Tensor, "M 3"]) -> tuple[Float[Tensor, "M"], Float[Tensor, "M 3"]]:
    """Share and colour of the paint at points of the posed surface; none where another surface hides them."""
    camera = canvas.camera
    uv, depth = project(camera, points)
    grid = (uv / uv.new_tensor([camera.width, camera.height]) * 2 - 1)[None, None]
    planes = torch.cat([canvas.image.permute(2, 0, 1), seen.paint[None]])[None]
    sampled = grid_sample(planes, grid, align_corners=False)[0, :, 0].T
    front = grid_sample(seen.depth[None, None], grid, mode="nearest", padding_mode="border", align_corners=False)
    return sampled[:, 3] * (depth - front[0, 0, 0] < STEP), sampled[:, :3]


def _painted(before: Tensor, canvas: Canvas, seen: _Seen, posed: Tensor, faces: Tensor, camera: Camera) -> Tensor:
    """The picture `before` that `camera` makes of the old hand, with the paint on its surface."""
    shown = depth_map(posed, faces, camera.viewmat, camera.K, camera.width, camera.height)
    on = shown.face_ids >= 0
    points = (posed[faces[shown.face_ids[on].long()]] * shown.barycentrics[on][..., None]).sum(1)
    share, color = _read(canvas, seen, points)
    target = before.clone()
    target[on] = torch.lerp(before[on], color, share[:, None])
    return target


def _cameras(camera: Camera, points: Float[Tensor, "K 3"]) -> list[tuple[Camera, float]]:
    """The photo's camera and those beside it, turned about the middle of `points` and cut to show just these.

    With each the weight of its pixels.
    """
    center = (points.amin(0) + points.amax(0)) / 2
    cameras = [(_cut(camera, points, 1.0), PHOTO_WEIGHT)]
    for about_x, about_y in TURNS:
        turn = from_axis_angle(camera.viewmat.new_tensor([1.0, 0.0, 0.0]), camera.viewmat.new_tensor(about_x))
        turn = turn @ from_axis_angle(camera.viewmat.new_tensor([0.0, 1.0, 0.0]), camera.viewmat.new_tensor(about_y))
        local = camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]
        viewmat = camera.viewmat.clone()
        viewmat[:3, :3] = turn @ camera.viewmat[:3, :3]
        viewmat[:3, 3] = turn @ (camera.viewmat[:3, 3] - local) + local
        cameras += [(_cut(camera._replace(viewmat=viewmat), points, zoom), 1 / zoom**2) for zoom in ZOOMS]
    return cameras


def _cut(camera: Camera, points: Tensor, zoom: float) -> Camera:
    """The part of the picture, `zoom` times as large, that shows `points`."""
    K = camera.K.clone()
    K[:2] *= zoom
    uv, _ = project(camera._replace(K=K), points)
    low, high = uv.amin(0).floor() - MARGIN, uv.amax(0).ceil() + MARGIN
    K[:2, 2] -= low
    width, height = (int(n) for n in high - low)
    return Camera(camera.viewmat, K, width, height)


def _fit(
    views: list[_View], start: Float[Tensor, "M 3"], changed: Bool[Tensor, "N"], steps: int, progress: Progress
) -> tuple[Float[Tensor, "M 3"], tuple[float, ...]]:
    """Colours in [0, 1] with the least squared difference in all views, held at `start` where these say nothing.

    Accelerated projected gradient descent (Beck and Teboulle 2009). Blend weights are not negative, so the diagonal
    matrix of the row sums of W^T W bounds it: with the inverse as step no step length has to be found, and clamping
    is the projection.
    """
    rows = torch.nonzero(changed)[:, 0]
    nothing = start.new_zeros(len(changed), 3)

    def draw(weights: BlendWeights, colors: Tensor) -> Tensor:
        return blend_colors(weights, nothing.index_copy(0, rows, colors))

    def gather(weights: BlendWeights, picture: Tensor) -> Tensor:
        return (weights.transpose @ picture.flatten(0, 1))[rows]

    bound = torch.full_like(start, PULL)
    for weights, _, weight in views:
        bound += weight * gather(weights, draw(weights, torch.ones_like(start)))
    total = sum(weight * goal.numel() for _, goal, weight in views)
    colors, ahead, momentum, losses = start, start, 1.0, []
    for step in range(steps):
        gradient, loss = PULL * (ahead - start), 0.0
        for weights, goal, weight in views:
            difference = draw(weights, ahead) - goal
            gradient += weight * gather(weights, difference)
            loss += weight * float(difference.square().sum())
        losses.append(loss / total)
        last, colors = colors, (ahead - gradient / bound).clamp(0, 1)
        before, momentum = momentum, (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead = colors + (before - 1) / momentum * (colors - last)
        progress("colours", step + 1, steps)
    return colors, tuple(losses)
