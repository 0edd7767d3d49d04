"""Meshes that bend, for the rotations of faces, and Gaussians that ride on them."""

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.certify.case import STIFF, Bounds, Case, Draw
from oasis_warp.core.rotation import from_axis_angle, to_matrix

SIDES = (1, 2, 3, 5)
"""Squares along a side of the sheet; two faces each."""
GAUSSIANS = (0, 1, 7, 60, 300)


@dataclasses.dataclass
class Bend:
    """A mesh at rest and posed."""

    rest: Tensor
    posed: Tensor
    faces: Tensor
    bounds: Bounds = STIFF


Condition = Callable[[Draw, int], Bend]
CONDITIONS: dict[str, Condition] = {}


def condition(name: str) -> Callable[[Condition], Condition]:
    """Enter a function into `CONDITIONS`."""

    def enter(function: Condition) -> Condition:
        CONDITIONS[name] = function
        return function

    return enter


def rumpled(draw: Draw, side: int) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a sheet with faces of unlike areas."""
    ticks = torch.arange(side + 1, dtype=torch.float64)
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    flat = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    a = (torch.arange(side)[:, None] * (side + 1) + torch.arange(side)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + side + 2], 1), torch.stack([a, a + side + 2, a + side + 1], 1)])
    return flat + 0.15 * draw.normal(*flat.shape), faces


def bent(draw: Draw, side: int, bend: float = 0.2) -> Bend:
    """A sheet, rumpled otherwise and turned."""
    rest, faces = rumpled(draw, side)
    stretch = torch.tensor([1.3, 0.8, 1.0], dtype=torch.float64)
    posed = (rest * stretch + bend * draw.normal(*rest.shape)) @ to_matrix(draw.normal(4)).T
    return Bend(rest, posed, faces)


@condition("ordinary")
def _(draw: Draw, side: int) -> Bend:
    return dataclasses.replace(bent(draw, side), bounds=Bounds())


@condition("rigid motion")
def _(draw: Draw, side: int) -> Bend:
    rest, faces = rumpled(draw, side)
    axis = draw.normal(3)
    axis = draw.pick((axis / axis.norm(), *torch.eye(3, dtype=torch.float64)))
    angle = draw.pick((0.0, 1e-4, 1.0, math.pi - 1e-3, math.pi - 1e-6, math.pi))
    turn = from_axis_angle(axis, torch.tensor(angle, dtype=torch.float64))
    return Bend(rest, rest @ turn.T + draw.normal(3), faces)


@condition("root turned by nearly half a turn")
def _(draw: Draw, side: int) -> Bend:
    rest, faces = rumpled(draw, side)
    axis = draw.normal(3)
    turn = from_axis_angle(axis / axis.norm(), torch.tensor(math.radians(179.4), dtype=torch.float64))
    return Bend(rest, (rest + 0.15 * draw.normal(*rest.shape)) @ turn.T, faces)


@condition("uniform growth")
def _(draw: Draw, side: int) -> Bend:
    rest, faces = rumpled(draw, side)
    return Bend(rest, draw.pick((0.02, 0.5, 2.0, 50.0)) * rest, faces)


@condition("any unit of length")
def _(draw: Draw, side: int) -> Bend:
    made, unit = bent(draw, side), draw.pick((1e-12, 1e-6, 1e3, 1e12))
    return dataclasses.replace(made, rest=unit * made.rest, posed=unit * made.posed)


@condition("large bends")
def _(draw: Draw, side: int) -> Bend:
    return bent(draw, side, bend=1.0)


@condition("rolled up")
def _(draw: Draw, side: int) -> Bend:
    # Rotations pass half a turn more than once: quaternions of neighbours come with opposite signs.
    rest, faces = rumpled(draw, side)
    angle = 2.0 * rest[:, 0]
    return Bend(rest, torch.stack([angle.sin(), rest[:, 1], 1 - angle.cos()], 1), faces)


@condition("flat and lonely")
def _(draw: Draw, side: int) -> Bend:
    made = bent(draw, side)
    n = len(made.rest)
    line = torch.arange(3.0).double()[:, None] * torch.tensor([1.0, 1.0, 0.0])
    proper = torch.tensor([[9.0, 9, 0], [10, 9, 0], [11, 11, 0]]).double()
    ends = (line, proper) if draw.pick((False, True)) else (proper, line)
    alone = draw.normal(1, 3)
    more = torch.tensor([[n, n + 1, n + 2], [0, 0, 1], [1, 1, 1]])
    return Bend(torch.cat([made.rest, ends[0], alone]), torch.cat([made.posed, ends[1], alone]),
                torch.cat([made.faces, more]))  # fmt: skip


@condition("collapsed to a point")
def _(draw: Draw, side: int) -> Bend:
    made = bent(draw, side)
    point = torch.ones_like(made.rest)
    return Bend(*draw.pick(((point, made.posed), (made.rest, point), (point, point))), made.faces)


@condition("folded onto itself")
def _(draw: Draw, side: int) -> Bend:
    rest, faces = rumpled(draw, side)
    posed = rest.clone()
    posed[:, 0] = (rest[:, 0] - 0.55).abs()
    return Bend(rest, posed, faces)


@condition("mirrored")
def _(draw: Draw, side: int) -> Bend:
    rest, faces = rumpled(draw, side)
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    return Bend(rest, (rest + 0.1 * draw.normal(*rest.shape)) * flip, faces)


@condition("slivers")
def _(draw: Draw, side: int) -> Bend:
    made = bent(draw, side)
    thin = draw.pick((1e-2, 1e-3))
    squeeze = torch.tensor([1.0, thin, thin], dtype=torch.float64)
    # Computing with edges rounded to eps turns a face of height `thin` by eps / thin.
    error = 1e-6 / thin
    return Bend(made.rest * squeeze, made.posed, made.faces, Bounds(error, 10 * error, 100 * error))


@condition("duplicate faces")
def _(draw: Draw, side: int) -> Bend:
    made = bent(draw, side)
    return dataclasses.replace(made, faces=torch.cat([made.faces, made.faces]))


@condition("no faces")
def _(draw: Draw, side: int) -> Bend:
    rest = draw.normal(5 * (side - 1), 3)
    return Bend(rest, rest.clone(), torch.zeros(0, 3, dtype=torch.int64))


def face_rotations_case(name: str, seed: int, side: int | None = None) -> Case:
    """A mesh at rest and posed under the condition `name`."""
    draw = Draw(seed)
    made = CONDITIONS[name](draw, draw.pick(SIDES) if side is None else side)
    floats = {"rest_vertices": made.rest, "posed_vertices": made.posed}
    return Case(name, seed, floats, tuple(floats), {"faces": made.faces}, made.bounds)


LAWS = ("sqrt_area", "area", "none")
RIDERS: dict[str, Callable[[Draw, dict[str, Tensor]], Bounds]] = {}


def rider(name: str) -> Callable[[Callable], Callable]:
    """Enter a function, which changes the float arguments of `pose_on_mesh`, into `RIDERS`."""

    def enter(function: Callable) -> Callable:
        RIDERS[name] = function
        return function

    return enter


@rider("ordinary")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    return Bounds()


@rider("on corners")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    n = len(floats["barycentrics"])
    floats["barycentrics"] = torch.eye(3, dtype=torch.float64)[draw.integers(3, n)]
    return STIFF


@rider("in the middle")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    floats["barycentrics"] = torch.full_like(floats["barycentrics"], 1 / 3)
    return STIFF


@rider("half turns between corners")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    n = len(floats["vertex_quats"])
    floats["vertex_quats"] = torch.eye(4, dtype=torch.float64)[torch.arange(n) % 4] + 0.02 * draw.normal(n, 4)
    floats["vertex_quats"] /= floats["vertex_quats"].norm(dim=-1, keepdim=True)
    return STIFF


@rider("opposite signs")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    turn = draw.normal(1, 4)
    quats = turn + 0.1 * draw.normal(*floats["vertex_quats"].shape)
    floats["vertex_quats"] = draw.signs(len(quats), 1) * quats / quats.norm(dim=-1, keepdim=True)
    return STIFF


@rider("collapsed and torn faces")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    n = len(floats["area_ratio"])
    floats["area_ratio"] = torch.tensor([0.0, 1e-9, 1e-3, 1.0, 1e3, 1e9]).double()[draw.integers(6, n)]
    return STIFF


@rider("far from the origin")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    floats["posed_vertices"] = floats["posed_vertices"] + torch.tensor([1000.0, -500.0, 2000.0])
    return STIFF


@rider("any unit of length")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    unit = draw.pick((1e-12, 1e-6, 1e3, 1e12))
    for length in {"posed_vertices", "scales", "offsets"} & set(floats):
        floats[length] *= unit
    return STIFF


@rider("quaternions of any norm")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    floats["quats"] *= draw.pick((1e-6, 1e-3, 1e3, 1e6))
    return STIFF


@rider("scales of zero")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    floats["scales"] *= draw.integers(2, *floats["scales"].shape)
    return STIFF


def pose_on_mesh_covars_case(name: str, seed: int, side: int | None = None, n: int | None = None) -> Case:
    """Gaussians on the faces of a mesh that bends under the condition `name`, stretched with it."""
    draw = Draw(seed)
    made = CONDITIONS[name](draw, draw.pick(SIDES) if side is None else side)
    n = draw.pick(GAUSSIANS) if n is None else n
    n = n if len(made.faces) else 0
    floats = {
        "rest_vertices": made.rest,
        "posed_vertices": made.posed,
        "barycentrics": draw.normal(n, 3).softmax(-1),
        "quats": draw.normal(n, 4),
        "scales": draw.normal(n, 3).exp() * float(made.rest.abs().max() if len(made.rest) else 1.0),
    }
    face_index = draw.integers(max(len(made.faces), 1), n)
    return Case(name, seed, floats, tuple(floats), {"faces": made.faces, "face_index": face_index}, made.bounds)


def pose_on_mesh_case(name: str, seed: int, n: int | None = None, law: str | None = None) -> Case:
    """Gaussians on faces that share vertices at random, under the condition `name`."""
    draw = Draw(seed)
    n_vertices, n_faces = draw.pick(((3, 1), (14, 11), (60, 90)))
    n = draw.pick(GAUSSIANS) if n is None else n
    law = draw.pick(LAWS) if law is None else law
    n_on_vertices = draw.pick((None, 1, 20))
    n_all = n + (n_on_vertices or 0)
    vertex_quats, quats = draw.normal(n_vertices, 4), draw.normal(n_all, 4)
    floats = {
        "posed_vertices": draw.normal(n_vertices, 3),
        "barycentrics": draw.normal(n, 3).softmax(-1),
        "vertex_quats": vertex_quats / vertex_quats.norm(dim=-1, keepdim=True),
        "area_ratio": draw.normal(n_faces).exp(),
        "quats": quats / quats.norm(dim=-1, keepdim=True),
        "scales": draw.normal(n_all, 3).exp(),
    }
    if n_on_vertices:
        floats |= {"offsets": draw.normal(n_on_vertices, 3), "vertex_area_ratio": draw.normal(n_vertices).exp()}
    bounds = RIDERS[name](draw, floats)
    faces = torch.stack([torch.randperm(n_vertices, generator=draw.generator)[:3] for _ in range(n_faces)])
    others = {"faces": faces, "face_index": draw.integers(n_faces, n), "scale_law": law}
    if n_on_vertices:
        others["vertex_index"] = draw.integers(n_vertices, n_on_vertices)
    return Case(name, seed, floats, tuple(floats), others, bounds)
