"""The avatar's skin as a glTF mesh with bones, pose correctives, texture and animations, for engines and Blender."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Side
from oasis_warp.export import texture
from oasis_warp.export.gltf import INDICES, VERTICES, GltfBuffer, write_gltf
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.surface_mesh import SkinnedMesh, skinned_mesh
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.webxr_rig import Rig, local_bind, local_quats

MAX_FLOATS = 45
"""Correctives that are written as floats: three for each joint."""
KEYS, SECONDS = 8, 0.5
"""Steps and length of the way from one pose to the next; it eases in and out by half a cosine."""


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
        "animations": _clips(buffer, made, request.avatar.side),
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


def clip_angles(hand: HandModel) -> dict[str, Float[Tensor, "T 15 3"]]:
    """Joint angles [rad] of every clip, `KEYS` steps of `SECONDS` / `KEYS` from each pose to the next."""
    poses = {name: named_pose(hand, name) for name in POSE_NAMES}
    rest, others = poses["rest"], [name for name in POSE_NAMES if name != "rest"]
    clips = {name: _eased([rest, poses[name]]) for name in others}
    return clips | {"poses": _eased([rest, *(poses[name] for name in others), rest])}


def _eased(stops: list[Tensor]) -> Float[Tensor, "T 15 3"]:
    frames = [stops[0]]
    for start, end in itertools.pairwise(stops):
        frames += [torch.lerp(start, end, 0.5 - 0.5 * math.cos(math.pi * k / KEYS)) for k in range(1, KEYS + 1)]
    return torch.stack(frames)


def _clips(buffer: GltfBuffer, made: SkinnedMesh, side: Side) -> list[dict[str, Any]]:
    hand, rig = made.hand, made.rig
    moving = [j for j, name in enumerate(rig.names) if rig.bones[j] and not name.endswith("tip")]
    clips = []
    for name, angles in clip_angles(hand).items():
        times = buffer.add(np.arange(len(angles), dtype="<f4") * np.float32(SECONDS / KEYS), "SCALAR")
        quats = _array(_xyzw(local_quats(rig, hand, made.rest, angles, side)))
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
