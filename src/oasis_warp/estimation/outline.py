"""Pair the rim of the projected mesh with the outline of a mask, above the wrist and away from the photo's border."""

from dataclasses import dataclass

import cv2
import numpy as np

from oasis_warp.core.hand_model import KNUCKLES
from oasis_warp.estimation.fit import OutlinePairs
from oasis_warp.estimation.fit_state import FitState
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.estimation.silhouette import silhouette, vertex_normals
from oasis_warp.hand.kinematics import HandKinematics, unit

WRIST_LINE = 0.10
"""The line across the arm above which outlines count: share of the way from the wrist point to the knuckles."""
_WINDOW = 400
"""Longer side of the picture in which the mesh's rim is looked for [px]."""
_GRAZING = 0.35
"""Largest |normal . view| of a vertex on the rim."""
_REACH = 0.10
"""Farthest pair, share of the box."""
_SAME_WAY = 0.5
"""Smallest cosine between the normals of a pair."""
_MOST_POINTS = 300


@dataclass(frozen=True)
class WristLine:
    """The line across the arm, from the landmarks."""

    wrist: np.ndarray
    up: np.ndarray
    """Unit direction to the knuckles."""
    length: float
    """Wrist to the middle of the knuckles [px]."""

    def above(self, points: np.ndarray, share: float = WRIST_LINE) -> np.ndarray:
        """Which points lie on the hand's side of the line."""
        return (points - self.wrist) @ self.up > share * self.length

    def above_mask(self, size: tuple[int, int], share: float = WRIST_LINE) -> np.ndarray:
        """The same for the pixels of a photo of `size` (width, height)."""
        x, y = np.arange(size[0]) + 0.5 - self.wrist[0], np.arange(size[1]) + 0.5 - self.wrist[1]
        return (x * self.up[0])[None] + (y * self.up[1])[:, None] > share * self.length


def wrist_line(xy: np.ndarray) -> WristLine:
    """The wrist line of 21 landmarks."""
    arm = xy[KNUCKLES].mean(0) - xy[0]
    return WristLine(xy[0], unit(arm), float(np.linalg.norm(arm)))


class MaskOutline:
    """Contour points of a mask with outward normals, holes included."""

    def __init__(self, mask: np.ndarray, xy: np.ndarray, trust: np.ndarray | None = None):
        self.box, self.line = box_size(xy), wrist_line(xy)
        self.low, self.high = xy.min(0) - 0.12 * self.box, xy.max(0) + 0.12 * self.box
        self.points, self.normals = contour(mask, self.box)
        height, width = mask.shape
        inside = (self.points > 1.5).all(1) & (self.points < np.array([width, height]) - 1.5).all(1)
        chosen = np.flatnonzero(inside & self.line.above(self.points))
        chosen = chosen[:: max(1, len(chosen) // _MOST_POINTS)]
        self.points, self.normals = self.points[chosen], self.normals[chosen]
        self.trust = np.ones(len(chosen)) if trust is None else trust[tuple(self.points.astype(int).T[::-1])]

    def match(self, rig: HandKinematics, state: FitState) -> OutlinePairs:
        """Nearest pairs in both directions between these points and the rim of the mesh posed by `state`."""
        displacement = rig.correctives(rig.all_angles(state.angles))
        posed = rig.pose_surface(rig.chain(state.angles, state.shape), rig.rest_surface(state.shape) + displacement)
        edge, rim, rim_normals, inset = self._rim(rig, state, posed)
        if len(rim) < 10 or len(self.points) < 10:
            return OutlinePairs(np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), displacement)
        p, q = self.points / self.box, edge / self.box
        squared = (p**2).sum(1)[:, None] + (q**2).sum(1) - 2 * p @ q.T
        squared[self.normals @ rim_normals.T < _SAME_WAY] = np.inf
        to_rim, to_mask = squared.argmin(1), squared.argmin(0)
        near = np.flatnonzero(squared[np.arange(len(p)), to_rim] < _REACH**2)
        back = np.flatnonzero(squared[to_mask, np.arange(len(q))] < _REACH**2)
        back = back[:: max(1, -(-len(back) // _MOST_POINTS))]
        row, col = np.r_[near, to_mask[back]], np.r_[to_rim[near], back]
        return OutlinePairs(
            vertex=rim[col],
            target=self.points[row] - self.normals[row] * inset[col, None],
            normal=self.normals[row],
            trust=self.trust[row],
            displacement=displacement,
        )

    def _rim(
        self, rig: HandKinematics, state: FitState, posed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points on the mesh's outline above the wrist: where, of which vertex, with which normal, how far outside it.

        No vertex lies on the outline exactly; taking the nearest ones for it would fit a hand that is too thick.
        """
        seen = state.in_camera(posed)
        image = state.focal * seen[:, :2] / seen[:, 2:] + state.centre
        normals = vertex_normals(seen, rig.faces)
        scale = _WINDOW / float(max(self.high - self.low))
        size = np.ceil((self.high - self.low) * scale).astype(int)
        drawn = silhouette(image, rig.faces, (int(size[0]), int(size[1])), self.low, scale)
        depth = cv2.distanceTransform(drawn, cv2.DIST_L2, 3)
        pixel = np.clip(np.floor((image - self.low) * scale).astype(int), 0, size - 1)
        grazing = np.abs((normals * unit(seen)).sum(1)) < _GRAZING
        depth = depth[pixel[:, 1], pixel[:, 0]]
        rim = np.flatnonzero(grazing & (depth <= 3) & self.line.above(image))
        out, inset = unit(normals[rim, :2]), np.maximum(depth[rim] - 0.5, 0) / scale
        return image[rim] + out * inset[:, None], rim, out, inset


def contour(mask: np.ndarray, box: float) -> tuple[np.ndarray, np.ndarray]:
    """All points of the outlines of `mask` [px], and unit normals that point out of it."""
    found, _ = cv2.findContours((mask > 0.5).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate([np.zeros((0, 2), np.int64), *(line[:, 0] for line in found)])
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), max(1.0, 0.006 * box))
    slope = [cv2.Sobel(soft, cv2.CV_32F, 1 - i, i)[points[:, 1], points[:, 0]] for i in (0, 1)]
    normals = -unit(np.stack(slope, 1).astype(np.float64))
    # The contour runs through pixel centres half a pixel inside the edge.
    return points + 0.5 + 0.5 * normals, normals
