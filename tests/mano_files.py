"""A hand in MANO's file format, made from the bundled hand: 778 vertices, 1,538 faces, a wrist of 16 open vertices.

It rests flatter than the bundled hand and elsewhere, as MANO does. The pickles are those of Python 2 and chumpy.
"""

import functools
import heapq
import io
import pickle
import struct
import sys
import types
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from scipy import sparse

from oasis_warp.assets import asset
from oasis_warp.core.surface import open_vertices
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.mano import TIP_VERTICES
from oasis_warp.hand.template import bundled_hand

SHIFT = np.array([0.0957, 0.0064, 0.0062])
"""Where MANO's wrist lies, about [m]."""


@functools.cache
def coarse_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the bundled base mesh that are left, and faces, after collapsing its shortest edges."""
    with asset("hand", "hand_right.npz").open("rb") as file, np.load(file) as stored:
        points, faces = stored["v_template"][:1609].astype(np.float64), stored["faces"]
    around = [set() for _ in points]
    corners = {k: list(face) for k, face in enumerate(faces.tolist())}
    for k, face in corners.items():
        for v in face:
            around[v].add(k)
    is_open = open_vertices(torch.from_numpy(faces).long(), len(points)).numpy()
    near = lambda v: {u for k in around[v] for u in corners[k]} - {v}  # noqa: E731
    edges = [(np.linalg.norm(points[a] - points[b]), a, b) for f in faces.tolist() for a in f for b in f if a != b]
    heapq.heapify(edges)
    n_open, alive = int(is_open.sum()), np.ones(len(points), bool)
    rim = sorted(edge for edge in edges if is_open[list(edge[1:])].all())
    while len(corners) > 1538:
        _, gone, kept = rim.pop(0) if n_open > 16 else heapq.heappop(edges)
        if not (alive[gone] and alive[kept]) or kept not in near(gone):
            continue
        shared = around[gone] & around[kept]
        on_rim = len(shared) == 1
        if (is_open[gone] and not (on_rim and n_open > 16)) or len(near(gone) & near(kept)) != len(shared):
            continue
        n_open -= on_rim
        alive[gone] = False
        for k in shared:
            for v in corners.pop(k):
                around[v].discard(k)
        for k in around[gone]:
            corners[k][corners[k].index(gone)] = kept
            around[kept].add(k)
        for u in near(kept):
            heapq.heappush(edges, (np.linalg.norm(points[u] - points[kept]), u, kept))
            heapq.heappush(edges, (np.linalg.norm(points[u] - points[kept]), kept, u))
    left = np.nonzero(alive)[0]
    tips = bundled_hand().tips.double().numpy()
    for tip, where in zip(tips, TIP_VERTICES, strict=True):  # MANO's tips have these numbers
        nearest = np.linalg.norm(points[left] - tip, axis=1).argmin()
        left[[nearest, where]] = left[[where, nearest]]
    place = np.zeros(len(points), int)
    place[left] = np.arange(len(left))
    return left, place[np.array(list(corners.values()))]


def rest_angles(share: float = 0.6) -> np.ndarray:
    """Angles of the bundled hand at rest of the made one, [16, 3]: flatter fingers, and a thumb that is further out."""
    table = np.zeros((16, 3))
    table[1:13, 0] = -share * bundled_hand().rest_bend.numpy()[1:13]
    table[13] = 0.25 * share, 0.3 * share, -0.2 * share
    return table


@functools.cache
def mano_arrays(pose_size: float = 2e-4) -> dict[str, np.ndarray]:
    """The arrays of a right hand's file; pose displacements of about `pose_size` metres for a radian."""
    left, faces = coarse_mesh()
    with asset("hand", "hand_right.npz").open("rb") as file, np.load(file) as stored:
        base = {key: stored[key] for key in ("v_template", "weights", "shapedirs")}
    kinematics = HandKinematics(bundled_hand())
    joints = kinematics.pose_all_joints(rest_angles(), np.zeros(40))
    weights = base["weights"][left].astype(np.float64)
    weights /= weights.sum(1, keepdims=True)
    turn = np.tensordot(weights, joints.rotation, 1)
    template = (turn @ base["v_template"][left][..., None].astype(np.float64))[..., 0]
    template += weights @ kinematics.bone_shifts(joints) + SHIFT
    random = np.random.default_rng(0)
    return {
        "v_template": template,
        "f": faces.astype(np.uint32),
        "weights": weights,
        "shapedirs": turn @ base["shapedirs"][left][..., :10].astype(np.float64),
        "posedirs": pose_size * random.normal(size=(778, 3, 135)),
        "J_regressor": _regressor(template, joints.position + SHIFT),
        "kintree_table": np.array([[2**32 - 1, *bundled_hand().parents[1:]], range(16)], np.uint32),
        "J": joints.position + SHIFT,
        "hands_components": np.linalg.qr(random.normal(size=(45, 45)))[0],
        "hands_mean": 0.1 * random.normal(size=45),
        "hands_coeffs": random.normal(size=(10, 45)),
    }


def left_arrays(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The other side's file, with the shapes of the right hand as MANO_LEFT.pkl has them."""
    flip = np.array([-1.0, 1.0, 1.0])
    signs = np.tile(np.outer(flip, flip).ravel(), 15)
    return arrays | {
        "v_template": arrays["v_template"] * flip,
        "f": arrays["f"][:, ::-1],
        "posedirs": arrays["posedirs"] * flip[:, None] * signs,
        "hands_mean": arrays["hands_mean"] * np.tile(-flip, 15),
        "hands_components": arrays["hands_components"] * np.tile(-flip, 15),
    }


def _regressor(template: np.ndarray, joints: np.ndarray) -> np.ndarray:
    table = np.zeros((16, len(template)))
    for row, joint in zip(table, joints, strict=True):
        near = np.argsort(np.linalg.norm(template - joint, axis=1))[:30]
        system = np.concatenate([template[near].T, np.ones((1, 30))])
        row[near] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    return table


class _Python2(pickle._Pickler):
    """A pickler that writes bytes as Python 2 wrote its texts, and names as they were then."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def save_bytes(self, value):
        self.write(pickle.BINSTRING + struct.pack("<i", len(value)) + value)
        self.memoize(value)

    dispatch[bytes] = save_bytes


def write_mano(folder: Path, arrays: dict[str, np.ndarray] | None = None, *, chumpy: bool = True) -> Path:
    """Write MANO_RIGHT.pkl and MANO_LEFT.pkl; as chumpy's pickles of Python 2, or as plain ones of today."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = arrays or mano_arrays()
    for name, data in (("MANO_RIGHT.pkl", arrays), ("MANO_LEFT.pkl", left_arrays(arrays))):
        (folder / name).write_bytes(_chumpy(data) if chumpy else pickle.dumps(data, protocol=4))
    return folder


def _chumpy(data: dict[str, np.ndarray]) -> bytes:
    stored = {}
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering",
                                                         "scipy.sparse.csc")}  # fmt: skip

    def made(module: str, name: str, **state):
        kind = type(name, (), {"__module__": module})
        setattr(modules[module], name, getattr(modules[module], name, kind))
        thing = getattr(modules[module], name)()
        thing.__dict__.update(state)
        return thing

    everything = np.concatenate([data["shapedirs"], np.zeros_like(data["shapedirs"])], 2)
    index = np.arange(everything.size).reshape(everything.shape)[..., :10].ravel()
    for name, value in data.items():
        if name == "shapedirs":
            source = made("chumpy.ch", "Ch", x=everything)
            stored[name] = made("chumpy.reordering", "Select", a=source, idxs=index, preferred_shape=value.shape)
        elif name == "J_regressor":
            matrix = sparse.csc_matrix(value)
            stored[name] = made("scipy.sparse.csc", "csc_matrix", data=matrix.data, indices=matrix.indices,
                                indptr=matrix.indptr, _shape=matrix.shape, maxprint=50)  # fmt: skip
        else:
            stored[name] = value
    stored |= {"bs_type": "lrotmin", "bs_style": "lbs"}
    buffer, before = io.BytesIO(), {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        _Python2(buffer, 2).dump(stored)
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
    return buffer.getvalue().replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
