"""A picture on the posed surface: what other views show of it, and colours fitted to such views."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from oasis_warp.avatar.observation import facing as facing_camera
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.logging import Progress
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import Camera
from oasis_warp.ops import BlendWeights, blend_colors, depth_map

STEP = 0.003
"""Depth by which one surface lies behind another rather than slopes away from it [m]."""
FAR = 1e3
"""Stands for an infinite depth where depths are subtracted [m]."""
NEARBY_ANGLES = ((0.0, 0.45), (0.0, -0.45), (0.45, 0.0), (-0.45, 0.0))
"""Angles of the views beside the photo's, about its horizontal and its vertical axis [rad]. Which Gaussian hides which
depends on the view; colours that suit one view alone come out shifted and frayed in others."""
PHOTO_WEIGHT = 2.0
"""Weight of a pixel in the photo's own view; a pixel in the views beside it has weight 1."""
PULL = 0.05
"""Weight that holds each new Gaussian at the colour read off the picture [pixels]."""
MARGIN = 8
"""Around the changed faces in each view [px]."""


class Canvas(NamedTuple):
    """A picture of the hand and the camera that shows the hand so."""

    image: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W"]
    """Share of each pixel that the avatar shall take from the picture."""
    camera: Camera


class SurfaceMap(NamedTuple):
    """What the canvas shows of the surface."""

    faces: Int[Tensor, "H W"]
    """-1 where there is none."""
    depth: Float[Tensor, "H W"]
    barycentrics: Float[Tensor, "H W 3"]
    """In those faces."""
    share: Float[Tensor, "H W"]
    """Share of each pixel that is in the mask and on a surface that faces the camera, clear of edges in front of it."""


class Source(NamedTuple):
    """A picture and the hand in it."""

    canvas: Canvas
    seen: SurfaceMap
    posed: Float[Tensor, "V 3"]
    """In the world of the canvas's camera [m]."""


class TargetView(NamedTuple):
    """One picture that colours are fitted to."""

    weights: BlendWeights
    goal: Float[Tensor, "H W 3"]
    """What the changed Gaussians have to add to the picture."""
    weight: float
    """Weight of each pixel of the view."""


def map_surface(
    posed: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], canvas: Canvas, facing: tuple[float, float]
) -> SurfaceMap:
    """What of the posed surface the canvas shows.

    `facing` are the cosines between surface and view below which a pixel says nothing, and above which it is taken as
    it is: on a slant it is drawn out to a streak.
    """
    camera = canvas.camera
    seen = depth_map(posed, faces, camera.viewmat, camera.K, camera.width, camera.height)
    ids, depth = seen.face_ids.long(), seen.depth.clamp_max(FAR)
    before = -max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    toward = facing_camera(posed, surface.vertex_normals(posed, faces), camera.viewmat)
    cosine = (toward[faces[ids.clamp_min(0)]] * seen.barycentrics).sum(-1)
    trust = ((cosine - facing[0]) / (facing[1] - facing[0])).clamp(0, 1)
    return SurfaceMap(ids, depth, seen.barycentrics, canvas.mask * trust * ((ids >= 0) & (depth - before < STEP)))


def with_neighbours(chosen: Bool[Tensor, "F"], faces: Tensor, n_vertices: int) -> Bool[Tensor, "F"]:
    """`chosen` and every face that shares a vertex with them."""
    at = torch.zeros(n_vertices, dtype=torch.bool, device=faces.device)
    at[faces[chosen].flatten()] = True
    return at[faces].any(1)


def sample_picture(
    canvas: Canvas, seen: SurfaceMap, points: Float[Tensor, "M 3"]
) -> tuple[Float[Tensor, "M"], Float[Tensor, "M 3"]]:
    """Share and colour of the picture at points of the posed surface; none where another surface hides them."""
    camera = canvas.camera
    uv, depth = project(camera, points)
    grid = (uv / uv.new_tensor([camera.width, camera.height]) * 2 - 1)[None, None]
    planes = torch.cat([canvas.image.permute(2, 0, 1), seen.share[None]])[None]
    sampled = grid_sample(planes, grid, align_corners=False)[0, :, 0].T
    front = grid_sample(seen.depth[None, None], grid, mode="nearest", padding_mode="border", align_corners=False)
    return sampled[:, 3] * (depth - front[0, 0, 0] < STEP), sampled[:, :3]


def overlay_pictures(
    colors: Float[Tensor, "M 3"], sources: Sequence[Source], points: Sequence[Float[Tensor, "M 3"]]
) -> Float[Tensor, "M 3"]:
    """`colors` of some places under what each picture shows of them; with each the places in its pose [m]."""
    for source, there in zip(sources, points, strict=True):
        share, color = sample_picture(source.canvas, source.seen, there)
        colors = torch.lerp(colors, color, share[:, None])
    return colors


def reproject(
    before: Float[Tensor, "h w 3"], sources: Sequence[Source], posed: Tensor, faces: Tensor, camera: Camera
) -> Float[Tensor, "h w 3"]:
    """The picture `before` that `camera` makes of the old hand, `posed`, with what the surface carries of others."""
    shown = depth_map(posed, faces, camera.viewmat, camera.K, camera.width, camera.height)
    on = shown.face_ids >= 0
    corners, place = faces[shown.face_ids[on].long()], shown.barycentrics[on][..., None]
    target = before.clone()
    target[on] = overlay_pictures(before[on], sources, [(source.posed[corners] * place).sum(1) for source in sources])
    return target


def nearby_cameras(camera: Camera, points: Float[Tensor, "K 3"]) -> list[Camera]:
    """Cameras rotated by `NEARBY_ANGLES` about the middle of `points`."""
    center = (points.amin(0) + points.amax(0)) / 2
    cameras = []
    for about_x, about_y in NEARBY_ANGLES:
        rotation = from_axis_angle(camera.viewmat.new_tensor([1.0, 0.0, 0.0]), camera.viewmat.new_tensor(about_x))
        rotation = rotation @ from_axis_angle(
            camera.viewmat.new_tensor([0.0, 1.0, 0.0]), camera.viewmat.new_tensor(about_y)
        )
        local = camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]
        viewmat = camera.viewmat.clone()
        viewmat[:3, :3] = rotation @ camera.viewmat[:3, :3]
        viewmat[:3, 3] = rotation @ (camera.viewmat[:3, 3] - local) + local
        cameras.append(camera._replace(viewmat=viewmat))
    return cameras


def crop_to_points(camera: Camera, points: Tensor, zoom: float) -> Camera:
    """The part of the picture, `zoom` times as large, that shows `points`."""
    K = camera.K.clone()
    K[:2] *= zoom
    uv, _ = project(camera._replace(K=K), points)
    low, high = uv.amin(0).floor() - MARGIN, uv.amax(0).ceil() + MARGIN
    K[:2, 2] -= low
    width, height = (int(n) for n in high - low)
    return Camera(camera.viewmat, K, width, height)


def fit_colors(
    views: list[TargetView], start: Float[Tensor, "M 3"], changed: Bool[Tensor, "N"], steps: int, progress: Progress
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
