"""The operators under certification: how to read their results, their float64 references, and their scenes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from oasis_warp import ops, reference
from oasis_warp.certify import mesh_scenes, posing_scenes, rasterization_scenes
from oasis_warp.certify.case import Case
from oasis_warp.core.types import Camera
from oasis_warp.reference import posing, rasterization, visibility

Outputs = tuple[Tensor, ...]
Arguments = dict[str, Any]
ALL = torch.ones((), dtype=torch.float64)
"""The mask of an output whose elements all count."""
SIGN_TIE = 1e-5
"""Dot product of two quaternions below which rounding may decide the sign of one."""
LARGE_MESH = {"n": 1500, "size": (160, 120)}


@dataclass(frozen=True)
class Family:
    """An operator of `oasis_warp.ops`."""

    name: str
    outputs: tuple[str, ...]
    """Names of what `read` returns."""
    read: Callable[[Any], Outputs]
    """From results to float64 tensors whose error means something: finite, the same for q and -q."""
    reference: Callable[[Arguments, float], tuple[Outputs, Outputs]]
    """The same from the reference, and for each output a mask (1 or 0, broadcast) of what does not depend on rounding.

    Takes the arguments in float64, and how much wider than float32 rounding to understand that."""
    case: Callable[..., Case]
    """(condition, seed, ...) to a scene."""
    conditions: tuple[str, ...]
    large: dict[str, Any]
    """Arguments of `case` for a scene that is shared out over threads, too large for the reference."""
    smooth: Callable[[Case], bool] = bool
    """Whether a small step changes no decision in a scene but those that the mask leaves out."""

    def call(self, arguments: Arguments) -> Any:
        """The operator, looked up at the time of the call."""
        return getattr(ops, self.name)(**arguments)

    def scene(self, seed: int) -> Case:
        """A scene of the grid: conditions take turns, all else is drawn from the seed."""
        return self.case(self.conditions[seed % len(self.conditions)], seed)


def squares(quats: Tensor) -> Tensor:
    """The products q q^T of quaternions [..., 4], which do not depend on their sign."""
    return quats[..., :, None] * quats[..., None, :]


def bounded(ratios: Tensor) -> Tensor:
    """Area ratios as they act on scales: of a face that was flat at rest, all further digits are rounding."""
    return ratios.clamp(1 / posing.LIMIT, posing.LIMIT)


def read_all(answer: Any) -> Outputs:
    """The results that are there, in float64."""
    return tuple(t.double() for t in answer if isinstance(t, Tensor))


def reference_rasterization(arguments: Arguments, slack: float) -> tuple[Outputs, Outputs]:
    """Image and alphas, without fragile pixels."""
    image, alphas, fragile = rasterization.rasterization(**arguments, dense=True, slack=slack)
    mask = (~fragile)[..., None].double()
    return (image, alphas), (mask, mask)


BATCHED = {"points": 2, "vertices": 2, "viewmat": 2, "K": 2}
"""Arguments of the depth buffer that may have a batch axis, and the number of their other axes."""


def each_of_batch(
    reference: Callable[[Arguments, float], tuple[Outputs, Outputs]], arguments: Arguments, slack: float
) -> tuple[Outputs, Outputs]:
    """`reference` of every entry of a batch, stacked where an argument has a batch axis."""
    batched = {k: v for k, v in arguments.items() if k in BATCHED and v.dim() > BATCHED[k]}
    n = max((len(v) for v in batched.values()), default=1)
    parts = [reference(arguments | {k: v[i] for k, v in batched.items()}, slack) for i in range(n)]
    if not batched:
        return parts[0]
    outputs, masks = (tuple(map(torch.stack, zip(*both, strict=True))) for both in zip(*parts, strict=True))
    return outputs, masks


def cast(arguments: Arguments, slack: float) -> tuple[Camera, visibility.Hits, visibility.Certainty]:
    """The camera, what its rays hit, and what of that does not depend on rounding."""
    camera, near = Camera(*(arguments[name] for name in Camera._fields)), arguments["near_plane"]
    rays = visibility.cast(arguments["vertices"], arguments["faces"], camera, near)
    hits = visibility.nearest_hits(rays, camera, near)
    return camera, hits, visibility.certainty(rays, hits, arguments["faces"], camera, near, slack)


def read_depth_map(answer: Any) -> Outputs:
    """1 / depth, which is 0 over the background, and barycentrics, compared where the face is beyond doubt."""
    return 1 / answer.depth.double(), answer.barycentrics.double()


def reference_depth_map(arguments: Arguments, slack: float) -> tuple[Outputs, Outputs]:
    """As `read_depth_map`, of one mesh and camera."""
    _, hits, known = cast(arguments, slack)
    return (1 / hits.depth, hits.barycentrics), (known.sound.double(), known.clear[..., None].double())


def reference_visibility(arguments: Arguments, slack: float) -> tuple[Outputs, Outputs]:
    """Scores of points, of one mesh and camera."""
    camera, hits, known = cast(arguments, slack)
    points, near = arguments["points"], arguments["near_plane"]
    literal = arguments.get("literal", False)
    named = None if literal else arguments.get("point_vertices")
    margin = 0.0 if literal else arguments.get("margin")
    scores = visibility.score_points(points, hits, arguments["faces"], camera, arguments["tau"], margin, named, near)
    return (scores,), (visibility.stable_points(points, known, camera, named is not None, near, slack).double(),)


def read_face_rotations(answer: Any) -> Outputs:
    """Rotations without sign, and bounded ratios."""
    vertex_quats, face_quats, *ratios = (t.double() for t in answer)
    return squares(vertex_quats), squares(face_quats), *map(bounded, ratios)


def reference_face_rotations(arguments: Arguments, slack: float) -> tuple[Outputs, Outputs]:
    """As `read_face_rotations`, without vertex rotations whose sum has a sign that rounding decides."""
    *answer, sound = posing.face_rotations(**arguments)
    return read_face_rotations(answer), (sound.double()[:, None, None], ALL, ALL, ALL)


def read_pose_on_mesh(answer: Any) -> Outputs:
    """Means, rotations without sign, and scales."""
    means, quats, scales = (t.double() for t in answer)
    return means, squares(quats), scales


def reference_pose_on_mesh(arguments: Arguments, slack: float) -> tuple[Outputs, Outputs]:
    """As `read_pose_on_mesh`, without rotations whose mean has a sign that rounding decides."""
    means, quats, scales = posing.pose_on_mesh(**arguments)
    with torch.no_grad():
        corners = arguments["faces"][arguments["face_index"]]
        dots = posing.dots_with_heaviest(arguments["vertex_quats"][corners], arguments["barycentrics"])
        aligned = (dots.abs() > slack * SIGN_TIE).all(-1).double()
        aligned = torch.cat([torch.ones(len(quats) - len(aligned)), aligned])[:, None, None]
    return (means, squares(quats), scales), (ALL, aligned, ALL)


def whole_reference(name: str) -> Callable[[Arguments, float], tuple[Outputs, Outputs]]:
    """The declared reference of an operator whose results all count."""

    def compute(arguments: Arguments, slack: float) -> tuple[Outputs, Outputs]:
        outputs = reference.named(ops.DECLARATIONS[name].reference)(**arguments)
        return outputs, (ALL,) * len(outputs)

    return compute


FAMILIES = {
    family.name: family
    for family in (
        Family(
            "rasterization", ("image", "alphas"), lambda answer: read_all(answer[:2]), reference_rasterization,
            rasterization_scenes.rasterization_case, tuple(rasterization_scenes.CONDITIONS),
            {"n": 5000, "size": (128, 96), "n_cameras": 2, "channels": 3, "mode": "RGB+ED", "spread": 0.25},
            smooth=rasterization_scenes.is_smooth,
        ),
        Family(
            "depth_map", ("1 / depth", "barycentrics"), read_depth_map,
            lambda arguments, slack: each_of_batch(reference_depth_map, arguments, slack),
            mesh_scenes.depth_map_case, tuple(mesh_scenes.CONDITIONS), LARGE_MESH,
        ),
        Family(
            "depth_visibility", ("visibility",), lambda answer: (answer.visibility.double(),),
            lambda arguments, slack: each_of_batch(reference_visibility, arguments, slack),
            mesh_scenes.depth_visibility_case, tuple(mesh_scenes.CONDITIONS), LARGE_MESH | {"n_points": 5000},
        ),
        Family(
            "face_rotations", ("vertex_quats", "face_quats", "area_ratio", "vertex_area_ratio"),
            read_face_rotations, reference_face_rotations,
            posing_scenes.face_rotations_case, tuple(posing_scenes.BENDS), {"side": 50},
        ),
        Family(
            "pose_on_mesh", ("means", "quats", "scales"), read_pose_on_mesh, reference_pose_on_mesh,
            posing_scenes.pose_on_mesh_case, tuple(posing_scenes.ON_MESH), {"n": 10_000},
        ),
        Family(
            "pose_on_mesh_covars", ("means", "covars"), read_all, whole_reference("pose_on_mesh_covars"),
            posing_scenes.pose_on_mesh_covars_case, tuple(posing_scenes.BENDS), {"side": 20, "n": 10_000},
        ),
        Family(
            "skin", ("means", "covars"), read_all, whole_reference("skin"),
            posing_scenes.skin_case, tuple(posing_scenes.SKINNING), {"n": 10_000, "n_joints": 16},
        ),
    )
}  # fmt: skip
