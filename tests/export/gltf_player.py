"""What a glTF program does with a skinned mesh: play a clip, move the vertices. In numpy, from the specification."""

import numpy as np
from tests.export.splat_readers import accessor


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
