"""Readers of splat files and players of glTF, in numpy, from the specifications alone; some are those of `oasis view`.

Readers return means, quats (wxyz), scales, opacities and colours, with y up. A player does what a glTF program does
with a skinned mesh: it plays a clip and moves the vertices.
"""

import base64
import json
import struct
import zipfile
from importlib.util import find_spec

import cv2
import numpy as np
import torch

from oasis_warp.data.splat_files import _ply_elements, read_splats

C0 = 0.28209479177387814
UP = np.array([1, -1, -1])


def turned_up(means, quats):
    """Half a turn about x: (0, 1, 0, 0) times each quaternion."""
    w, x, y, z = quats.T
    return means * UP, np.stack([-x, w, -z, y], 1)


def fill_in(largest, others):
    quats = np.zeros((len(others), 4))
    quats[np.arange(4) != largest[:, None]] = others.ravel()
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    return quats


def read_as_view_does(path):
    means, quats, *others = (part.double().numpy() for part in read_splats(path))
    return *turned_up(means, quats), *others


def read_harmonics(path):
    """Spherical harmonics of degree 3 in a .ply, [N, 16, 3]; those of red come first in a row."""
    rows = _ply_elements(path.read_bytes())["vertex"]
    first, rest = (np.stack([rows[f"f_{kind}_{k}"] for k in range(n)], 1) for kind, n in (("dc", 3), ("rest", 45)))
    return torch.from_numpy(np.concatenate([first[:, None], rest.reshape(-1, 3, 15).transpose(0, 2, 1)], 1)).float()


def read_sog(path):
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    assert meta["version"] == 2

    def pixels(name, k=0):
        data = np.frombuffer(files[meta[name]["files"][k]], np.uint8)
        picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
        order = [2, 1, 0, 3][: picture.shape[2]]
        return picture[..., order].reshape(-1, len(order))[: meta["count"]].astype(np.int64)

    share = (pixels("means", 0) + 256 * pixels("means", 1)) / 65535
    least, most = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    places = least + share * (most - least)
    turns, looks = pixels("quats"), pixels("sh0")
    quats = fill_in(turns[:, 3] - 252, (turns[:, :3] / 255 - 0.5) * np.sqrt(2))
    means, quats = turned_up(np.sign(places) * np.expm1(np.abs(places)), quats)
    scales = np.exp(np.array(meta["scales"]["codebook"])[pixels("scales")])
    return means, quats, scales, looks[:, 3] / 255, 0.5 + C0 * np.array(meta["sh0"]["codebook"])[looks[:, :3]]


def read_gltf(path):
    """The JSON and the buffer of a .glb or a .gltf in one file."""
    data = path.read_bytes()
    if data[:4] != b"glTF":
        document = json.loads(data)
        head, text = document["buffers"][0]["uri"].split(",")
        assert head == "data:application/octet-stream;base64"
        return document, base64.b64decode(text)
    version, length, n_json, kind = struct.unpack("<IIII", data[4:20])
    assert (version, length, kind) == (2, len(data), 0x4E4F534A)
    n_binary, kind = struct.unpack("<II", data[20 + n_json : 28 + n_json])
    assert kind == 0x004E4942 and len(data) == 28 + n_json + n_binary
    return json.loads(data[20 : 20 + n_json]), data[28 + n_json :]


def accessor(document, binary, index):
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    dtype = {5120: "i1", 5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[entry["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry["type"]]
    stride = view.get("byteStride", width * np.dtype(dtype).itemsize)
    assert entry["count"] * stride == view["byteLength"]
    rows = np.frombuffer(binary, "u1", view["byteLength"], view["byteOffset"]).reshape(-1, stride)
    values = np.ascontiguousarray(rows[:, : width * np.dtype(dtype).itemsize]).view(dtype)
    return np.maximum(values / 127, -1) if dtype == "i1" else values  # signed bytes are normalised


def read_splat_gltf(path):
    document, binary = read_gltf(path)
    (primitive,) = document["meshes"][0]["primitives"]
    name = "KHR_gaussian_splatting"
    assert document["extensionsUsed"] == [name] and primitive["mode"] == 0
    assert primitive["extensions"][name]["colorSpace"] == "srgb_rec709_display"
    part = {key: accessor(document, binary, index) for key, index in primitive["attributes"].items()}
    means, quats = part["POSITION"], part[f"{name}:ROTATION"]
    scales, opacities = part[f"{name}:SCALE"], part[f"{name}:OPACITY"]
    colors = part[f"{name}:SH_DEGREE_0_COEF_0"]
    return means, quats[:, [3, 0, 1, 2]], scales, opacities[:, 0], 0.5 + C0 * colors


READERS = {
    **dict.fromkeys(
        (".ply", ".compressed.ply", ".splat", ".spz", *((".v4.spz",) if find_spec("zstandard") else ())),
        read_as_view_does,
    ),
    ".sog": read_sog,
    ".splats.glb": read_splat_gltf,
    ".splats.gltf": read_splat_gltf,
}


def matrix_of(node):
    x, y, z, w = node.get("rotation", [0, 0, 0, 1])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def joint_matrices(document, nodes):
    """World matrices of all nodes."""
    world = {}

    def walk(index, above):
        world[index] = above @ matrix_of(nodes[index])
        for child in nodes[index].get("children", []):
            walk(child, world[index])

    for root in document["scenes"][document["scene"]]["nodes"]:
        walk(root, np.eye(4))
    return world


def pose_of_clip(document, binary, name):
    """Nodes and morph weights at the end of a clip."""
    nodes = [dict(node) for node in document["nodes"]]
    (clip,) = [clip for clip in document["animations"] if clip["name"] == name]
    weights = document["meshes"][0]["weights"]
    for channel in clip["channels"]:
        sampler = clip["samplers"][channel["sampler"]]
        times, values = (accessor(document, binary, sampler[end]) for end in ("input", "output"))
        last = values.reshape(len(times), -1)[-1].astype(float)
        if channel["target"]["path"] == "weights":
            weights = last
        else:
            nodes[channel["target"]["node"]][channel["target"]["path"]] = last
    return nodes, weights


def play(document, binary, nodes, weights, sets=2):
    """Vertices of the skinned mesh, read with `sets` sets of four influences."""
    (primitive,) = document["meshes"][0]["primitives"]
    part = {key: accessor(document, binary, index) for key, index in primitive["attributes"].items()}
    points = part["POSITION"].astype(float)
    for weight, target in zip(weights, primitive["targets"], strict=True):
        points = points + weight * accessor(document, binary, target["POSITION"])
    skin = document["skins"][0]
    inverse = accessor(document, binary, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    world = joint_matrices(document, nodes)
    bones = np.stack([world[node] for node in skin["joints"]]) @ inverse
    joints = np.concatenate([part[f"JOINTS_{k}"] for k in range(sets)], 1)
    shares = np.concatenate([part[f"WEIGHTS_{k}"] for k in range(sets)], 1).astype(float)
    shares /= shares.sum(1, keepdims=True)
    blended = (shares[..., None, None] * bones[joints]).sum(1)
    return (blended @ np.concatenate([points, np.ones((len(points), 1))], 1)[..., None])[:, :3, 0]
