"""The avatar's skin as a glTF mesh with bones, pose correctives, texture and animations, for engines and Blender."""

import base64
import itertools
import json
import math
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp import __version__
from oasis_warp.core import rotation
from oasis_warp.data.output_files import write_file
from oasis_warp.export import texture
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.surface_mesh import SkinnedMesh, skinned_mesh
from oasis_warp.hand.poses import POSE_NAMES
from oasis_warp.hand.webxr_rig import Rig, local_bind, local_quats
from oasis_warp.hand_avatar import Avatar

AccessorType = Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT4"]
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
WIDTHS: dict[str, int] = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
MAX_FLOATS = 45
"""Correctives that are written as floats: three for each joint."""
KEYS, SECONDS = 8, 0.5
"""Steps and length of the way from one pose to the next; it eases in and out by half a cosine."""


class GltfBuffer:
    """The binary part of a glTF file, as it grows."""

    def __init__(self):
        self._data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, values: np.ndarray, kind: AccessorType, *, target: int | None = None, normalized: bool = False
    ) -> int:
        """Append a row for each element, of a type in `COMPONENTS`; the index of its accessor.

        Args:
            values: Rows; little-endian. Those of a VEC3 of bytes take four, since vertices begin at whole words.
            kind: What a row is.
            target: VERTICES or INDICES, for what a mesh draws.
            normalized: Whole numbers stand for [0, 1], or signed ones for [-1, 1].
        """
        stored = values
        if kind == "VEC3" and values.itemsize == 1:
            stored = np.pad(values, ((0, 0), (0, 1)))
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(np.ascontiguousarray(stored).tobytes(), target),
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "count": values.size // WIDTHS[kind],
            "type": kind,
        }
        if normalized:
            accessor["normalized"] = True
        if stored is not values:
            self.views[-1]["byteStride"] = 4
        if kind != "MAT4" and (not normalized or kind == "VEC3"):
            rows = values.reshape(-1, WIDTHS[kind])
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_bytes(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, an image for one; the index of their view."""
        self._data += bytes(-len(self._data) % 4)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self._data += data
        return len(self.views) - 1

    def data(self) -> bytes:
        """All of it, in whole words."""
        return bytes(self._data) + bytes(-len(self._data) % 4)


def write_gltf(path: Path, document: dict[str, Any], buffer: GltfBuffer) -> None:
    """Write a .glb, or with that ending a .gltf, whose buffer is text inside it, atomically.

    Args:
        path: Path of the file.
        document: The JSON without asset, buffers, views and accessors.
        buffer: What the document's accessors are of.

    Raises:
        InputError: `path` cannot be written.
    """
    binary = buffer.data()
    whole = {
        "asset": {"version": "2.0", "generator": f"oasis_warp {__version__}"},
        **document,
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    }
    if path.suffix.lower() == ".gltf":
        text = base64.b64encode(binary).decode()
        whole["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{text}"
        write_file(path, json.dumps(whole, allow_nan=False).encode())
        return
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(binary), BINARY_CHUNK) + binary
    write_file(path, struct.pack("<III", GLB_MAGIC, 2, 12 + len(chunks)) + chunks)


def write_skinned_gltf(request: ExportRequest, path: Path) -> None:
    """A mesh in metres, the wrist at the origin, y up, fingers to -z, on WebXR's joints; a clip for each named pose.

    Each clip leads from the rest pose to the one that it is named after; "poses" goes through all of them. Pose
    correctives are morph targets, which clips drive too. With baked light the material needs none.

    Vertices have two sets of four influences. Programs that read one set lose up to 13 % of a vertex's weight.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    buffer = GltfBuffer()
    made = skinned_mesh(request.avatar)
    first = 2  # node of the wrist
    nodes, bends = _joint_nodes(made.rig, first), [0.0] * len(made.correctives)
    if request.pose is not None:
        angles = request.pose.angles.to(made.points)
        bends = made.corrective_weights(angles).tolist()
        quats = local_quats(made.rig, made.hand, made.rest, angles[None], request.avatar.side)[0]
        for node, quat in zip(nodes, quats, strict=True):
            node["rotation"] = _xyzw(quat).tolist()
    mesh = {
        "name": "skin", "primitives": [_primitive(buffer, made)], "weights": bends,
        "extras": {"targetNames": made.corrective_names},
    }  # fmt: skip
    inverse = torch.linalg.inv(made.rig.bind).mT.flatten(1)
    skin = {"joints": [first + k for k in range(len(nodes))], "skeleton": first}
    document: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"name": "hand", "nodes": [0, 1]}],
        "nodes": [{"name": "hand", "children": [first]}, {"name": "skin", "mesh": 0, "skin": 0}, *nodes],
        "meshes": [mesh],
        "skins": [{**skin, "inverseBindMatrices": buffer.add(_array(inverse), "MAT4")}],
        **_material(buffer, texture.bake_material(request, texture.SIZE)),
        "animations": _clips(buffer, made, request.avatar),
    }
    if _packs(made):
        document.setdefault("extensionsUsed", []).append("KHR_mesh_quantization")
        document["extensionsRequired"] = ["KHR_mesh_quantization"]
    write_gltf(path, document, buffer)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy().astype("<f4")


def _xyzw(quats: Tensor) -> Tensor:
    return quats[..., [1, 2, 3, 0]]


def _primitive(buffer: GltfBuffer, made: SkinnedMesh) -> dict[str, Any]:
    place = torch.stack([made.mesh.uv[:, 0], 1 - made.mesh.uv[:, 1]], 1)  # glTF's v points down
    attributes = {
        "POSITION": buffer.add(_array(made.points), "VEC3", target=VERTICES),
        "NORMAL": buffer.add(_array(made.normals), "VEC3", target=VERTICES),
        "TEXCOORD_0": buffer.add(_array(place), "VEC2", target=VERTICES),
    }
    joints, weights = made.joints.numpy().astype("u1"), _array(made.weights)
    for k in range(joints.shape[1] // 4):
        part = slice(4 * k, 4 * k + 4)
        attributes[f"JOINTS_{k}"] = buffer.add(joints[:, part], "VEC4", target=VERTICES)
        attributes[f"WEIGHTS_{k}"] = buffer.add(weights[:, part], "VEC4", target=VERTICES)
    targets = [{"POSITION": _displacements(buffer, move, as_bytes=_packs(made))} for move in made.correctives]
    indices = buffer.add(made.mesh.faces.flatten().numpy().astype("<u4"), "SCALAR", target=INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0, "targets": targets}


def _packs(made: SkinnedMesh) -> bool:
    """Whether correctives are bytes: MANO's 135 would take 21 MB."""
    return len(made.correctives) > MAX_FLOATS


def _displacements(buffer: GltfBuffer, move: Tensor, *, as_bytes: bool) -> int:
    """Accessor of a corrective; as bytes in 127ths of a metre (KHR_mesh_quantization)."""
    moves = np.rint(127 * _array(move)).astype("i1") if as_bytes else _array(move)
    return buffer.add(moves, "VEC3", target=VERTICES, normalized=as_bytes)


def _joint_nodes(rig: Rig, first: int) -> list[dict[str, Any]]:
    local = local_bind(rig)
    nodes: list[dict[str, Any]] = [
        {
            "name": name,
            "translation": matrix[:3, 3].tolist(),
            "rotation": _xyzw(rotation.from_matrix(matrix[:3, :3])).tolist(),
        }
        for name, matrix in zip(rig.names, local, strict=True)
    ]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(first + joint)
    return nodes


def _material(buffer: GltfBuffer, pictures: dict[str, bytes]) -> dict[str, Any]:
    looks: dict[str, Any] = {"baseColorTexture": {"index": 0}, "metallicFactor": 0}
    material: dict[str, Any] = {"name": "skin", "pbrMetallicRoughness": looks}
    unlit = "normal" not in pictures
    if unlit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    else:
        material["normalTexture"], looks["metallicRoughnessTexture"] = {"index": 1}, {"index": 2}
    return {
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(len(pictures))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [
            {"name": name, "mimeType": "image/png", "bufferView": buffer.add_bytes(data)}
            for name, data in pictures.items()
        ],
        **({"extensionsUsed": ["KHR_materials_unlit"]} if unlit else {}),
    }


def clip_angles(avatar: Avatar) -> dict[str, Float[Tensor, "T 15 3"]]:
    """Joint angles [rad] of every clip, `KEYS` steps of `SECONDS` / `KEYS` from each pose to the next."""
    poses = {name: avatar.held(name).angles.cpu() for name in POSE_NAMES}
    rest, others = poses["rest"], [name for name in POSE_NAMES if name != "rest"]
    clips = {name: _eased([rest, poses[name]]) for name in others}
    return clips | {"poses": _eased([rest, *(poses[name] for name in others), rest])}


def _eased(stops: list[Tensor]) -> Float[Tensor, "T 15 3"]:
    frames = [stops[0]]
    for start, end in itertools.pairwise(stops):
        frames += [torch.lerp(start, end, 0.5 - 0.5 * math.cos(math.pi * k / KEYS)) for k in range(1, KEYS + 1)]
    return torch.stack(frames)


def _clips(buffer: GltfBuffer, made: SkinnedMesh, avatar: Avatar) -> list[dict[str, Any]]:
    hand, rig = made.hand, made.rig
    moving = [j for j, name in enumerate(rig.names) if rig.bones[j] and not name.endswith("tip")]
    clips = []
    for name, angles in clip_angles(avatar).items():
        times = buffer.add(np.arange(len(angles), dtype="<f4") * np.float32(SECONDS / KEYS), "SCALAR")
        quats = _array(_xyzw(local_quats(rig, hand, made.rest, angles, avatar.side)))
        bends = _array(made.corrective_weights(angles))
        outputs = [buffer.add(np.ascontiguousarray(quats[:, j]), "VEC4") for j in moving]
        targets = [{"node": 2 + j, "path": "rotation"} for j in moving] + [{"node": 1, "path": "weights"}]
        outputs.append(buffer.add(bends.ravel(), "SCALAR"))
        clips.append({
            "name": name,
            "samplers": [{"input": times, "output": output, "interpolation": "LINEAR"} for output in outputs],
            "channels": [{"sampler": k, "target": target} for k, target in enumerate(targets)],
        })  # fmt: skip
    return clips
