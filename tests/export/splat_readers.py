"""Readers of splat files, written from the formats' descriptions alone, in numpy.

Each returns means, quats (wxyz), scales, opacities and colours, with y up.
"""

import base64
import gzip
import json
import struct
import zipfile

import cv2
import numpy as np

C0 = 0.28209479177387814
UP = np.array([1, -1, -1])
TYPES = {"float": "<f4", "uint": "<u4"}


def read_elements(path):
    """The elements of a binary PLY, each with its columns by name."""
    head, data = path.read_bytes().split(b"end_header\n", 1)
    first, second, *lines = head.decode("ascii").splitlines()
    assert (first, second) == ("ply", "format binary_little_endian 1.0")
    elements, layout = {}, []
    for line in lines:
        word, *rest = line.split()
        if word == "element":
            layout.append((rest[0], int(rest[1]), []))
        else:
            assert word == "property"  # no comments
            layout[-1][2].append((rest[1], TYPES[rest[0]]))
    for name, count, columns in layout:
        elements[name] = np.frombuffer(data, np.dtype(columns), count)
        data = data[elements[name].nbytes :]
    assert not data
    return elements


def columns(table, *names):
    return np.stack([table[name].astype(float) for name in names], 1)


def turned_up(means, quats):
    """Half a turn about x: (0, 1, 0, 0) times each quaternion."""
    w, x, y, z = quats.T
    return means * UP, np.stack([-x, w, -z, y], 1)


def read_ply(path):
    table = read_elements(path)["vertex"]
    means, quats = turned_up(columns(table, *"xyz"), columns(table, *(f"rot_{k}" for k in range(4))))
    scales = np.exp(columns(table, *(f"scale_{k}" for k in range(3))))
    opacities = 1 / (1 + np.exp(-table["opacity"].astype(float)))
    return means, quats, scales, opacities, 0.5 + C0 * columns(table, *(f"f_dc_{k}" for k in range(3)))


def unpack(words, *bits):
    parts, shift = [], sum(bits)
    for n in bits:
        shift -= n
        parts.append((words >> np.uint32(shift) & np.uint32((1 << n) - 1)) / ((1 << n) - 1))
    return np.stack(parts, 1)


def fill_in(largest, others):
    quats = np.zeros((len(others), 4))
    quats[np.arange(4) != largest[:, None]] = others.ravel()
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    return quats


def read_compressed_ply(path):
    elements = read_elements(path)
    packed, chunk = elements["vertex"], elements["chunk"][np.arange(len(elements["vertex"])) // 256]

    def placed(shares, *names):
        least, most = (columns(chunk, *(f"{end}_{name}" for name in names)) for end in ("min", "max"))
        return least + shares * (most - least)

    turns = unpack(packed["packed_rotation"], 2, 10, 10, 10)
    quats = fill_in(np.round(3 * turns[:, 0]).astype(int), (turns[:, 1:] - 0.5) * np.sqrt(2))
    means, quats = turned_up(placed(unpack(packed["packed_position"], 11, 10, 11), *"xyz"), quats)
    scales = np.exp(placed(unpack(packed["packed_scale"], 11, 10, 11), "scale_x", "scale_y", "scale_z"))
    rgba = unpack(packed["packed_color"], 8, 8, 8, 8)
    return means, quats, scales, rgba[:, 3], placed(rgba[:, :3], *"rgb")


def read_splat(path):
    rows = np.fromfile(path, np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]))
    quats = (rows["quat"].astype(float) - 128) / 128
    means, quats = turned_up(rows["mean"], quats / np.linalg.norm(quats, axis=1, keepdims=True))
    return means, quats, rows["scales"], rows["rgba"][:, 3] / 255, rows["rgba"][:, :3] / 255


def read_spz(path):
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, degree, flags, reserved) == (0x5053474E, 3, 0, 0, 0)
    parts, start = [], 16
    for width in (9, 1, 3, 3, 4):
        parts.append(np.frombuffer(data, np.uint8, count * width, start).reshape(count, width).astype(np.int64))
        start += count * width
    assert start == len(data)
    places, opacities, colors, scales, turns = parts
    means = places.reshape(count, 3, 3) @ [1, 1 << 8, 1 << 16]
    means = np.where(means >= 1 << 23, means - (1 << 24), means) / (1 << bits)
    words = turns @ [1, 1 << 8, 1 << 16, 1 << 24]
    others = np.stack([words >> shift & 0x3FF for shift in (20, 10, 0)], 1)
    others = np.where(others & 0x200, -1, 1) * (others & 0x1FF) / 511 / np.sqrt(2)
    quats = fill_in(words >> 30, others)[:, [3, 0, 1, 2]]
    return means, quats, np.exp(scales / 16 - 10), opacities[:, 0] / 255, 0.5 + C0 * (colors / 255 - 0.5) / 0.15


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
    dtype = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[entry["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[entry["type"]]
    values = np.frombuffer(binary, dtype, entry["count"] * width, view["byteOffset"])
    assert values.nbytes == view["byteLength"]
    return values.reshape(entry["count"], width)


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
    ".ply": read_ply,
    ".compressed.ply": read_compressed_ply,
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    ".splats.glb": read_splat_gltf,
    ".splats.gltf": read_splat_gltf,
}
