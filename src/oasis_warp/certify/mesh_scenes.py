"""Meshes before a camera, for the depth buffer, with points round them for the visibility."""

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.certify.case import Bounds, Case, Draw
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
    """In camera axes; the rest of a scene is drawn round it."""

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


Condition = Callable[[Draw, int], Mesh]
CONDITIONS: dict[str, Condition] = {}


def condition(name: str) -> Callable[[Condition], Condition]:
    """Enter a function into `CONDITIONS`."""

    def enter(function: Condition) -> Condition:
        CONDITIONS[name] = function
        return function

    return enter


def soup(draw: Draw, n: int, size: float = 0.5, low: float = 2.0, high: float = 6.0) -> Mesh:
    """Triangles at random."""
    centres = torch.cat([0.7 * draw.normal(n, 2), draw.uniform(n, 1, low=low, high=high)], 1)
    corners = centres[:, None] + size * draw.normal(n, 3, 3)
    return Mesh(corners.reshape(-1, 3), torch.arange(3 * n).view(-1, 3))


def sheet(n: int, spacing: float, z: float) -> tuple[Tensor, Tensor]:
    """A plane of 2 n^2 triangles."""
    ticks = (torch.arange(n + 1, dtype=torch.float64) - n / 2) * spacing
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    return torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3), faces


@condition("ordinary")
def _(draw: Draw, n: int) -> Mesh:
    return soup(draw, n)


@condition("closed surface")
def _(draw: Draw, n: int) -> Mesh:
    # An octahedron, each face cut into four, pushed out to a bumpy ball.
    corners = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    a, b, c = corners[faces].unbind(1)
    ab, bc, ca = a + b, b + c, c + a
    parts = torch.stack([torch.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], 1)
    points, index = torch.unique((parts / parts.norm(dim=-1, keepdim=True)).view(-1, 3), dim=0, return_inverse=True)
    ball = points * draw.uniform(len(points), 1, low=0.8, high=1.2) + torch.tensor([0.0, 0, 3])
    return Mesh(ball, index.view(-1, 3))


@condition("grid through pixel centres")
def _(draw: Draw, n: int) -> Mesh:
    vertices, faces = sheet(5, 0.25, 2.0)
    vertices[:, 2] += draw.uniform(len(vertices), high=draw.pick((0.0, 0.4)))
    return Mesh(vertices, faces, turned=False)


@condition("through the camera's plane")
def _(draw: Draw, n: int) -> Mesh:
    return soup(draw, n, size=1.0, low=-1.5, high=2.5)


@condition("through the near plane")
def _(draw: Draw, n: int) -> Mesh:
    return dataclasses.replace(soup(draw, n, low=1.0, high=4.0), near_plane=2.0)


@condition("behind the camera")
def _(draw: Draw, n: int) -> Mesh:
    return soup(draw, n, size=0.3, low=-6.0, high=-2.0)


@condition("degenerate faces")
def _(draw: Draw, n: int) -> Mesh:
    mesh = soup(draw, n)
    a, b, c = mesh.faces.unbind(1)
    return dataclasses.replace(mesh, faces=torch.cat([torch.stack([a, a, b], 1), mesh.faces, torch.stack([c] * 3, 1)]))


@condition("duplicate and flipped faces")
def _(draw: Draw, n: int) -> Mesh:
    mesh = soup(draw, n)
    return dataclasses.replace(mesh, faces=torch.cat([mesh.faces, mesh.faces[: n // 2], mesh.faces[:, [0, 2, 1]]]))


@condition("folded")
def _(draw: Draw, n: int) -> Mesh:
    # The second face lies exactly on the first, turned over.
    vertices, _ = sheet(1, 1.5, 2.5)
    return Mesh(torch.cat([vertices, vertices[:1]]), torch.tensor([[0, 1, 3], [3, 1, 4]]))


@condition("slivers")
def _(draw: Draw, n: int) -> Mesh:
    mesh = soup(draw, n)
    corners = mesh.vertices.view(n, 3, 3).clone()
    corners[:, 2] = corners[:, 0] + draw.uniform(n, 1) * (corners[:, 1] - corners[:, 0]) + 1e-3 * draw.normal(n, 3)
    return dataclasses.replace(mesh, vertices=corners.view(-1, 3))


@condition("smaller than a pixel")
def _(draw: Draw, n: int) -> Mesh:
    vertices, faces = sheet(6, 0.02, 2.0)
    return Mesh(vertices + 0.005 * draw.normal(len(vertices), 3), faces)


@condition("larger than the world")
def _(draw: Draw, n: int) -> Mesh:
    mesh = soup(draw, min(n, 7), low=2.0, high=4.0)
    push = torch.tensor([1e4, 1e4, 1.0], dtype=torch.float64)
    return dataclasses.replace(mesh, vertices=mesh.vertices * push)


@condition("edge-on")
def _(draw: Draw, n: int) -> Mesh:
    y, z = draw.uniform(3 * n, low=-2.0, high=2.0), draw.uniform(3 * n, low=1.0, high=5.0)
    return Mesh(torch.stack([3 * y, y, z], 1), torch.arange(3 * n).view(-1, 3), turned=False)


@condition("a kilometre away")
def _(draw: Draw, n: int) -> Mesh:
    vertices, faces = sheet(3, 0.4, 0.0)
    vertices[:, 2] += draw.uniform(len(vertices), high=0.05)
    # A tenth of a metre holds 1e-6 of its distance: the depth map itself is a float32 number.
    return Mesh(vertices, faces, tau=0.001, distance=1000.0, turned=False)


@condition("any unit of length")
def _(draw: Draw, n: int) -> Mesh:
    return dataclasses.replace(soup(draw, n), unit=draw.pick((1e-9, 1e-3, 1e6, 1e12)))


@condition("tiny tau")
def _(draw: Draw, n: int) -> Mesh:
    return dataclasses.replace(soup(draw, n), tau=draw.pick((1e-6, 1e-4)))


@condition("huge tau")
def _(draw: Draw, n: int) -> Mesh:
    return dataclasses.replace(soup(draw, n), tau=1e3)


@condition("no faces")
def _(draw: Draw, n: int) -> Mesh:
    return Mesh(draw.normal(4, 3), torch.zeros(0, 3, dtype=torch.int64))


def scene(draw: Draw, mesh: Mesh, size: tuple[int, int]) -> tuple[dict[str, Tensor], dict]:
    """Float arguments and other arguments; now and then a batch of two, of which the second sees a little else."""
    width, height = size
    viewmat = torch.eye(4, dtype=torch.float64)
    if mesh.turned:
        viewmat[:3, :3] = to_matrix(draw.normal(4))
        viewmat[:3, 3] = draw.normal(3)
    viewmat[2, 3] += mesh.distance
    viewmat = viewmat.float().double()
    away = torch.tensor([0.0, 0.0, mesh.distance])
    vertices = (mesh.vertices + away - viewmat[:3, 3]) @ torch.linalg.inv(viewmat[:3, :3]).T
    focal = 0.9 * max(width, height) * max(1.0, mesh.distance)
    K = torch.tensor([[focal, 0, 0.49 * width], [0, 0.94 * focal, 0.51 * height], [0, 0, 1]], dtype=torch.float64)
    viewmat[:3, 3] *= mesh.unit
    floats = {"vertices": mesh.unit * vertices, "viewmat": viewmat, "K": K}
    near = mesh.near_plane * mesh.unit
    if draw.pick((False, False, False, True)):
        for name in draw.pick((("vertices",), ("viewmat", "K"), ("vertices", "viewmat"))):
            nudge = 1 + 0.02 * draw.uniform(1)
            floats[name] = torch.stack([floats[name], nudge * floats[name] if name == "vertices" else floats[name]])
    return floats, {"faces": mesh.faces, "width": width, "height": height, "near_plane": near}


def depth_map_case(name: str, seed: int, n: int | None = None, size: tuple[int, int] | None = None) -> Case:
    """A mesh under the condition `name` before a camera."""
    draw = Draw(seed)
    size = draw.pick(SIZES) if size is None else size
    n = draw.pick(FACE_COUNTS) if n is None else n
    floats, others = scene(draw, CONDITIONS[name](draw, n), size)
    return Case(name, seed, floats, (), others, DEPTHS)


def depth_visibility_case(
    name: str, seed: int, n: int | None = None, size: tuple[int, int] | None = None, n_points: int | None = None
) -> Case:
    """The same with points in front of the faces, on them, behind them, on the vertices, and out of the image."""
    draw = Draw(seed)
    size = draw.pick(SIZES) if size is None else size
    n = draw.pick(FACE_COUNTS) if n is None else n
    n_points = draw.pick(POINT_COUNTS) if n_points is None else n_points
    mesh = CONDITIONS[name](draw, n)
    floats, others = scene(draw, mesh, size)
    named = draw.pick((False, True))
    viewmat, vertices = floats["viewmat"].view(-1, 4, 4)[0], floats["vertices"].view(-1, *mesh.vertices.shape)[0]
    points, vertex = points_round(draw, vertices, mesh, n_points, named)
    # A rounding of the depth of 1 ulp moves the score by that much over tau.
    depth = float((points @ viewmat[2, :3] + viewmat[2, 3]).abs().max()) / mesh.unit if len(points) else 0.0
    error = 2e-5 + (1e-5 if mesh.distance else 2.4e-7 * depth / mesh.tau)
    others |= {"tau": mesh.tau * mesh.unit}
    if named:
        others["point_vertices"] = vertex
    else:
        others |= draw.pick(({}, {"literal": True}, {"margin": 0.5 * mesh.tau * mesh.unit}))
    bounds = Bounds(error, max(1e-3, error), error)
    floats = {"points": points} | floats
    slope = MISS / mesh.tau / mesh.unit
    floors = {"points": slope, "vertices": slope, "visibility": 1.0}
    return Case(name, seed, floats, ("points", "vertices"), others, bounds, floors)


def points_round(draw: Draw, vertices: Tensor, mesh: Mesh, n: int, named: bool) -> tuple[Tensor, Tensor]:
    """Points and the vertex that each is, -1 for none."""
    if len(mesh.faces):
        weights = draw.normal(n, 3).softmax(-1)
        at = (weights[..., None] * vertices[mesh.faces[draw.integers(len(mesh.faces), n)]]).sum(1)
    else:
        at = vertices[draw.integers(len(vertices), n)]
    spread = torch.tensor([1.0, 1.0, 1.0, 10.0, math.inf]).double()[draw.integers(5, n)]
    anywhere = vertices.mean(0) + 3 * mesh.unit * draw.normal(n, 3)
    jitter = mesh.tau * mesh.unit * spread.clamp(max=100.0)[:, None] * draw.normal(n, 3)
    if mesh.tau > 1:
        jitter = jitter * 0
    points = torch.where(spread.isinf()[:, None], anywhere, at + jitter)
    index = torch.full((n,), -1)
    if named:
        points, index = torch.cat([points, vertices]), torch.cat([index, torch.arange(len(vertices))])
    return points, index
