"""The avatar's skin as a glTF mesh with bones, pose correctives, texture and animations, for engines and Blender."""

import itertools
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import PosedHand
from oasis_warp.export import texture
from oasis_warp.export.gltf import INDICES, VERTICES, GltfBuffer, write_gltf
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.surface_mesh import Topology, at_mesh, mesh_normals, mesh_points, model_of, topology
from oasis_warp.export.webxr_rig import TO_WEBXR, Rig, local_bind, local_quats, webxr_rig
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import corrective_coefficients
from oasis_warp.hand_avatar import Avatar

INFLUENCES = 8
"""Joints that move a vertex, in two sets of four, the stronger ones first; of the bundled hand's vertices all have
fewer. Programs that read one set lose up to 13 % of a vertex's weight."""
ROUGHNESS = 0.5
"""Of the material: between dry and oily skin, whose highlight glTF's model has no more parameters for."""
KEYS, SECONDS = 8, 0.5
"""Steps and length of the way from one pose to the next; it eases in and out by half a cosine."""


def write_skinned_gltf(request: ExportRequest, path: Path) -> None:
    """A mesh in metres, the wrist at the origin, y up, fingers to -z, on WebXR's joints; a clip for each named pose.

    Each clip leads from the rest pose to the one that it is named after; "poses" goes through all of them. Pose
    correctives are morph targets, which clips drive too. With baked light the material needs none.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    avatar, buffer = request.avatar, GltfBuffer()
    light = request.light or "none"
    hand, rest = model_of(avatar)
    rig, mesh = webxr_rig(hand, rest, avatar.side), topology(avatar)
    first = 2  # node of the wrist
    joints = list(range(first, first + len(rig.names)))
    inverse = torch.linalg.inv(rig.bind).mT.flatten(1)
    geometry = _primitive(buffer, avatar, hand, rest, rig, mesh)
    pose_weights, nodes = [0.0] * hand.corrective_basis.shape[2], _joint_nodes(rig, first)
    if request.pose is not None:
        angles = request.pose.angles.to(rest.joints)
        pose_weights = corrective_coefficients(hand, angles).tolist()
        for node, quat in zip(nodes, local_quats(rig, hand, rest, angles[None], avatar.side)[0], strict=True):
            node["rotation"] = _xyzw(quat).tolist()
    bends = [f"{name} bend{power}" for name in hand.joint_names[1:] for power in ("", " squared")]
    document: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"name": "hand", "nodes": [0, 1]}],
        "nodes": [
            {"name": "hand", "children": [first]},
            {"name": "skin", "mesh": 0, "skin": 0},
            *nodes,
        ],
        "meshes": [
            {"name": "skin", "primitives": [geometry], "weights": pose_weights, "extras": {"targetNames": bends}}
        ],
        "skins": [{"joints": joints, "skeleton": first, "inverseBindMatrices": buffer.add(_array(inverse), "MAT4")}],
        **_material(buffer, texture.bake_texture(request, light, texture.SIZE), unlit=light == "baked"),
        "animations": _clips(buffer, hand, rest, rig, avatar.side),
    }
    write_gltf(path, document, buffer)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy().astype("<f4")


def _xyzw(quats: Tensor) -> Tensor:
    return quats[..., [1, 2, 3, 0]]


def _primitive(
    buffer: GltfBuffer, avatar: Avatar, hand: HandModel, rest: PosedHand, rig: Rig, mesh: Topology
) -> dict[str, Any]:
    to_file = torch.tensor(TO_WEBXR[avatar.side]).to(rest.vertices)
    points = mesh_points(rest.vertices, hand, mesh) @ to_file.T
    joint_of_bone = torch.tensor([rig.bones.index(bone) for bone in range(len(hand.parents))])  # the first, no tip
    strongest = at_mesh(hand.weights, mesh).topk(INFLUENCES, dim=1)
    weights = strongest.values / strongest.values.sum(1, keepdim=True)
    joints = torch.where(weights > 0, joint_of_bone[strongest.indices], 0).numpy().astype("u1")
    attributes = {
        "POSITION": buffer.add(_array(points), "VEC3", target=VERTICES),
        "NORMAL": buffer.add(_array(mesh_normals(points, mesh)), "VEC3", target=VERTICES),
        "TEXCOORD_0": buffer.add(_array(torch.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], 1)), "VEC2", target=VERTICES),
    }
    for k in range(INFLUENCES // 4):
        part = slice(4 * k, 4 * k + 4)
        attributes[f"JOINTS_{k}"] = buffer.add(joints[:, part], "VEC4", target=VERTICES)
        attributes[f"WEIGHTS_{k}"] = buffer.add(_array(weights[:, part]), "VEC4", target=VERTICES)
    moves = at_mesh(hand.corrective_basis, mesh).permute(2, 0, 1) @ to_file.T
    targets = [{"POSITION": buffer.add(_array(move), "VEC3", target=VERTICES)} for move in moves]
    indices = buffer.add(mesh.faces.flatten().numpy().astype("<u4"), "SCALAR", target=INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0, "targets": targets}


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


def _material(buffer: GltfBuffer, picture: Tensor, *, unlit: bool) -> dict[str, Any]:
    _, png = cv2.imencode(".png", cv2.cvtColor(picture.numpy(), cv2.COLOR_RGB2BGR), (cv2.IMWRITE_PNG_COMPRESSION, 9))
    looks = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": ROUGHNESS}
    material: dict[str, Any] = {"name": "skin", "pbrMetallicRoughness": looks}
    if unlit:
        material["extensions"] = {"KHR_materials_unlit": {}}
    return {
        "materials": [material],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"name": "skin", "mimeType": "image/png", "bufferView": buffer.add_bytes(png.tobytes())}],
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


def _clips(buffer: GltfBuffer, hand: HandModel, rest: PosedHand, rig: Rig, side: str) -> list[dict[str, Any]]:
    moving = [j for j, name in enumerate(rig.names) if rig.bones[j] and not name.endswith("tip")]
    clips = []
    for name, angles in clip_angles(hand).items():
        times = buffer.add(np.arange(len(angles), dtype="<f4") * np.float32(SECONDS / KEYS), "SCALAR")
        quats = _array(_xyzw(local_quats(rig, hand, rest, angles, side)))
        bends = _array(torch.stack([corrective_coefficients(hand, frame) for frame in angles]))
        outputs = [buffer.add(np.ascontiguousarray(quats[:, j]), "VEC4") for j in moving]
        targets = [{"node": 2 + j, "path": "rotation"} for j in moving] + [{"node": 1, "path": "weights"}]
        outputs.append(buffer.add(bends.ravel(), "SCALAR"))
        clips.append({
            "name": name,
            "samplers": [{"input": times, "output": output, "interpolation": "LINEAR"} for output in outputs],
            "channels": [{"sampler": k, "target": target} for k, target in enumerate(targets)],
        })  # fmt: skip
    return clips
