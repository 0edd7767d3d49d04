"""What the page of an avatar reads: facts and arrays, packed into text."""

import base64
import gzip
import json
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.creases import Creases
from oasis_warp.avatar.folds import Folds
from oasis_warp.avatar.sky import sky_mesh, studio_light
from oasis_warp.avatar.vertex_light import GAMMA, SurfaceLight
from oasis_warp.avatar.wrinkles import HUE
from oasis_warp.core import surface
from oasis_warp.core.camera import ORBIT_FIELD_OF_VIEW, ORBIT_MARGIN
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_points
from oasis_warp.core.types import Gaussians, HandPose
from oasis_warp.hand.contact import contact_tables
from oasis_warp.hand.poses import POSE_NAMES, pose_sequence
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops.sky_exposure import sky_directions

FINGERS = ("thumb", "index", "middle", "ring", "little")
JOINTS = {"thumb": ("Base", "Knuckle", "Tip")}
"""Names of a finger's three joints from the palm outwards; of the other fingers:"""
FINGER_JOINTS = ("Knuckle", "Middle", "Tip")
AXES = ("bend", "spread", "twist")
MIN_RANGE = math.radians(12)
"""Angles that can move less have no slider."""
WALK = ("open", "fist", "victory", "point", "ok")
"""Poses of the page's motion."""
BULK = (0.01, 0.99)
"""Quantiles of the means of foreign Gaussians, which the view frames: some float far away."""
SPLATS_RADIUS = 0.1
"""Radius that the framed Gaussians are scaled to [m]: that of a hand."""
WALK_FRAMES, WALK_SECONDS = 12, 7.5
"""Frames from one of them to the next, which the page blends, and length of the motion."""


NO_JOINT, STRETCH = 255, 254
"""Numbers of the joint of Gaussians that have no folds, and of those with creases, which depend on no joint."""
MAX_SHORTS, FEW_STEPS = 45, 63
"""Correctives that have 16 bits: three for each joint. MANO's 135 have so many steps to either side, to within .1 mm in
all: 16 bits would fill 13 MB of the page."""


class Packed(NamedTuple):
    """An array as whole numbers: value = number * step."""

    numbers: np.ndarray
    step: float


def page_facts(
    avatar: Avatar, angles: Float[Tensor, "15 3"] | None, look: str
) -> tuple[dict[str, Any], dict[str, np.ndarray | Packed]]:
    """Facts for the header of the page's data, and its arrays; both on the CPU.

    Args:
        avatar: Any.
        angles: Angles that the page begins with; those of the photo when not given.
        look: "photo" or "even" light to begin with; an avatar without light of its own begins in even light.
    """
    parts = avatar.parts
    poses = {"photo": avatar.source_pose.angles.cpu()}
    poses |= {name: avatar.held(name).angles.cpu() for name in POSE_NAMES}
    lights = {} if parts.light is None else {"photo": parts.light}
    in_studio = avatar.in_light(studio_light()).parts
    studio, folds, creases = in_studio.light, in_studio.folds, in_studio.creases
    assert studio is not None and folds is not None and creases is not None, "in_light gives them"
    lights["studio"] = studio
    begin = poses["photo"] if angles is None else angles.cpu()
    *reached, at_start = _reached(avatar, [*poses.values(), begin])
    everywhere = torch.cat(reached)
    middle = _middle(everywhere)
    walk = pose_sequence(avatar.hand, WALK, WALK_FRAMES, avatar.rest)
    facts = {
        "side": avatar.side,
        "parents": list(parts.hand.parents),
        "orientation": _flat(avatar.source_pose.orientation),
        "translation": _flat(avatar.source_pose.translation),
        "poses": [
            {"name": name, "label": _label(name), "angles": _flat(angles), "target": _flat(_middle(vertices))}
            for (name, angles), vertices in zip(poses.items(), reached, strict=True)
        ],
        "motions": [{"label": "Through poses", "seconds": WALK_SECONDS, "frames": [_flat(frame) for frame in walk]}],
        "joints": joint_sliders(parts.hand),
        "lights": {name: _light_facts(light) for name, light in lights.items()},
        "folds": {"straight": _flat(folds.straight), "photo": _flat(folds.photo)},
        "photoEye": None if studio.photo_eye is None else _flat(studio.photo_eye),
        "still": sky_mesh(torch.device("cpu")).still,
        "orbitMargin": ORBIT_MARGIN,
        "fieldOfView": ORBIT_FIELD_OF_VIEW,
        "frame": {"target": _flat(middle), "radius": float((everywhere - middle).norm(dim=-1).amax())},
        "start": {
            "pose": _name_of(begin, poses),
            "angles": _flat(begin),
            "target": _flat(_middle(at_start)),
            "look": look if look in lights else "even",
        },
        "hasInvented": avatar.invented is not None,
    }
    return facts, _arrays(avatar, studio if parts.light is None else parts.light, folds, creases)


def splat_facts(gaussians: Gaussians) -> tuple[dict[str, Any], dict[str, np.ndarray | Packed]]:
    """Facts and arrays of Gaussians that cannot be posed, moved and scaled as a hand lies in its page."""
    low, high = np.quantile(gaussians.means.numpy(), BULK, axis=0)
    middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    scale = SPLATS_RADIUS / size
    facts = {
        "poses": [], "motions": [], "joints": [], "lights": {}, "hasInvented": False,
        "orbitMargin": ORBIT_MARGIN, "fieldOfView": ORBIT_FIELD_OF_VIEW,
        "frame": {"target": [0, 0, 0], "radius": SPLATS_RADIUS},
        "start": {"pose": None, "angles": [], "target": [0, 0, 0], "look": "file"},
    }  # fmt: skip
    arrays: dict[str, np.ndarray | Packed] = {
        "means": ((gaussians.means.numpy() - middle) * scale).astype("<f4"),
        "quats": _pack(gaussians.quats, "i2", 1.0),
        "scales": _numpy(gaussians.scales * scale, "f4"),
        "opacities": _pack(gaussians.opacities, "u1", 1.0),
        "colors": _pack(gaussians.colors, "u1", 1.0),
    }
    return facts, arrays


def _name_of(angles: Tensor, poses: dict[str, Tensor]) -> str | None:
    return next((name for name, known in poses.items() if torch.allclose(angles, known.to(angles), atol=1e-6)), None)


def _label(name: str) -> str:
    return "OK" if name == "ok" else name.replace("_", " ").capitalize()


def _flat(values: Tensor) -> list[float]:
    return [round(value, 7) for value in values.detach().cpu().double().flatten().tolist()]


def _light_facts(light: SurfaceLight) -> dict[str, list[float] | None]:
    harmonics = light.light.harmonics.new_zeros(9, 3)
    harmonics[: len(light.light.harmonics)] = light.light.harmonics
    albedo = light.light.albedo
    return {
        "harmonics": _flat(harmonics),
        "limits": _flat(light.light.limits),
        "albedo": None if albedo is None else _flat(albedo),
    }


def joint_sliders(hand: HandModel) -> list[dict[str, Any]]:
    """A group of sliders a finger: index among the 45 angles, limits [rad], and what to add for anatomical angles."""
    groups = []
    for finger in FINGERS:
        sliders = []
        for k, joint_name in enumerate(JOINTS.get(finger, FINGER_JOINTS)):
            joint = hand.joint_names.index(f"{finger}{k + 1}")
            for axis, movement in enumerate(AXES):
                low, high = hand.pose_limits[joint, axis].tolist()
                if high - low < MIN_RANGE:
                    continue
                shown = joint_name if axis == 0 else movement.capitalize()
                rest = float(hand.rest_bend[joint]) if axis == 0 else 0.0
                index = 3 * (joint - 1) + axis
                sliders.append({"label": shown, "index": index, "low": low, "high": high, "rest": rest})
        groups.append({"finger": finger.capitalize(), "joints": sliders})
    return groups


@torch.no_grad()
def _reached(avatar: Avatar, angles: Sequence[Tensor]) -> Float[Tensor, "B V 3"]:
    source, many = avatar.source_pose, len(angles)
    poses = HandPose(
        torch.stack([each.to(avatar.shape) for each in angles]),
        source.orientation.expand(many, 3, 3),
        source.translation.expand(many, 3),
    )
    return avatar.mesh(poses).vertices


def _middle(vertices: Float[Tensor, "N 3"]) -> Float[Tensor, "3"]:
    """Middle of the box around the vertices; `orbit_camera` looks there."""
    return (vertices.amin(0) + vertices.amax(0)) / 2


@torch.no_grad()
def _arrays(avatar: Avatar, light: SurfaceLight, folds: Folds, creases: Creases) -> dict[str, np.ndarray | Packed]:
    hand, rest, gaussians, own_light, *_ = avatar.parts
    normals = surface.vertex_normals(avatar.rest.vertices, avatar.hand.faces)
    sky, mesh = sky_directions(torch.device("cpu")), sky_mesh(torch.device("cpu"))
    even = torch.ones(3) if own_light is None else own_light.light.even.cpu() ** (1 / GAMMA)
    correctives = hand.corrective_basis.permute(2, 0, 1)
    reach = correctives.abs().amax((1, 2))
    kind, steps = ("i1", FEW_STEPS) if len(correctives) > MAX_SHORTS else ("i2", np.iinfo("i2").max)
    contact = contact_tables(torch.device("cpu"))
    arrays: dict[str, np.ndarray | Packed] = {
        "vertices": _numpy(rest.vertices, "f4"),
        "faces": _numpy(hand.faces, "u2"),
        "weights": _weights(hand.weights),
        "correctives": _pack(correctives / reach.clamp_min(1e-9)[:, None, None], kind, np.iinfo(kind).max / steps),
        "reach": _numpy(reach, "f4"),
        "rim": _numpy(hand.rim, "u2"),
        "joints": _numpy(rest.joints, "f4"),
        "axes": _numpy(hand.pose_axes, "f4"),
        "normals": _pack(mirror_points(normals) if avatar.side == "left" else normals, "i2", 1.0),
        "contactMembers": _numpy(contact.members, "u2"),
        "contactStarts": _numpy(contact.starts, "u2"),
        "contactSamples": _numpy(contact.samples, "u2"),
        "contactAllowed": _numpy(contact.allowed, "i4"),
        "contactGive": _pack(contact.give, "u2"),
        "vertexIndex": _numpy(gaussians.vertex_index, "u2"),
        "offsets": _pack(gaussians.offsets, "i2"),
        "faceIndex": _numpy(gaussians.face_index, "u2"),
        "barycentrics": _pack(gaussians.barycentrics[:, :2], "u2", 1.0),
        "quats": _pack(torch.nn.functional.normalize(gaussians.quats, dim=-1), "i2", 1.0),
        "scales": _pack(gaussians.scales, "u2"),
        "opacities": _pack(gaussians.opacities, "u1", 1.0),
        "colors": _pack(gaussians.colors.clamp(0, 1), "u1", 1.0),
        "even": _numpy(even, "f4"),
        "skyVertices": _numpy(mesh.vertices, "u2"),
        "skyFaces": _numpy(mesh.faces, "u2"),
        "skyCorners": _numpy(mesh.corners.index, "u2"),
        "skyShares": _pack(mesh.corners.weights, "u2", 1.0),
        "skyDirections": _numpy(sky.directions, "f4"),
        "skyAxes": _numpy(sky.axes, "f4"),
        "skyWeights": _numpy(sky.weights, "f4"),
        "creaseAreas": _numpy(creases.areas, "f4"),
    }
    arrays |= _fold_arrays(folds, creases, len(gaussians.colors))
    if light.light.facing is not None:
        arrays["facing"] = _pack(light.light.facing, "i2", 1.0)
    if light.light.shade is not None:
        arrays["shade"] = _pack(light.light.shade, "u2")
    if light.light.doubt is not None:
        arrays["doubt"] = _pack(light.light.doubt, "u1", 1.0)
    if gaussians.shade is not None:
        arrays["fineShade"] = _pack(gaussians.shade, "u2")
    if light.seen is not None:
        arrays["seen"] = _pack(light.seen, "u2", 1.0)
    if avatar.invented is not None:
        arrays["invented"] = _pack(avatar.invented, "u1", 1.0)
    return arrays


def _fold_arrays(folds: Folds, creases: Creases, count: int) -> dict[str, np.ndarray | Packed]:
    """Folds and creases as values of all Gaussians: these have `STRETCH` as joint, those without either `NO_JOINT`."""
    change = folds.change.new_zeros(count, 3).index_copy(0, folds.index, folds.change)
    change = change.index_copy(0, creases.index, creases.change)
    wrinkles = creases.wrinkles.new_zeros(count, 3).index_copy(0, creases.index, creases.wrinkles)[:, 1]
    between = folds.between.new_zeros(count, 1).index_copy(0, folds.index, folds.between)
    joints = folds.joints.new_full((count, 2), NO_JOINT).index_copy(0, folds.index, folds.joints)
    joints = joints.index_fill(0, creases.index, STRETCH)
    return {
        "folds": _pack(change, "i1"), "foldJoints": _numpy(joints, "u1"), "foldBetween": _pack(between, "u1", 1.0),
        "wrinkles": _pack(wrinkles / HUE[1], "i1"),
    }  # fmt: skip


def _numpy(values: Tensor, kind: str) -> np.ndarray:
    return values.detach().cpu().numpy().astype(f"<{kind}")


def _pack(values: Tensor, kind: str, most: float | None = None) -> Packed:
    """Whole numbers up to the largest that `kind` holds, for `most`, or else the largest value.

    Raises:
        InputError: values lie beyond the numbers that `kind` holds, or are not finite.
    """
    array, limits = values.detach().cpu().double().numpy(), np.iinfo(kind)
    largest = float(np.abs(array).max(initial=0)) if most is None else most
    step = largest / limits.max if largest else 1.0
    numbers = np.rint(array / step)
    if not ((numbers >= limits.min) & (numbers <= limits.max)).all():
        expected = f"{limits.min * step:g} to {limits.max * step:g}"
        got = f"{array.min():g} to {array.max():g}"
        raise InputError(f"page: expected values from {expected}, got {got}; reconstruct the avatar again.")
    return Packed(numbers.astype(f"<{kind}"), step)


def _weights(weights: Tensor) -> Packed:
    """Rows that sum to one exactly: what rounding leaves goes to the heaviest."""
    whole = np.iinfo("u2").max
    numbers = np.rint(weights.detach().cpu().double().numpy() * whole).astype(np.int64)
    rows = np.arange(len(numbers))
    numbers[rows, numbers.argmax(1)] += whole - numbers.sum(1)
    return Packed(numbers.astype("<u2"), 1 / whole)


def pack_data(facts: dict[str, Any], arrays: dict[str, np.ndarray | Packed]) -> str:
    """Everything as base64 of gzip: length of the header (uint32), header (JSON), arrays at multiples of four bytes.

    All numbers are little-endian. The header holds `facts` and for each of `arrays` type, count, offset and step.
    """
    entries, blobs = {}, []
    for name, array in arrays.items():
        numbers = array.numbers if isinstance(array, Packed) else array
        entries[name] = {"type": numbers.dtype.str[1:], "count": numbers.size, "offset": 0}
        if isinstance(array, Packed):
            entries[name]["step"] = array.step
        data = np.ascontiguousarray(numbers).tobytes()
        blobs.append(data + bytes(-len(data) % 4))

    def header_of(first: int) -> bytes:
        offset = first
        for entry, blob in zip(entries.values(), blobs, strict=True):
            entry["offset"] = offset
            offset += len(blob)
        text = json.dumps({"facts": facts, "arrays": entries}, allow_nan=False, separators=(",", ":"))
        return text.encode()

    room = (len(header_of(0)) + 4096) // 4 * 4  # for the offsets' digits; filled with spaces
    header = header_of(4 + room).ljust(room)
    stream = len(header).to_bytes(4, "little") + header + b"".join(blobs)
    return base64.b64encode(gzip.compress(stream, compresslevel=6, mtime=0)).decode()


def unpack_data(text: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Facts and flat arrays, in their units, of what `pack_data` packed: what the page's script reads."""
    stream = gzip.decompress(base64.b64decode(text, validate=True))
    header = json.loads(stream[4 : 4 + int.from_bytes(stream[:4], "little")])
    arrays = {}
    for name, entry in header["arrays"].items():
        stored = np.frombuffer(stream, f"<{entry['type']}", entry["count"], entry["offset"])
        arrays[name] = stored * np.float64(entry["step"]) if "step" in entry else stored
    return header["facts"], arrays
