"""How much work a scene is: Gaussians, pixels, tiles and pairs, from which the roofline counts bytes and operations."""

from dataclasses import dataclass

import torch

from oasis_kernels.constants import EPS2D
from oasis_kernels.rasterize.tiles_cuda import TILE
from oasis_warp.bench.gpu_cases import AvatarScene
from oasis_warp.bench.scenes import GaussianScene, MeshScene
from oasis_warp.ops.projection import project


@dataclass(frozen=True)
class Counts:
    """The work of drawing a scene, summed over its cameras."""

    gaussians: int
    """Once for each camera."""
    drawn: int
    """Of these, those whose box contains a pixel."""
    box_pixels: int
    """In all boxes together."""
    pairs: int
    """Pairs of a Gaussian and a tile of 8 x 8 pixels that its box meets."""
    tiles: int
    busy_tiles: int
    """Tiles with a list that is not empty."""
    longest: int
    """Length of the longest list of a tile."""
    pixels: int
    views: int


@torch.no_grad()
def count(scene: GaussianScene) -> Counts:
    """The work of drawing `scene`."""
    across, down = -(-scene.width // TILE), -(-scene.height // TILE)
    n, n_views = len(scene.means), len(scene.viewmats)
    drawn = box_pixels = pairs = 0
    lists = []
    for view in scene.views():  # one by one: the projection of 64 views at once takes gigabytes
        boxes = project(
            view.means, view.quats, view.scales, view.opacities, view.viewmats, view.Ks, view.width, view.height,
            near_plane=0.01, far_plane=1e10, radius_clip=0.0, eps2d=EPS2D,
        ).tables().boxes.view(-1, 4)  # fmt: skip
        boxes = boxes[(boxes[:, 0] < boxes[:, 2]) & (boxes[:, 1] < boxes[:, 3])]
        x0, y0 = (boxes[:, :2] // TILE).unbind(-1)
        x1, y1 = ((boxes[:, 2:] + TILE - 1) // TILE).unbind(-1)
        drawn += len(boxes)
        box_pixels += int((boxes[:, 2:] - boxes[:, :2]).long().prod(-1).sum())
        pairs += int(((x1 - x0).long() * (y1 - y0)).sum())
        # Rectangles are added by their corners and summed along both axes.
        corners = torch.zeros((down + 1) * (across + 1), dtype=torch.int64, device=boxes.device)
        for x, y, sign in ((x0, y0, 1), (x1, y0, -1), (x0, y1, -1), (x1, y1, 1)):
            corner = (y * (across + 1) + x).long()
            corners.scatter_add_(0, corner, torch.full_like(corner, sign))
        lists.append(corners.view(down + 1, across + 1).cumsum(0).cumsum(1)[:down, :across])
    lengths = torch.stack(lists)
    return Counts(
        gaussians=n * n_views,
        drawn=drawn,
        box_pixels=box_pixels,
        pairs=pairs,
        tiles=n_views * across * down,
        busy_tiles=int((lengths > 0).sum()),
        longest=int(lengths.max()),
        pixels=n_views * scene.width * scene.height,
        views=n_views,
    )


@dataclass(frozen=True)
class MeshCounts:
    """The work of posing a mesh with Gaussians, or of finding the points that it hides."""

    vertices: int
    faces: int
    joints: int
    correctives: int
    """Displacements of every vertex."""
    vertex_gaussians: int
    face_gaussians: int
    points: int
    pixels: int


def count_mesh(scene: MeshScene) -> MeshCounts:
    """The work of posing or drawing the mesh of `scene`."""
    return MeshCounts(
        vertices=len(scene.rest_vertices),
        faces=len(scene.faces),
        joints=len(scene.transforms),
        correctives=0,
        vertex_gaussians=len(scene.vertex_index),
        face_gaussians=len(scene.face_index),
        points=len(scene.points),
        pixels=scene.width * scene.height,
    )


def count_avatar(scene: AvatarScene) -> MeshCounts:
    """The work of posing the Gaussians of an avatar."""
    return MeshCounts(
        vertices=len(scene.hand.template),
        faces=len(scene.hand.faces),
        joints=len(scene.hand.parents),
        correctives=scene.hand.corrective_basis.shape[-1],
        vertex_gaussians=len(scene.canonical.vertex_index),
        face_gaussians=len(scene.canonical.face_index),
        points=0,
        pixels=0,
    )
