"""MANO (Romero et al. 2017): its model files, its surface, and the finer MANO-HD. The user brings the files.

MANO_RIGHT.pkl and MANO_LEFT.pkl come from mano.is.tue.mpg.de under a licence of their own; nothing of them is stored.
`hand.mano_hand` makes one into the hand that all stages share.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy import sparse

from oasis_warp.core import surface
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import MANO_SHAPES
from oasis_warp.core.pickle_reader import read_pickle
from oasis_warp.core.rotation import from_vector
from oasis_warp.core.types import Side

N_VERTICES, N_FACES = 778, 1538
N_RIM = 16
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
TIP_VERTICES = (744, 320, 443, 554, 671)
"""Tips of thumb, index, middle, ring and little finger, as smplx numbers them; manopth takes others."""
SMOOTHING_PASSES = 3
"""Smoothing passes of MANO-HD's template, as in HandAvatar (Chen et al. 2023)."""
FARTHEST = 0.5
"""Largest coordinate of a template [m]; files in millimetres are beyond it."""
SAME_SHAPES = 1e-6
"""Mean difference of two bases of shapes below which they are the same [m]."""
FILES: dict[Side, str] = {"right": "MANO_RIGHT.pkl", "left": "MANO_LEFT.pkl"}


@dataclass(frozen=True)
class ManoModel:
    """The arrays of a model file, float64, metres, of the hand's own side."""

    side: Side
    template: np.ndarray
    """[V, 3]."""
    faces: np.ndarray
    """Counter-clockwise seen from outside, [F, 3]."""
    shape_basis: np.ndarray
    """Displacement by each shape coefficient, [V, 3, 10]."""
    pose_basis: np.ndarray
    """Displacement by R - 1 of joints 1 to 15, row by row, [V, 3, 135]."""
    regressor: np.ndarray
    """Joints are these means of the shaped vertices, [16, 778]."""
    coarse_template: np.ndarray
    """Template of the file itself; the joints come from it, [778, 3]."""
    coarse_shapes: np.ndarray
    """[778, 3, 10]."""
    weights: np.ndarray
    """[V, 16]."""
    pose_components: np.ndarray
    """A principal component of hand poses in each row, [45, 45]."""
    pose_mean: np.ndarray
    """Mean hand pose, [15, 3]."""

    def joints(self, betas: np.ndarray) -> np.ndarray:
        """The joints at rest [m], [16, 3]."""
        return self.regressor @ (self.coarse_template + self.coarse_shapes @ betas)


class ManoPose(NamedTuple):
    """Parameters of MANO as smplx, and the data sets that were fitted with it, write them."""

    betas: np.ndarray
    """[10]."""
    global_orient: np.ndarray
    """Axis times angle of the wrist [rad], [3]."""
    hand_pose: np.ndarray
    """Axis times angle of joints 1 to 15 [rad], the mean pose included, [15, 3]."""
    transl: np.ndarray
    """[m], [3]."""


def read_mano(folder: Path | str, side: Side = "right") -> ManoModel:
    """The model of one side from the folder with MANO's files.

    MANO_LEFT.pkl repeats the shapes of MANO_RIGHT.pkl though its template is mirrored (smplx, issue 48). Where it does,
    the sign of their first coordinate is changed.

    Raises:
        InputError: a file is missing or is not MANO; the sentence names it, and what in it is wrong.
    """
    model = _read(Path(folder), side)
    if side == "left":
        right = _read(Path(folder), "right")
        if np.abs(model.shape_basis[:, 0] - right.shape_basis[:, 0]).mean() < SAME_SHAPES:
            fixed = model.shape_basis * np.array([-1.0, 1.0, 1.0])[:, None]
            model = ManoModel(**vars(model) | {"shape_basis": fixed, "coarse_shapes": fixed})
    return model


def _read(folder: Path, side: Side) -> ManoModel:
    path = folder / FILES[side]
    if not path.is_file():
        raise InputError(
            f"{path}: expected MANO's model of the {side} hand, found no such file; register at mano.is.tue.mpg.de, "
            f"download mano_v1_2.zip, and give its folder models."
        )
    data = read_pickle(path, "MANO's model")
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected MANO's model, a dict of arrays, got a {type(data).__name__}; download it.")
    shapes = {
        "v_template": (N_VERTICES, 3), "shapedirs": (N_VERTICES, 3, MANO_SHAPES), "posedirs": (N_VERTICES, 3, 135),
        "weights": (N_VERTICES, 16), "J_regressor": (16, N_VERTICES), "hands_components": (45, 45),
        "hands_mean": (45,),
    }  # fmt: skip
    real = {name: _array(path, data, name, shape) for name, shape in shapes.items()}
    faces = _array(path, data, "f", (N_FACES, 3)).astype(np.int64)
    tree = _array(path, data, "kintree_table", (2, 16)).astype(np.int64)
    if tuple(tree[0, 1:]) != PARENTS[1:]:
        raise InputError(f'{path}: "kintree_table" is not that of MANO\'s 16 joints; download the file again.')
    if faces.min() < 0 or faces.max() >= N_VERTICES:
        raise InputError(f'{path}: "f" names vertices from {faces.min()} to {faces.max()}, but there are {N_VERTICES}; '
                         "download the file again.")  # fmt: skip
    open_rim = int(surface.open_vertices(torch.from_numpy(faces), N_VERTICES).sum())
    if open_rim != N_RIM:
        raise InputError(f'{path}: "f" leaves {open_rim} vertices open instead of the {N_RIM} of MANO\'s wrist; '
                         "download the file again.")  # fmt: skip
    for name in ("weights", "J_regressor"):
        if np.abs(real[name].sum(1) - 1).max() > 1e-3:
            raise InputError(f'{path}: rows of "{name}" must sum to 1; download the file again.')
    if not 0 < np.abs(real["v_template"]).max() < FARTHEST:
        raise InputError(f'{path}: "v_template" must be in metres, below {FARTHEST}; download the file again.')
    return ManoModel(
        side=side, template=real["v_template"], faces=faces, shape_basis=real["shapedirs"],
        pose_basis=real["posedirs"], regressor=real["J_regressor"], coarse_template=real["v_template"],
        coarse_shapes=real["shapedirs"], weights=real["weights"], pose_components=real["hands_components"],
        pose_mean=real["hands_mean"].reshape(15, 3),
    )  # fmt: skip


def _array(path: Path, data: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of the file in float64."""
    if name not in data:
        raise InputError(f'{path}: the key "{name}" of MANO\'s model is missing; download the file again.')
    value = data[name]
    value = value.toarray() if sparse.issparse(value) and value.shape == shape else value
    listed = " x ".join(map(str, shape))
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf" or value.shape != shape:
        got = " x ".join(map(str, value.shape)) if hasattr(value, "shape") else type(value).__name__
        raise InputError(f'{path}: "{name}" must be {listed} numbers, got {got}; give the file that MANO\'s site has.')
    if not np.isfinite(value).all():
        raise InputError(f'{path}: "{name}" has values that are not finite; download the file again.')
    return value.astype(np.float64)


def hand_pose(model: ManoModel, values: np.ndarray, *, flat_hand_mean: bool) -> np.ndarray:
    """The 45 angles of MANO [rad], [15, 3], from principal components or from angles without the mean pose.

    Args:
        model: The model whose components and mean pose they refer to.
        values: 45 angles, [45] or [15, 3]; or the first n components, [n].
        flat_hand_mean: Whether zeros mean the flat hand, as with smplx's option of that name; else the mean pose.

    Raises:
        ValueError: no or more than 45 values.
    """
    flat = np.asarray(values, np.float64).ravel()
    if not 0 < len(flat) <= 45:
        raise ValueError(f"values: expected 45 angles or 1 to 44 components, got {len(flat)}.")
    angles = flat if len(flat) == 45 else flat @ model.pose_components[: len(flat)]
    return angles.reshape(15, 3) + (0 if flat_hand_mean else model.pose_mean)


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotations by axis times angle, [N, 3] -> [N, 3, 3] (Rodrigues)."""
    return from_vector(torch.from_numpy(np.asarray(vectors, np.float64).reshape(-1, 3))).numpy()


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """The inverse of `rotations`, of matrices that are nearly rotations too, [N, 3, 3] -> [N, 3]."""
    return np.stack([cv2.Rodrigues(matrix)[0][:, 0] for matrix in np.asarray(matrices, np.float64)])


def mano_surface(model: ManoModel, pose: ManoPose) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and joints [16, 3] as smplx's layer has them [m]; the wrist turns about its own joint."""
    world = rotations(np.concatenate([pose.global_orient.reshape(1, 3), pose.hand_pose.reshape(15, 3)]))
    rest = model.joints(pose.betas)
    points = model.template + model.shape_basis @ pose.betas
    points = points + model.pose_basis @ (world[1:] - np.eye(3)).ravel()
    place = rest.copy()
    for j in range(1, 16):
        parent = PARENTS[j]
        place[j] = place[parent] + world[parent] @ (rest[j] - rest[parent])
        world[j] = world[parent] @ world[j]
    shifts = place - (world @ rest[..., None])[..., 0]
    blended = np.tensordot(model.weights, world, 1)
    vertices = (blended @ points[..., None])[..., 0] + model.weights @ shifts
    return vertices + pose.transl, place + pose.transl


def subsample(model: ManoModel, step: int = 20) -> ManoModel:
    """The same joints with every `step`-th vertex, for checks; its faces are those of the whole surface."""
    names = ("template", "shape_basis", "pose_basis", "weights")
    return replace(model, **{name: getattr(model, name)[::step] for name in names})


def mirror_mano_pose(pose: ManoPose) -> ManoPose:
    """The pose whose hand is the mirror image at x = 0 of the other side's hand in `pose`: (x, y, z) to (x, -y, -z)."""
    turned, moved = np.array([1.0, -1.0, -1.0]), np.array([-1.0, 1.0, 1.0])
    return ManoPose(pose.betas, pose.global_orient * turned, pose.hand_pose * turned, pose.transl * moved)


def mano_hd(model: ManoModel) -> ManoModel:
    """MANO-HD: each triangle cut into four, twice; 12,337 vertices and 24,608 faces, the wrist open.

    As in HandAvatar (Chen et al. 2023) new vertices take means over their edge, and the template is then smoothed by
    three passes of one-ring means. Its separately optimised skinning weights are not free: weights are edge means too.
    Joints stay those of the coarse surface.
    """
    rows = [model.template, model.shape_basis.reshape(len(model.template), -1),
            model.pose_basis.reshape(len(model.template), -1), model.weights]  # fmt: skip
    values, faces = np.concatenate(rows, 1), torch.from_numpy(model.faces)
    for _ in range(2):
        values, faces = _divide(values, faces)
    template, shapes, poses, weights = np.split(values, np.cumsum([row.shape[1] for row in rows])[:-1], axis=1)
    smooth = surface.smooth_over_mesh(torch.from_numpy(template.copy()), surface.mesh_edges(faces), SMOOTHING_PASSES)
    return ManoModel(**vars(model) | {
        "template": smooth.numpy(), "faces": faces.numpy(), "shape_basis": shapes.reshape(-1, 3, MANO_SHAPES),
        "pose_basis": poses.reshape(-1, 3, 135), "weights": weights,
    })  # fmt: skip


def _divide(values: np.ndarray, faces: torch.Tensor) -> tuple[np.ndarray, torch.Tensor]:
    """Values of the vertices and of the middles of edges, and four triangles for each."""
    edges, n = surface.mesh_edges(faces), len(values)
    middles = 0.5 * (values[edges[:, 0]] + values[edges[:, 1]])
    keys = edges[:, 0] * n + edges[:, 1]

    def middle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return n + torch.searchsorted(keys, torch.minimum(a, b) * n + torch.maximum(a, b))

    a, b, c = faces.unbind(1)
    ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
    corners = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    finer = torch.stack([torch.stack(face, 1) for face in corners], 1).reshape(-1, 3)
    return np.concatenate([values, middles]), finer
