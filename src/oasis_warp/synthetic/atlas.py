"""The texture atlas: the point of the rest surface that each texel shows, and the labels of that point.

Every texture is a function of these points, so it has no seams. Lengths are millimetres of the mean hand. The atlas is
computed with numpy on the CPU, whatever the device of the textures: lines are drawn over its points one after another,
and the random numbers of each depend on the length of the one before, so one texel more would change the whole person.
"""

import functools
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.synthetic.body import FINGERS, Body, bundled_body

WIDTH, HEIGHT = 1024, 1408
"""Texels of the atlas: .34 mm each on the hand, enough for a hand that fills 512 pixels."""
_FACES_AT_ONCE, _TEXELS_AT_ONCE = 1024, 1 << 15
"""Block sizes that fit in the processor's cache."""


class Atlas:
    """Labels of the N texels that show skin."""

    points: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]
    palm: Float[Tensor, "N"]
    finger: Tensor
    """int64 [N]: index into `body.FINGERS`, -1 on palm and arm."""
    finger_weight: Float[Tensor, "N"]
    corners: Tensor
    """int64 [N, 3]: the vertices of the texel's face."""
    weights: Float[Tensor, "N 3"]
    """Barycentric coordinates in that face."""

    def __init__(self, body: Body):
        faces, weights = _rasterize((body.uv * torch.tensor([WIDTH, HEIGHT])).double().numpy(), body.uv_faces.numpy())
        self._shown = shown = faces >= 0
        self.body, self.corners = body, body.skin_faces[torch.from_numpy(faces[shown])]
        self.weights = torch.from_numpy(weights[shown]).float()
        self.points, self.palm = self._spread(body.rest), self._spread(body.palm[:, None])[:, 0]
        self.normals = torch.nn.functional.normalize(self._spread(body.normals), dim=-1)
        share = self._spread(body.finger_weights)
        self.finger_weight, best = share.max(1)
        self.finger = torch.where(self.finger_weight > 0.5, best, -1)
        self.positions = self.points.double().numpy()
        self._trees: dict[str, tuple[np.ndarray, cKDTree, list[int]]] = {}

    @functools.cached_property
    def fill(self) -> Int[Tensor, "H W"]:
        """Index of each texel; outside the islands that of the nearest one, so that interpolation does not bleed."""
        from scipy.ndimage import distance_transform_edt  # 0.3 s, which planning alone does not need

        nearest = np.asarray(distance_transform_edt(~self._shown, return_distances=False, return_indices=True))
        number = np.cumsum(self._shown).reshape(self._shown.shape) - 1
        return torch.from_numpy(number[nearest[0], nearest[1]])

    def _spread(self, values: Float[Tensor, "K C"]) -> Float[Tensor, "N C"]:
        """Interpolate vertex values of hand and forearm at the texels."""
        parts = zip(self.corners.split(_TEXELS_AT_ONCE), self.weights.split(_TEXELS_AT_ONCE), strict=True)
        return torch.cat([(values[corners] * weights[..., None]).sum(1) for corners, weights in parts])

    def snap(self, points: np.ndarray, region: str) -> np.ndarray:
        """The nearest surface points [mm] in a region: a finger's name, "palm", "back" or "wrist".

        Except on fingers, distance is measured in the plane of the palm: the height of `points` does not matter.
        """
        if region not in self._trees:
            keep, axes = self._region(region)
            positions = self.positions[keep]
            self._trees[region] = positions, cKDTree(positions[:, axes]), axes
        positions, tree, axes = self._trees[region]
        return positions[tree.query(points[:, axes])[1]]

    def _region(self, region: str) -> tuple[np.ndarray, list[int]]:
        if region in FINGERS:
            return (self.finger == FINGERS.index(region)).numpy(), [0, 1, 2]
        n, x = self.normals[:, 1].numpy(), self.positions[:, 0]
        on_hand = ((self.finger < 0) | (self.finger_weight < 0.92)).numpy()
        keep: dict[str, Callable[[], np.ndarray]] = {
            "palm": lambda: (n < -0.15) & on_hand & (x < 8),
            "back": lambda: (n > 0.15) & on_hand,
            "wrist": lambda: (n < -0.1) & (x > -14),
        }
        return keep[region](), [0, 2]


def _rasterize(uv: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first face that covers each texel's centre, -1 where there is none, and the barycentric coordinates.

    Args:
        uv: Texels, centres at .5, [U, 2].
        faces: [S, 3].
    """
    corners = uv[faces]
    low = np.ceil(corners.min(1) - 0.5).astype(np.int64).clip(0, [WIDTH, HEIGHT])
    high = np.floor(corners.max(1) - 0.5).astype(np.int64).clip(-1, [WIDTH - 1, HEIGHT - 1])
    columns, rows = (high - low + 1).clip(0).T
    counts = columns * rows
    found, weights = np.full((HEIGHT, WIDTH), -1), np.zeros((HEIGHT, WIDTH, 3))
    # In blocks: whole arrays would cost most of a second in page faults. In reverse: the first face is written last.
    for first in reversed(range(0, len(faces), _FACES_AT_ONCE)):
        count = counts[first : first + _FACES_AT_ONCE]
        face = np.repeat(np.arange(first, first + len(count)), count)  # of each pair with a texel of its box
        within = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
        x, y = low[face, 0] + within % columns[face], low[face, 1] + within // columns[face]
        a, b, c = ((corners[:, k, 0][face] - (x + 0.5), corners[:, k, 1][face] - (y + 0.5)) for k in range(3))
        areas = [p[0] * q[1] - p[1] * q[0] for p, q in ((b, c), (c, a), (a, b))]
        whole = areas[0] + areas[1] + areas[2]
        least, most = (of(of(areas[0], areas[1]), areas[2]) for of in (np.minimum, np.maximum))
        hit = np.nonzero(((least >= 0) | (most <= 0)) & (whole != 0))[0][::-1]
        x, y = x[hit], y[hit]
        found[y, x] = face[hit]
        weights[y, x] = np.stack([area[hit] for area in areas], 1) / whole[hit, None]
    return found, weights


@functools.cache
def bundled_atlas() -> Atlas:
    """The atlas of `bundled_body`; takes half a second the first time."""
    return Atlas(bundled_body())
