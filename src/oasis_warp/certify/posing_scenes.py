"""Meshes that bend, for the rotations of faces; Gaussians on meshes; and points and covariances that follow bones."""

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.certify.case import ORDINARY, STIFF, Bounds, Case, Sampler, sheet
from oasis_warp.core.rotation import from_axis_angle, to_matrix

SIDES = (1, 2, 3, 5)
"""Squares along a side of the sheet; two faces each."""
COUNTS = (0, 1, 7, 60, 300)
JOINTS = (1, 4, 16)
LAWS = ("sqrt_area", "area", "none")
FAR = torch.tensor([1000.0, -500.0, 2000.0])
UNITS = (1e-12, 1e-6, 1e3, 1e12)


@dataclasses.dataclass
class Bend:
    """A mesh at rest and posed."""

    rest: Tensor
    posed: Tensor
    faces: Tensor
    bounds: Bounds = STIFF


def rumpled(rng: Sampler, side: int) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a sheet with faces of unlike areas."""
    flat, faces = sheet(side)
    return flat + 0.15 * rng.normal(*flat.shape), faces


def bent(rng: Sampler, side: int, bend: float = 0.2) -> Bend:
    """A sheet, rumpled otherwise and turned."""
    rest, faces = rumpled(rng, side)
    stretch = torch.tensor([1.3, 0.8, 1.0], dtype=torch.float64)
    posed = (rest * stretch + bend * rng.normal(*rest.shape)) @ to_matrix(rng.normal(4)).T
    return Bend(rest, posed, faces)


def rigid_motion(rng: Sampler, side: int) -> Bend:
    """No bend, by angles from 0 to half a turn."""
    rest, faces = rumpled(rng, side)
    axis = rng.normal(3)
    axis = rng.pick((axis / axis.norm(), *torch.eye(3, dtype=torch.float64)))
    angle = rng.pick((0.0, 1e-4, 1.0, math.pi - 1e-3, math.pi - 1e-6, math.pi))
    rotation = from_axis_angle(axis, torch.tensor(angle, dtype=torch.float64))
    return Bend(rest, rest @ rotation.T + rng.normal(3), faces)


def nearly_half_a_turn(rng: Sampler, side: int) -> Bend:
    """A small bend, turned by nearly half a turn."""
    rest, faces = rumpled(rng, side)
    axis = rng.normal(3)
    rotation = from_axis_angle(axis / axis.norm(), torch.tensor(math.radians(179.4), dtype=torch.float64))
    return Bend(rest, (rest + 0.15 * rng.normal(*rest.shape)) @ rotation.T, faces)


def uniform_growth(rng: Sampler, side: int) -> Bend:
    """The same shape at another size."""
    rest, faces = rumpled(rng, side)
    return Bend(rest, rng.pick((0.02, 0.5, 2.0, 50.0)) * rest, faces)


def any_unit(rng: Sampler, side: int) -> Bend:
    """Lengths from 1e-12 to 1e12."""
    bend, unit = bent(rng, side), rng.pick(UNITS)
    return dataclasses.replace(bend, rest=unit * bend.rest, posed=unit * bend.posed)


def rolled_up(rng: Sampler, side: int) -> Bend:
    """Rotations pass half a turn more than once: quaternions of neighbours come with opposite signs."""
    rest, faces = rumpled(rng, side)
    angle = 2.0 * rest[:, 0]
    return Bend(rest, torch.stack([angle.sin(), rest[:, 1], 1 - angle.cos()], 1), faces)


def flat_and_lonely(rng: Sampler, side: int) -> Bend:
    """With a face that is flat at rest or posed, faces with equal corners, and a vertex without a face."""
    bend = bent(rng, side)
    n = len(bend.rest)
    line = torch.arange(3.0).double()[:, None] * torch.tensor([1.0, 1.0, 0.0])
    proper = torch.tensor([[9.0, 9, 0], [10, 9, 0], [11, 11, 0]]).double()
    ends = (line, proper) if rng.pick((False, True)) else (proper, line)
    alone = rng.normal(1, 3)
    more = torch.tensor([[n, n + 1, n + 2], [0, 0, 1], [1, 1, 1]])
    rest, posed = torch.cat([bend.rest, ends[0], alone]), torch.cat([bend.posed, ends[1], alone])
    return Bend(rest, posed, torch.cat([bend.faces, more]))


def collapsed(rng: Sampler, side: int) -> Bend:
    """All vertices in one point, at rest, posed or both."""
    bend = bent(rng, side)
    point = torch.ones_like(bend.rest)
    return Bend(*rng.pick(((point, bend.posed), (bend.rest, point), (point, point))), bend.faces)


def folded(rng: Sampler, side: int) -> Bend:
    """Folded onto itself along a line through its faces."""
    rest, faces = rumpled(rng, side)
    posed = rest.clone()
    posed[:, 0] = (rest[:, 0] - 0.55).abs()
    return Bend(rest, posed, faces)


def mirrored(rng: Sampler, side: int) -> Bend:
    """Nearly the mirror image."""
    rest, faces = rumpled(rng, side)
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    return Bend(rest, (rest + 0.1 * rng.normal(*rest.shape)) * flip, faces)


def slivers(rng: Sampler, side: int) -> Bend:
    """Thin faces: computing with edges rounded to eps turns a face of height `thin` by eps / thin."""
    bend, thin = bent(rng, side), rng.pick((1e-2, 1e-3))
    squeeze = torch.tensor([1.0, thin, thin], dtype=torch.float64)
    error = 1e-6 / thin
    return Bend(bend.rest * squeeze, bend.posed, bend.faces, Bounds(error, 10 * error, 100 * error))


def duplicate_faces(rng: Sampler, side: int) -> Bend:
    """Every face twice."""
    bend = bent(rng, side)
    return dataclasses.replace(bend, faces=torch.cat([bend.faces, bend.faces]))


def no_faces(rng: Sampler, side: int) -> Bend:
    """Vertices alone, or not even these."""
    rest = rng.normal(5 * (side - 1), 3)
    return Bend(rest, rest.clone(), torch.zeros(0, 3, dtype=torch.int64))


BENDS: dict[str, Callable[[Sampler, int], Bend]] = {
    "ordinary": lambda rng, side: dataclasses.replace(bent(rng, side), bounds=ORDINARY),
    "rigid motion": rigid_motion,
    "root turned by nearly half a turn": nearly_half_a_turn,
    "uniform growth": uniform_growth,
    "any unit of length": any_unit,
    "large bends": lambda rng, side: bent(rng, side, bend=1.0),
    "rolled up": rolled_up,
    "flat and lonely": flat_and_lonely,
    "collapsed to a point": collapsed,
    "folded onto itself": folded,
    "mirrored": mirrored,
    "slivers": slivers,
    "duplicate faces": duplicate_faces,
    "no faces": no_faces,
}


def face_rotations_case(name: str, seed: int, side: int | None = None) -> Case:
    """A mesh at rest and posed under the condition `name` of `BENDS`."""
    rng = Sampler(seed)
    bend = BENDS[name](rng, rng.pick(SIDES) if side is None else side)
    floats = {"rest_vertices": bend.rest, "posed_vertices": bend.posed}
    return Case(name, seed, floats, tuple(floats), {"faces": bend.faces}, bend.bounds)


def pose_on_mesh_covars_case(name: str, seed: int, side: int | None = None, n: int | None = None) -> Case:
    """Gaussians on the faces of a mesh that bends under the condition `name` of `BENDS`, stretched with it."""
    rng = Sampler(seed)
    bend = BENDS[name](rng, rng.pick(SIDES) if side is None else side)
    n = rng.pick(COUNTS) if n is None else n
    n = n if len(bend.faces) else 0
    floats = {
        "rest_vertices": bend.rest,
        "posed_vertices": bend.posed,
        "barycentrics": rng.normal(n, 3).softmax(-1),
        "quats": rng.normal(n, 4),
        "scales": rng.normal(n, 3).exp() * float(bend.rest.abs().max() if len(bend.rest) else 1.0),
    }
    face_index = rng.integers(max(len(bend.faces), 1), n)
    return Case(name, seed, floats, tuple(floats), {"faces": bend.faces, "face_index": face_index}, bend.bounds)


Floats = dict[str, Tensor]


def half_turns_between_corners(rng: Sampler, floats: Floats) -> Floats:
    """Rotations of neighbouring vertices half a turn apart."""
    n = len(floats["vertex_quats"])
    quats = torch.eye(4, dtype=torch.float64)[torch.arange(n) % 4] + 0.02 * rng.normal(n, 4)
    return {"vertex_quats": quats / quats.norm(dim=-1, keepdim=True)}


def opposite_signs(rng: Sampler, floats: Floats) -> Floats:
    """Nearly equal rotations, with quaternions of either sign."""
    quats = rng.normal(1, 4) + 0.1 * rng.normal(*floats["vertex_quats"].shape)
    return {"vertex_quats": rng.signs(len(quats), 1) * quats / quats.norm(dim=-1, keepdim=True)}


def collapsed_and_torn(rng: Sampler, floats: Floats) -> Floats:
    """Area ratios from 0 to 1e9."""
    ratios = torch.tensor([0.0, 1e-9, 1e-3, 1.0, 1e3, 1e9]).double()
    return {"area_ratio": ratios[rng.integers(6, len(floats["area_ratio"]))]}


def any_unit_on_mesh(rng: Sampler, floats: Floats) -> Floats:
    """Lengths from 1e-12 to 1e12."""
    unit = rng.pick(UNITS)
    return {name: unit * floats[name] for name in {"posed_vertices", "scales", "offsets"} & set(floats)}


ON_MESH: dict[str, Callable[[Sampler, Floats], Floats]] = {
    "ordinary": lambda rng, floats: {},
    "on corners": lambda rng, floats: {
        "barycentrics": torch.eye(3, dtype=torch.float64)[rng.integers(3, len(floats["barycentrics"]))]
    },
    "in the middle": lambda rng, floats: {"barycentrics": torch.full_like(floats["barycentrics"], 1 / 3)},
    "half turns between corners": half_turns_between_corners,
    "opposite signs": opposite_signs,
    "collapsed and torn faces": collapsed_and_torn,
    "far from the origin": lambda rng, floats: {"posed_vertices": floats["posed_vertices"] + FAR},
    "any unit of length": any_unit_on_mesh,
    "quaternions of any norm": lambda rng, floats: {"quats": floats["quats"] * rng.pick((1e-6, 1e-3, 1e3, 1e6))},
    "scales of zero": lambda rng, floats: {"scales": floats["scales"] * rng.integers(2, *floats["scales"].shape)},
}
"""By name, what replaces float arguments of `pose_on_mesh`."""


def pose_on_mesh_case(name: str, seed: int, n: int | None = None, law: str | None = None) -> Case:
    """Gaussians on faces that share vertices at random, under the condition `name` of `ON_MESH`."""
    rng = Sampler(seed)
    n_vertices, n_faces = rng.pick(((3, 1), (14, 11), (60, 90)))
    n = rng.pick(COUNTS) if n is None else n
    law = rng.pick(LAWS) if law is None else law
    n_on_vertices = rng.pick((None, 1, 20))
    n_all = n + (n_on_vertices or 0)
    vertex_quats, quats = rng.units(n_vertices, 4), rng.units(n_all, 4)
    floats = {
        "posed_vertices": rng.normal(n_vertices, 3),
        "barycentrics": rng.normal(n, 3).softmax(-1),
        "vertex_quats": vertex_quats,
        "area_ratio": rng.normal(n_faces).exp(),
        "quats": quats,
        "scales": rng.normal(n_all, 3).exp(),
    }
    if n_on_vertices:
        floats |= {"offsets": rng.normal(n_on_vertices, 3), "vertex_area_ratio": rng.normal(n_vertices).exp()}
    floats |= ON_MESH[name](rng, floats)
    faces = torch.stack([torch.randperm(n_vertices, generator=rng.generator)[:3] for _ in range(n_faces)])
    others = {"faces": faces, "face_index": rng.integers(n_faces, n), "scale_law": law}
    if n_on_vertices:
        others["vertex_index"] = rng.integers(n_vertices, n_on_vertices)
    return Case(name, seed, floats, tuple(floats), others, ORDINARY if name == "ordinary" else STIFF)


def with_parts(transforms: Tensor, linear: Tensor | None = None, shift: Tensor | None = None) -> Floats:
    """Transforms of bones with another linear part or another translation."""
    changed = transforms.clone()
    if linear is not None:
        changed[:, :3, :3] = linear
    if shift is not None:
        changed[:, :3, 3] = shift
    return {"transforms": changed}


def one_bone_each(rng: Sampler, floats: Floats) -> Floats:
    """Weights of 0 and 1."""
    n, n_joints = floats["weights"].shape
    return {"weights": torch.eye(n_joints, dtype=torch.float64)[rng.integers(n_joints, n)]}


def affine_bones(rng: Sampler, floats: Floats) -> Floats:
    """Bones that shear."""
    linear = floats["transforms"][:, :3, :3]
    shear = torch.eye(3, dtype=torch.float64) + 0.2 * rng.normal(len(linear), 3, 3)
    return with_parts(floats["transforms"], linear @ shear)


def mirroring_bones(rng: Sampler, floats: Floats) -> Floats:
    """Three unlike stretches: of a plain mirror image no rotation is the nearest."""
    transforms = floats["transforms"]
    return with_parts(transforms, transforms[:, :3, :3] * torch.tensor([-0.4, 1.0, 1.7]))


def flat_covariances(rng: Sampler, floats: Floats) -> Floats:
    """Covariances of rank one."""
    if "covars" not in floats:
        return {}
    row = rng.normal(len(floats["means"]), 3)
    return {"covars": row[:, :, None] * row[:, None]}


def any_unit_of_bones(rng: Sampler, floats: Floats) -> Floats:
    """Lengths from 1e-9 to 1e6."""
    unit, transforms = rng.pick((1e-9, 1e-3, 1e3, 1e6)), floats["transforms"]
    covars = {"covars": floats["covars"] * unit**2} if "covars" in floats else {}
    return {"means": floats["means"] * unit} | with_parts(transforms, shift=transforms[:, :3, 3] * unit) | covars


def far_bones(rng: Sampler, floats: Floats) -> Floats:
    """Bones that move everything away from the origin."""
    return with_parts(floats["transforms"], shift=floats["transforms"][:, :3, 3] + FAR)


SKINNING: dict[str, Callable[[Sampler, Floats], Floats]] = {
    "ordinary": lambda rng, floats: {},
    "one bone each": one_bone_each,
    "affine bones": affine_bones,
    "mirroring bones": mirroring_bones,
    "flat covariances": flat_covariances,
    "any unit of length": any_unit_of_bones,
    "far from the origin": far_bones,
}
"""By name, what replaces float arguments of `skin`."""


def skin_case(
    name: str,
    seed: int,
    n: int | None = None,
    n_joints: int | None = None,
    rotation_only: bool | None = None,
    with_covars: bool | None = None,
) -> Case:
    """Points under the condition `name` of `SKINNING`."""
    rng = Sampler(seed)
    n, n_joints = rng.pick(COUNTS) if n is None else n, rng.pick(JOINTS) if n_joints is None else n_joints
    with_covars = rng.pick((True, True, False)) if with_covars is None else with_covars
    transforms = torch.eye(4, dtype=torch.float64).repeat(n_joints, 1, 1)
    # Bones within about a right angle of each other, as in a hand: their blends stay far from singular.
    transforms[:, :3, :3] = to_matrix(rng.units(4) + 0.3 * rng.normal(n_joints, 4))
    transforms[:, :3, 3] = rng.normal(n_joints, 3)
    half = rng.normal(n, 3, 3)
    floats = {
        "means": rng.normal(n, 3),
        "covars": half @ half.mT,
        "weights": (2 * rng.normal(n, n_joints)).softmax(-1),
        "transforms": transforms[:, : rng.pick((3, 4))],
    }
    if not with_covars:
        del floats["covars"]
    floats |= SKINNING[name](rng, floats)
    rigid = rng.pick((False, True)) if rotation_only is None else rotation_only
    others = {"rotation_only": rigid and with_covars} | ({} if with_covars else {"covars": None})
    return Case(name, seed, floats, tuple(floats), others, ORDINARY if name == "ordinary" else STIFF)
