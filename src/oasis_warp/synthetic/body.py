"""The mesh that is rendered: the hand, a forearm, a sleeve, a wristband and a ring.

The topology never changes, so that all pictures can share a batch: what an image does not wear collapses to a point.
Vertices are those of the hand, then of the rows of the forearm (towards the elbow), sleeve, wristband and ring.
"""

import functools
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.core import surface
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.hand.template import bundled_hand

FINGERS = ("index", "middle", "little", "ring", "thumb")
"""In the order of their joints: finger k has joints 3 k + 1 to 3 k + 3."""
THUMB = FINGERS.index("thumb")

ARM_ROWS, ARM_LENGTH = 20, 0.30
"""Rings of the forearm, and its length [m]."""
SLEEVE_ROWS, BAND_ROWS = 28, 7
RING_COLUMNS, RING_ROWS = 48, 8
ATLAS_HAND_SHARE = 1024 / 1408
"""Share of the atlas's height that the hand's texture coordinates fill; the forearm lies above."""
ATLAS_ARM_BIAS = 0.7
"""The forearm's rows are denser by 1 + this at the wrist and by 1 - this at the elbow."""

SKIN, SLEEVE, BAND, RING = range(4)
"""Materials of faces."""
KNUCKLE_RISE = (2.0, 1.7, 0.8)
"""Height of each knuckle of a finger, from the palm outwards, bent by 90 degrees and for a strength of 1 [mm]."""


@dataclass(frozen=True)
class Bone:
    """A finger bone at rest [mm]."""

    origin: np.ndarray
    along: np.ndarray
    """To the next joint or the tip."""
    back: np.ndarray
    side: np.ndarray
    length: float

    def local(self, points: np.ndarray) -> np.ndarray:
        """Coordinates along, to the side and to the back [mm]."""
        return (points - self.origin) @ np.stack([self.along, self.side, self.back], 1)


def _bone(hand: HandModel, finger: int, place: int) -> Bone:
    joint = 3 * finger + 1 + place
    start = hand.joints[joint].double().numpy() * 1e3
    end = hand.joints[joint + 1] if place < 2 else hand.tips[TIP_JOINTS.index(joint)]
    along = end.double().numpy() * 1e3 - start
    length = float(np.linalg.norm(along))
    along = along / length
    back = hand.pose_axes[joint, 1].double().numpy()
    back = back - along * (back @ along)
    back /= np.linalg.norm(back)
    return Bone(start, along, back, np.cross(back, along), length)


def finger_bones(hand: HandModel) -> tuple[tuple[Bone, ...], ...]:
    """Three of each of `FINGERS`."""
    return tuple(tuple(_bone(hand, finger, place) for place in range(3)) for finger in range(len(FINGERS)))


def rising(values: np.ndarray, start: float, end: float) -> np.ndarray:
    """Smoothly from 0 at `start` to 1 at `end`."""
    t = np.clip((values - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def knuckle_rise(points: np.ndarray, normals: np.ndarray, bones: tuple[tuple[Bone, ...], ...]) -> np.ndarray:
    """How far each knuckle bent by 90 degrees pushes points of the surface out along their normals [mm], [V, 15]."""
    out = np.zeros((len(points), 15))
    for finger, of_finger in enumerate(bones):
        for place, bone in enumerate(of_finger):
            if FINGERS[finger] == "thumb" and place == 0:  # lies deep in the hand
                continue
            along, side, back = bone.local(points).T
            width, length = (7.5, 7.0) if place == 0 else (6.0, 5.0)
            shape = np.exp(-((side / width) ** 2) - ((along - 0.5) / length) ** 2) * (np.abs(side) < 14) * (back > 0)
            out[:, 3 * finger + place] = KNUCKLE_RISE[place] * rising(normals @ bone.back, 0.15, 0.8) * shape
    return out


def _tube_faces(rows: np.ndarray) -> np.ndarray:
    """Two triangles for each cell between rows of vertex indices [R, C], each row closed to a ring."""
    return _grid_faces(np.concatenate([rows, rows[:, :1]], 1))


def _grid_faces(rows: np.ndarray) -> np.ndarray:
    """Two triangles for each cell between rows of vertex indices [R, C]."""
    a, b = rows[:-1], rows[1:]
    quads = np.stack([a[:, :-1], b[:, :-1], b[:, 1:], a[:, 1:]], -1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], 1).reshape(-1, 3)


@dataclass(frozen=True)
class Body:
    """Topology, texture coordinates and labels. See `bundled_body`."""

    hand: HandModel
    faces: Int[Tensor, "F 3"]
    materials: Int[Tensor, "F"]
    """int32: SKIN, SLEEVE, BAND or RING."""
    uv: Float[Tensor, "U 2"]
    """Texture coordinates of hand and forearm, in [0, 1]."""
    uv_faces: Int[Tensor, "S 3"]
    """Texture corners of the faces of skin; these faces come first."""
    n_hand_faces: int
    n_vertices: int
    rest: Float[Tensor, "K 3"]
    """Hand and forearm at rest, mean shape [mm]."""
    normals: Float[Tensor, "K 3"]
    palm: Float[Tensor, "K"]
    """0 on the back, 1 on the palm, soft between."""
    finger_weights: Float[Tensor, "K 5"]
    """Share of each finger's joints in the skinning."""
    bones: tuple[tuple[Bone, ...], ...]
    """[finger][place]."""
    skin_faces: Int[Tensor, "S 3"]
    """Faces of hand and forearm: the first of `faces`."""
    coarse_vertices: Int[Tensor, "C"]
    """Vertices of a coarse mesh of hand and forearm, which occludes the sky. Built by
    `asset_build/build_coarse_meshes.py`."""
    coarse_faces: Int[Tensor, "G 3"]
    knuckle_rise: Float[Tensor, "V 15"]
    """Displacement of the hand's vertices along their normals, for each joint of a finger bent by 90 degrees [m]."""

    @property
    def n_hand(self) -> int:
        """Vertices of the hand."""
        return len(self.hand.template)

    def to(self, device: torch.device | str) -> "Body":
        """The same body on another device; the bones stay numpy arrays."""
        moved = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: v.to(device) for k, v in moved.items() if isinstance(v, Tensor | HandModel)})


def arm_rows(
    rim: Float[Tensor, "B C 3"], rotations: Float[Tensor, "B R 3 3"], girth: Float[Tensor, "B"]
) -> Float[Tensor, "B R C 3"]:
    """The rings of the forearm from the wrist's rim to the elbow, along +x when straight [m].

    Args:
        rim: The hand's open end.
        rotations: Rotation of each ring about the middle of the rim.
        girth: How much thicker the forearm is than the wrist, about 0.35.
    """
    center = rim.mean(1, keepdim=True)
    s = torch.linspace(0, 1, ARM_ROWS + 1, device=rim.device)[1:, None]
    swell = smoothstep(0.02, 0.75, s)
    flat = 1 - smoothstep(0.0, 0.4, s)  # the rim is not planar
    around = (rim - center)[:, None]
    grow = girth[:, None, None] * swell
    rows = torch.stack(
        [around[..., 0] * flat + ARM_LENGTH * s, around[..., 1] * (1 + grow), around[..., 2] * (1 + 1.15 * grow)], -1
    )
    return torch.einsum("brij,brcj->brci", rotations, rows) + center[:, None]


def smoothstep(low: float, high: float, x: Tensor) -> Tensor:
    """0 at `low`, 1 at `high`, which may be the smaller one; flat at both ends."""
    t = ((x - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


class SkinMesh(NamedTuple):
    """Hand and forearm at rest, mean shape."""

    rest: Float[Tensor, "K 3"]
    """Vertices [m], the hand's first."""
    faces: Int[Tensor, "S 3"]
    uv: Float[Tensor, "U 2"]
    uv_faces: Int[Tensor, "S 3"]


def skin_mesh(hand: HandModel) -> SkinMesh:
    """The hand with a forearm, and their texture coordinates."""
    n, rim = len(hand.template), hand.rim.numpy()
    columns = len(rim)
    arm = n + np.arange(ARM_ROWS * columns).reshape(ARM_ROWS, columns)
    arm_faces = _tube_faces(np.concatenate([rim[None], arm]))
    grid = len(hand.uv) + np.arange((ARM_ROWS + 1) * (columns + 1)).reshape(ARM_ROWS + 1, columns + 1)
    arm_uv_faces = _grid_faces(grid)
    s = np.linspace(0, 1, ARM_ROWS + 1)
    rise = 0.006 + (1 - ATLAS_HAND_SHARE - 0.012) * (s + ATLAS_ARM_BIAS * s * (1 - s))
    u, v = np.meshgrid(np.linspace(0.01, 0.99, columns + 1), ATLAS_HAND_SHARE + rise)
    uv = np.concatenate([hand.uv.numpy() * [1, ATLAS_HAND_SHARE], np.stack([u, v], -1).reshape(-1, 2)])

    eye = torch.eye(3).expand(1, ARM_ROWS, 3, 3)
    rows = arm_rows(hand.template[hand.rim][None], eye, torch.tensor([0.4]))[0]
    rest = torch.cat([hand.template, rows.reshape(-1, 3)])
    corners = rest.numpy()[arm_faces[len(arm_faces) // 2]]
    outward = corners[0] - rows[ARM_ROWS // 2].mean(0).numpy()
    if np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ outward < 0:
        arm_faces, arm_uv_faces = arm_faces[:, ::-1], arm_uv_faces[:, ::-1]
    return SkinMesh(
        rest,
        torch.from_numpy(np.concatenate([hand.faces.numpy(), arm_faces])),
        torch.from_numpy(uv).float(),
        torch.from_numpy(np.concatenate([hand.uv_faces.numpy(), arm_uv_faces])),
    )


@functools.cache
def bundled_body() -> Body:
    """The bundled hand with forearm and clothes, on the CPU."""
    hand = bundled_hand()
    n, columns = len(hand.template), len(hand.rim)
    rest, skin, uv, uv_faces = skin_mesh(hand)

    first = len(rest)
    worn, materials = [], [np.full(len(skin), SKIN)]
    for material, n_rows, n_columns in ((SLEEVE, SLEEVE_ROWS, columns), (BAND, BAND_ROWS, columns),
                                        (RING, RING_ROWS, RING_COLUMNS)):  # fmt: skip
        rows_of = first + np.arange(n_rows * n_columns).reshape(n_rows, n_columns)
        first += rows_of.size
        if material == RING:  # closed across, too
            rows_of = np.concatenate([rows_of, rows_of[:1]])
        worn.append(_tube_faces(rows_of))
        materials.append(np.full(len(worn[-1]), material))

    normals = surface.vertex_normals(rest, skin)
    edges = surface.mesh_edges(skin)
    toward = torch.cat([0.5 - 0.5 * torch.cos(hand.bone_theta), 0.5 - 0.5 * normals[n:, 1]])
    palm = surface.smooth_over_mesh(toward[:, None], edges, 5)[:, 0]
    weights = torch.cat([hand.weights, torch.eye(16)[:1].expand(len(rest) - n, 16)])
    bones = finger_bones(hand)
    rise = knuckle_rise(rest[:n].double().numpy() * 1e3, normals[:n].double().numpy(), bones)
    by_finger = torch.stack([weights[:, 3 * k + 1 : 3 * k + 4].sum(1) for k in range(5)], 1)
    with asset("synthetic", "coarse_body.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        coarse_vertices, coarse_faces = (torch.from_numpy(stored[k].astype(np.int64)) for k in ("vertices", "faces"))
    return Body(
        hand=hand,
        coarse_vertices=coarse_vertices,
        coarse_faces=coarse_faces,
        faces=torch.from_numpy(np.concatenate([skin.numpy(), *worn])),
        skin_faces=skin,
        materials=torch.from_numpy(np.concatenate(materials)).to(torch.int32),
        uv=uv,
        uv_faces=uv_faces,
        n_hand_faces=len(hand.faces),
        n_vertices=first,
        rest=rest * 1e3,
        normals=normals,
        palm=palm,
        finger_weights=by_finger,
        bones=bones,
        knuckle_rise=torch.from_numpy(rise * 1e-3).float(),
    )


def device_name(device: torch.device | str) -> str:
    """The canonical name of a device: "cuda" becomes the name of the current GPU."""
    device = torch.device(device)
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    return str(device)


@functools.cache
def body_on(device: str) -> Body:
    """`bundled_body` on the device with this `device_name`; always the same object."""
    return bundled_body().to(device)
