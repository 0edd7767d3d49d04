"""The operators under certification: how each is called, what of its answer counts, and its float64 twin."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from oasis_warp import ops
from oasis_warp.certify import mesh_scenes, rasterization_scenes, skinning_scenes, surface_scenes
from oasis_warp.certify.case import Case
from oasis_warp.core.types import Camera
from oasis_warp.reference import posing, rasterization, visibility

Outputs = tuple[Tensor, ...]


@dataclass(frozen=True)
class Family:
    """An operator of `oasis_warp.ops`."""

    name: str
    outputs: tuple[str, ...]
    """Names of what `read` returns."""
    read: Callable[[Any], Outputs]
    """The operator's answer in a form whose error means something: float64, finite, the same for q and -q."""
    twin: Callable[[Case, dict[str, Any], float], tuple[Outputs, Outputs]]
    """The same from the twin, and for each output the elements (1 or 0, broadcast) that do not hang on rounding.

    Takes the case, its arguments in float64, and how much wider than for float32 rounding that is to be understood.
    """
    case: Callable[..., Case]
    """(condition, seed, ...) to a scene."""
    conditions: tuple[str, ...]
    large: dict[str, Any]
    """Arguments of `case` for a scene that work is shared out for, too large for the twin."""
    indices: dict[str, tuple[str, int]] = field(default_factory=dict)
    """Index arguments: the argument whose rows each names, and the least index."""
    smooth: Callable[[Case], bool] = bool
    """Whether a small step changes no decision of a scene but those that `twin` leaves out."""

    def call(self, arguments: dict[str, Any]) -> Any:
        """The operator, found at the time of the call."""
        return getattr(ops, self.name)(**arguments)

    def scene(self, seed: int) -> Case:
        """A scene of the grid: conditions take turns, all else is drawn from the seed."""
        return self.case(self.conditions[seed % len(self.conditions)], seed)


def squares(quats: Tensor) -> Tensor:
    """The products q q^T of quaternions [..., 4], which does not know their sign."""
    return quats[..., :, None] * quats[..., None, :]


def bounded(ratios: Tensor) -> Tensor:
    """Area ratios as they act on scales: of a face that was flat at rest, all further digits are rounding."""
    return ratios.clamp(1 / posing.LIMIT, posing.LIMIT)


def _read_rasterization(answer: Any) -> Outputs:
    return answer[0].double(), answer[1].double()


def _rasterization(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    image, alphas, fragile = rasterization.rasterization(**arguments, dense=True, slack=slack)
    keep = (~fragile)[..., None].double()
    return (image, alphas), (keep, keep)


def _read_depth_map(answer: Any) -> Outputs:
    # 1 / depth is 0 over the background; barycentrics are compared where the face is beyond doubt.
    return 1 / answer.depth.double(), answer.barycentrics.double()


def _depth_map(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    outputs, keep = [], []
    for single in singles(arguments):
        hits, known = _cast(single, slack)
        outputs.append((1 / hits.depth, hits.barycentrics))
        keep.append((known.sound.double(), known.clear[..., None].double()))
    return together(outputs, arguments), together(keep, arguments)


def _cast(arguments: dict[str, Any], slack: float) -> tuple[visibility.Hits, visibility.Certainty]:
    camera, near = _camera(arguments), arguments["near_plane"]
    rays = visibility.cast(arguments["vertices"], arguments["faces"], camera, near)
    hits = visibility.nearest_hits(rays, camera, near)
    return hits, visibility.certainty(rays, hits, arguments["faces"], camera, near, slack)


def _camera(arguments: dict[str, Any]) -> Camera:
    return Camera(*(arguments[name] for name in Camera._fields))


BATCHED = {"points": 2, "vertices": 2, "viewmat": 2, "K": 2}
"""Arguments of the depth buffer that may have a batch axis before so many others."""


def singles(arguments: dict[str, Any]) -> list[dict[str, Any]]:
    """The arguments for each entry of a batch."""
    n = max(len(v) if v.dim() > BATCHED[k] else 1 for k, v in arguments.items() if k in BATCHED)
    return [{k: v[i] if k in BATCHED and v.dim() > BATCHED[k] else v for k, v in arguments.items()} for i in range(n)]


def together(parts: list[Outputs], arguments: dict[str, Any]) -> Outputs:
    """What the entries of a batch gave, with a batch axis where an argument had one."""
    if any(arguments[k].dim() > n for k, n in BATCHED.items() if k in arguments):
        return tuple(torch.stack(same) for same in zip(*parts, strict=True))
    return parts[0]


def _read_depth_visibility(answer: Any) -> Outputs:
    return (answer.visibility.double(),)


def _depth_visibility(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    parts = [_single_visibility(single, slack) for single in singles(arguments)]
    return together([out for out, _ in parts], arguments), together([keep for _, keep in parts], arguments)


def _single_visibility(arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    camera, near, tau = _camera(arguments), arguments["near_plane"], arguments["tau"]
    literal = arguments.get("literal", False)
    named = None if literal else arguments.get("point_vertices")
    margin = 0.0 if literal else arguments.get("margin")
    hits, known = _cast(arguments, slack)
    points = arguments["points"]
    scores = visibility.score_points(points, hits, arguments["faces"], camera, tau, margin, named, near)
    keep = visibility.sound_points(points, known, camera, named is not None, near, slack)
    return (scores,), (keep.double(),)


def _read_face_rotations(answer: Any) -> Outputs:
    vertex_quats, face_quats, *ratios = (t.double() for t in answer)
    return squares(vertex_quats), squares(face_quats), *map(bounded, ratios)


def _face_rotations(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    vertex_quats, face_quats, *ratios, sound = posing.face_rotations(*arguments.values())
    every = torch.ones(()).double()
    keep = sound.double()[:, None, None], every, every, every
    return (squares(vertex_quats), squares(face_quats), *map(bounded, ratios)), keep


def _read_pose_on_mesh(answer: Any) -> Outputs:
    means, quats, scales = (t.double() for t in answer)
    return means, squares(quats), scales


def _pose_on_mesh(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    means, quats, scales = posing.pose_on_mesh(**arguments)
    with torch.no_grad():
        corners = arguments["faces"][arguments["face_index"]]
        dots = posing.dots_with_heaviest(arguments["vertex_quats"][corners], arguments["barycentrics"])
        aligned = (dots.abs() > slack * 1e-5).all(-1).double()
        aligned = torch.cat([torch.ones(len(quats) - len(aligned)), aligned])[:, None, None]
    every = torch.ones(()).double()
    return (means, squares(quats), scales), (every, aligned, every)


def _read_pose_on_mesh_covars(answer: Any) -> Outputs:
    return answer.means.double(), answer.covars.double()


def _pose_on_mesh_covars(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    every = torch.ones(()).double()
    return posing.pose_on_mesh_covars(**arguments), (every, every)


def _read_skin(answer: Any) -> Outputs:
    return tuple(t.double() for t in answer if t is not None)


def _skin(case: Case, arguments: dict[str, Any], slack: float) -> tuple[Outputs, Outputs]:
    return posing.skin(**arguments), tuple(torch.ones(()).double() for _ in range(1 + ("covars" in case.floats)))


LARGE_MESH = {"n": 1500, "size": (160, 120)}

FAMILIES = {
    family.name: family
    for family in (
        Family(
            "rasterization", ("image", "alphas"), _read_rasterization, _rasterization,
            rasterization_scenes.rasterization_case, tuple(rasterization_scenes.CONDITIONS),
            {"n": 5000, "size": (128, 96), "n_cameras": 2, "channels": 3, "mode": "RGB+ED", "spread": 0.25},
            smooth=rasterization_scenes.is_smooth,
        ),
        Family(
            "depth_map", ("1 / depth", "barycentrics"), _read_depth_map, _depth_map,
            mesh_scenes.depth_map_case, tuple(mesh_scenes.CONDITIONS), LARGE_MESH, {"faces": ("vertices", 0)},
        ),
        Family(
            "depth_visibility", ("visibility",), _read_depth_visibility, _depth_visibility,
            mesh_scenes.depth_visibility_case, tuple(mesh_scenes.CONDITIONS),
            LARGE_MESH | {"n_points": 5000}, {"faces": ("vertices", 0), "point_vertices": ("vertices", -1)},
        ),
        Family(
            "face_rotations", ("vertex_quats", "face_quats", "area_ratio", "vertex_area_ratio"),
            _read_face_rotations, _face_rotations,
            surface_scenes.face_rotations_case, tuple(surface_scenes.CONDITIONS), {"side": 50},
            {"faces": ("rest_vertices", 0)},
        ),
        Family(
            "pose_on_mesh", ("means", "quats", "scales"), _read_pose_on_mesh, _pose_on_mesh,
            surface_scenes.pose_on_mesh_case, tuple(surface_scenes.RIDERS),
            {"n": 10_000},
            {"faces": ("posed_vertices", 0), "face_index": ("area_ratio", 0), "vertex_index": ("posed_vertices", 0)},
        ),
        Family(
            "pose_on_mesh_covars", ("means", "covars"), _read_pose_on_mesh_covars, _pose_on_mesh_covars,
            surface_scenes.pose_on_mesh_covars_case, tuple(surface_scenes.CONDITIONS), {"side": 20, "n": 10_000},
            {"faces": ("rest_vertices", 0)},
        ),
        Family(
            "skin", ("means", "covars"), _read_skin, _skin,
            skinning_scenes.skin_case, tuple(skinning_scenes.CONDITIONS), {"n": 10_000, "n_joints": 16},
        ),
    )
}  # fmt: skip
