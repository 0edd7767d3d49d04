"""Meshes before a camera, for the depth buffer, with points about them for the visibility."""

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.certify.case import Bounds, Case, Sampler, sheet
from oasis_warp.core.rotation import to_matrix

SIZES = ((1, 1), (1, 9), (11, 1), (5, 4), (16, 16), (17, 15), (31, 23), (37, 26), (130, 2))
FACE_COUNTS = (1, 2, 7, 25, 60)
POINT_COUNTS = (0, 1, 7, 30, 60)
DEPTHS = Bounds(values=2e-5, peak=1e-3)
"""Depths to 2e-5; a single pixel may lie on a sliver."""
MISS = 1e-3
"""Share of the slope at p = 1/2 below which a gradient counts as none: a saturated score has only rounding left."""


@dataclasses.dataclass
class Mesh:
    """A mesh in camera axes, and the settings of its condition."""

    vertices: Tensor
    faces: Tensor
    near_plane: float = 0.01
    tau: float = 0.05
    unit: float = 1.0
    """Lengths are multiplied by this at the end, those above too."""
    distance: float = 0.0
    """Added to all depths; the focal length grows with it."""
    turned: bool = True
    """Whether the camera is turned in the world; if not, depths are exactly those given."""


def soup(rng: Sampler, n: int, size: float = 0.5, low: float = 2.0, high: float = 6.0, **options) -> Mesh:
    """Triangles at random."""
    centers = torch.cat([0.7 * rng.normal(n, 2), rng.uniform(n, 1, low=low, high=high)], 1)
    corners = centers[:, None] + size * rng.normal(n, 3, 3)
    return Mesh(corners.reshape(-1, 3), torch.arange(3 * n).view(-1, 3), **options)


def plane(side: int, spacing: float, z: float) -> tuple[Tensor, Tensor]:
    """A sheet of 2 side^2 triangles about the optical axis."""
    vertices, faces = sheet(side)
    vertices = (vertices - side / 2) * spacing
    vertices[:, 2] = z
    return vertices, faces


def closed_surface(rng: Sampler, n: int) -> Mesh:
    """An octahedron, each face cut into four, pushed out to a bumpy ball."""
    corners = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    a, b, c = corners[faces].unbind(1)
    ab, bc, ca = a + b, b + c, c + a
    parts = torch.stack([torch.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], 1)
    points, index = torch.unique((parts / parts.norm(dim=-1, keepdim=True)).view(-1, 3), dim=0, return_inverse=True)
    bumpy = points * rng.uniform(len(points), 1, low=0.8, high=1.2) + torch.tensor([0.0, 0, 3])
    return Mesh(bumpy, index.view(-1, 3))


def grid_through_pixel_centers(rng: Sampler, n: int) -> Mesh:
    """A flat or bumpy sheet whose edges meet the centres of pixels."""
    vertices, faces = plane(5, 0.25, 2.0)
    vertices[:, 2] += rng.uniform(len(vertices), high=rng.pick((0.0, 0.4)))
    return Mesh(vertices, faces, turned=False)


def degenerate(rng: Sampler, n: int) -> Mesh:
    """Faces with two or three equal corners among others."""
    mesh = soup(rng, n)
    a, b, c = mesh.faces.unbind(1)
    return dataclasses.replace(mesh, faces=torch.cat([torch.stack([a, a, b], 1), mesh.faces, torch.stack([c] * 3, 1)]))


def duplicated_and_flipped(rng: Sampler, n: int) -> Mesh:
    """Half of the faces twice, and all of them turned over."""
    mesh = soup(rng, n)
    return dataclasses.replace(mesh, faces=torch.cat([mesh.faces, mesh.faces[: n // 2], mesh.faces[:, [0, 2, 1]]]))


def folded(rng: Sampler, n: int) -> Mesh:
    """Two faces; the second lies exactly on the first, turned over."""
    vertices, _ = plane(1, 1.5, 2.5)
    return Mesh(torch.cat([vertices, vertices[:1]]), torch.tensor([[0, 1, 3], [3, 1, 4]]))


def slivers(rng: Sampler, n: int) -> Mesh:
    """Triangles whose third corner lies nearly on the opposite edge."""
    mesh = soup(rng, n)
    corners = mesh.vertices.view(n, 3, 3).clone()
    corners[:, 2] = corners[:, 0] + rng.uniform(n, 1) * (corners[:, 1] - corners[:, 0]) + 1e-3 * rng.normal(n, 3)
    return dataclasses.replace(mesh, vertices=corners.view(-1, 3))


def smaller_than_a_pixel(rng: Sampler, n: int) -> Mesh:
    """A rough sheet of tiny triangles."""
    vertices, faces = plane(6, 0.02, 2.0)
    return Mesh(vertices + 0.005 * rng.normal(len(vertices), 3), faces)


def larger_than_the_world(rng: Sampler, n: int) -> Mesh:
    """Triangles some ten kilometres wide."""
    mesh = soup(rng, min(n, 7), low=2.0, high=4.0)
    return dataclasses.replace(mesh, vertices=mesh.vertices * torch.tensor([1e4, 1e4, 1.0], dtype=torch.float64))


def edge_on(rng: Sampler, n: int) -> Mesh:
    """Triangles in a plane through the camera."""
    y, z = rng.uniform(3 * n, low=-2.0, high=2.0), rng.uniform(3 * n, low=1.0, high=5.0)
    return Mesh(torch.stack([3 * y, y, z], 1), torch.arange(3 * n).view(-1, 3), turned=False)


def far_away(rng: Sampler, n: int) -> Mesh:
    """A sheet whose relief is small beside its distance: tau is 1e-6 of it, and the depth map is float32."""
    vertices, faces = plane(3, 0.4, 0.0)
    vertices[:, 2] += rng.uniform(len(vertices), high=0.05)
    return Mesh(vertices, faces, tau=0.001, distance=1000.0, turned=False)


CONDITIONS: dict[str, Callable[[Sampler, int], Mesh]] = {
    "ordinary": soup,
    "closed surface": closed_surface,
    "grid through pixel centres": grid_through_pixel_centers,
    "through the camera's plane": lambda rng, n: soup(rng, n, size=1.0, low=-1.5, high=2.5),
    "through the near plane": lambda rng, n: soup(rng, n, low=1.0, high=4.0, near_plane=2.0),
    "behind the camera": lambda rng, n: soup(rng, n, size=0.3, low=-6.0, high=-2.0),
    "degenerate faces": degenerate,
    "duplicate and flipped faces": duplicated_and_flipped,
    "folded": folded,
    "slivers": slivers,
    "smaller than a pixel": smaller_than_a_pixel,
    "larger than the world": larger_than_the_world,
    "edge-on": edge_on,
    "a kilometre away": far_away,
    "any unit of length": lambda rng, n: dataclasses.replace(soup(rng, n), unit=rng.pick((1e-9, 1e-3, 1e6, 1e12))),
    "tiny tau": lambda rng, n: dataclasses.replace(soup(rng, n), tau=rng.pick((1e-6, 1e-4))),
    "huge tau": lambda rng, n: soup(rng, n, tau=1e3),
    "no faces": lambda rng, n: Mesh(rng.normal(4, 3), torch.zeros(0, 3, dtype=torch.int64)),
}


def before_camera(rng: Sampler, mesh: Mesh, size: tuple[int, int]) -> tuple[dict[str, Tensor], dict]:
    """Float arguments and other arguments; one in four is a batch of two, and its second entry differs a little."""
    width, height = size
    viewmat = torch.eye(4, dtype=torch.float64)
    if mesh.turned:
        viewmat[:3, :3] = to_matrix(rng.normal(4))
        viewmat[:3, 3] = rng.normal(3)
    viewmat[2, 3] += mesh.distance
    viewmat = viewmat.float().double()
    away = torch.tensor([0.0, 0.0, mesh.distance])
    vertices = (mesh.vertices + away - viewmat[:3, 3]) @ torch.linalg.inv(viewmat[:3, :3]).T
    focal = 0.9 * max(width, height) * max(1.0, mesh.distance)
    K = torch.tensor([[focal, 0, 0.49 * width], [0, 0.94 * focal, 0.51 * height], [0, 0, 1]], dtype=torch.float64)
    viewmat[:3, 3] *= mesh.unit
    floats = {"vertices": mesh.unit * vertices, "viewmat": viewmat, "K": K}
    near = mesh.near_plane * mesh.unit
    if rng.pick((False, False, False, True)):
        for name in rng.pick((("vertices",), ("viewmat", "K"), ("vertices", "viewmat"))):
            nudge = 1 + 0.02 * rng.uniform(1)
            floats[name] = torch.stack([floats[name], nudge * floats[name] if name == "vertices" else floats[name]])
    return floats, {"faces": mesh.faces, "width": width, "height": height, "near_plane": near}


def depth_map_case(name: str, seed: int, n: int | None = None, size: tuple[int, int] | None = None) -> Case:
    """A mesh under the condition `name` before a camera."""
    rng = Sampler(seed)
    size = rng.pick(SIZES) if size is None else size
    n = rng.pick(FACE_COUNTS) if n is None else n
    floats, others = before_camera(rng, CONDITIONS[name](rng, n), size)
    return Case(name, seed, floats, (), others, DEPTHS)


def depth_visibility_case(
    name: str, seed: int, n: int | None = None, size: tuple[int, int] | None = None, n_points: int | None = None
) -> Case:
    """The same with points in front of the faces, on them, behind them, on the vertices, and out of the image."""
    rng = Sampler(seed)
    size = rng.pick(SIZES) if size is None else size
    n = rng.pick(FACE_COUNTS) if n is None else n
    n_points = rng.pick(POINT_COUNTS) if n_points is None else n_points
    mesh = CONDITIONS[name](rng, n)
    floats, others = before_camera(rng, mesh, size)
    named = rng.pick((False, True))
    viewmat, vertices = floats["viewmat"].view(-1, 4, 4)[0], floats["vertices"].view(-1, *mesh.vertices.shape)[0]
    points, vertex = points_about(rng, vertices, mesh, n_points, named)
    # A rounding of the depth of 1 ulp moves the score by that much over tau.
    depth = float((points @ viewmat[2, :3] + viewmat[2, 3]).abs().max()) / mesh.unit if len(points) else 0.0
    error = 2e-5 + (1e-5 if mesh.distance else 2.4e-7 * depth / mesh.tau)
    others |= {"tau": mesh.tau * mesh.unit}
    if named:
        others["point_vertices"] = vertex
    else:
        others |= rng.pick(({}, {"literal": True}, {"margin": 0.5 * mesh.tau * mesh.unit}))
    bounds = Bounds(error, max(1e-3, error), error)
    floats = {"points": points} | floats
    slope = MISS / mesh.tau / mesh.unit
    floors = {"points": slope, "vertices": slope, "visibility": 1.0}
    return Case(name, seed, floats, ("points", "vertices"), others, bounds, floors)


def points_about(rng: Sampler, vertices: Tensor, mesh: Mesh, n: int, named: bool) -> tuple[Tensor, Tensor]:
    """Points, and the vertex that each of them is, -1 for none; with `named` all vertices are among them."""
    if len(mesh.faces):
        weights = rng.normal(n, 3).softmax(-1)
        on_faces = (weights[..., None] * vertices[mesh.faces[rng.integers(len(mesh.faces), n)]]).sum(1)
    else:
        on_faces = vertices[rng.integers(len(vertices), n)]
    spread = torch.tensor([1.0, 1.0, 1.0, 10.0, math.inf]).double()[rng.integers(5, n)]
    anywhere = vertices.mean(0) + 3 * mesh.unit * rng.normal(n, 3)
    jitter = mesh.tau * mesh.unit * spread.clamp(max=100.0)[:, None] * rng.normal(n, 3)
    if mesh.tau > 1:
        jitter = jitter * 0
    points = torch.where(spread.isinf()[:, None], anywhere, on_faces + jitter)
    index = torch.full((n,), -1)
    if named:
        points, index = torch.cat([points, vertices]), torch.cat([index, torch.arange(len(vertices))])
    return points, index
