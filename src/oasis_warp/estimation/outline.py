"""Outlines of the mesh and of a mask above the wrist, and the pairs of their points that the fit brings together."""

import functools
from typing import NamedTuple

import cv2
import numpy as np

from oasis_warp.core.hand_model import KNUCKLES
from oasis_warp.estimation.fit import OutlinePairs
from oasis_warp.estimation.fit_problem import FitState
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.hand.kinematics import HandKinematics, unit

WRIST_LINE = 0.10
"""Where outlines begin to count, as a fraction of the way from the wrist point to the knuckles."""
_WINDOW = 400
"""Longer side of the image in which the mesh's outline is located [px]."""
_GRAZING = 0.35
"""Largest |normal . view| of a vertex on the outline."""
_REACH = 0.10
"""Largest distance of a pair, as a fraction of the box."""
_PARALLEL = 0.5
"""Smallest cosine between the normals of a pair."""
_MAX_POINTS = 300
_SUBPIXEL_BITS = 4


class WristLine(NamedTuple):
    """The line across the arm above which outlines count, from the landmarks."""

    wrist: np.ndarray
    up: np.ndarray
    """Unit direction to the knuckles."""
    length: float
    """Distance from the wrist to the mean of the knuckles [px]."""

    def height(self, points: np.ndarray) -> np.ndarray:
        """Distance of points above the wrist point along the hand, as a fraction of `length`."""
        return (points - self.wrist) @ self.up / self.length

    def above(self, points: np.ndarray) -> np.ndarray:
        """Whether each point lies on the hand's side of the line."""
        return (points - self.wrist) @ self.up > WRIST_LINE * self.length

    def above_mask(self, size: tuple[int, int], share: float = WRIST_LINE) -> np.ndarray:
        """Pixels of a photo of `size` (width, height) on the hand's side, [H, W]."""
        x, y = np.arange(size[0]) + 0.5 - self.wrist[0], np.arange(size[1]) + 0.5 - self.wrist[1]
        return (x * self.up[0])[None] + (y * self.up[1])[:, None] > share * self.length


def wrist_line(xy: np.ndarray) -> WristLine:
    """The wrist line of 21 landmarks [px]."""
    arm = xy[KNUCKLES].mean(0) - xy[0]
    return WristLine(xy[0], unit(arm), float(np.linalg.norm(arm)))


class Window(NamedTuple):
    """A part of the photo at its own resolution."""

    low: np.ndarray
    """Photo coordinates of the upper left corner."""
    size: tuple[int, int]
    """Width and height [px of the window]."""
    scale: float
    """Pixels of the window per pixel of the photo."""

    def silhouette(self, image: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """The silhouette of a mesh in the window, 0 or 255; `image` holds its vertices [px of the photo]."""
        return silhouette((image - self.low) * self.scale, faces, self.size)

    def sample(self, values: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Values of the window's pixels at points [px of the photo]."""
        x, y = np.clip(np.floor((image - self.low) * self.scale).astype(int), 0, np.array(self.size) - 1).T
        return values[y, x]


def window(low: np.ndarray, high: np.ndarray, longest: int) -> Window:
    """The window between two corners [px], its longer side `longest` pixels."""
    scale = longest / float((high - low).max())
    width, height = np.ceil((high - low) * scale).astype(int)
    return Window(low, (int(width), int(height)), scale)


def silhouette(image: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """255 where the mesh covers a pixel's centre or its outline meets a pixel, 0 elsewhere, [height, width] bytes.

    The number of front faces over a pixel is the winding number of the edges between front faces and others. It fills
    the inside, and only the faces along those edges are drawn one by one. To draw all of them takes longer and gives
    the same pixels, but for one or two inside that long, thin faces miss.

    Args:
        image: Projected vertices [px], [V, 2].
        faces: Corners, [F, 3].
        size: Width and height of the mask.
    """
    width, height = size
    front = front_faces(image, faces)
    beyond = np.append(front, False)[_faces_beyond(np.ascontiguousarray(faces, np.int64).tobytes())]
    face, side = np.nonzero(front[:, None] & ~beyond)
    start, end = faces[face, side], faces[face, side - 2]
    x, y = image.T - 0.5  # OpenCV counts from pixel centres
    slope = (x[end] - x[start]) / np.where(y[start] == y[end], 1, y[end] - y[start])
    low, high = np.sort(np.ceil([y[start], y[end]]).clip(0, height), 0).astype(int)
    edge = np.arange(len(face)).repeat(high - low)
    row = np.arange(len(edge)) + (high - (high - low).cumsum())[edge]
    column = np.ceil(x[start[edge]] + (row - y[start[edge]]) * slope[edge]).clip(0, width).astype(int)
    winding = np.zeros((height, width + 1), np.int16)
    np.add.at(winding, (row, column), np.where(y[start] < y[end], np.int16(1), np.int16(-1))[edge])
    mask = np.where(winding.cumsum(1, np.int16)[:, :-1] > 0, np.uint8(255), np.uint8(0))
    near = np.zeros(len(image), bool)
    near[start] = near[end] = True
    corners = np.round(np.stack([x, y], 1) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
    for triangle in corners[faces[front & near[faces].any(1)]]:
        cv2.fillConvexPoly(mask, triangle, 255, cv2.LINE_8, _SUBPIXEL_BITS)
    return mask


@functools.lru_cache(2)
def _faces_beyond(faces: bytes) -> np.ndarray:
    """The face beyond the side from each corner to the next, -1 beyond the rim, [F, 3]."""
    start = np.frombuffer(faces, np.int64)
    end = np.roll(start.reshape(-1, 3), -1, 1).ravel()
    n = start.max() + 1
    here, there = start * n + end, end * n + start
    order = here.argsort()
    found = order[np.searchsorted(here, there, sorter=order).clip(max=len(order) - 1)]
    return np.where(here[found] == there, found // 3, -1).reshape(-1, 3)


def front_faces(image: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether the camera sees each face from outside, by the winding of its corners in the image (y points down)."""
    a, b, c = (image[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    return u[:, 0] * v[:, 1] < u[:, 1] * v[:, 0]


def is_grazing(seen: np.ndarray, normals: np.ndarray, limit: float) -> np.ndarray:
    """Whether each point in the camera's frame is seen at a grazing angle, |normal . view| < `limit`."""
    return np.abs((normals * unit(seen)).sum(1)) < limit


class MaskOutline:
    """Contour points of a mask above the wrist line with outward normals, holes included."""

    def __init__(self, mask: np.ndarray, xy: np.ndarray, confidence: np.ndarray | None = None):
        self.box, self.line = box_size(xy), wrist_line(xy)
        self.window = window(xy.min(0) - 0.12 * self.box, xy.max(0) + 0.12 * self.box, _WINDOW)
        points, normals = contour(mask, self.box)
        height, width = mask.shape
        inside = (points > 1.5).all(1) & (points < np.array([width, height]) - 1.5).all(1)
        chosen = np.flatnonzero(inside & self.line.above(points))
        chosen = chosen[:: max(1, len(chosen) // _MAX_POINTS)]
        self.points, self.normals = points[chosen], normals[chosen]
        x, y = self.points.astype(int).T
        self.weights = np.ones(len(chosen)) if confidence is None else confidence[y, x]

    def match(self, kinematics: HandKinematics, state: FitState) -> OutlinePairs:
        """Nearest pairs in both directions between these points and the outline of the mesh posed by `state`."""
        joints = kinematics.pose_joints(state.angles, state.shape)
        displacement = kinematics.correctives(joints.angles)
        posed = kinematics.pose_surface(joints, kinematics.rest_surface(state.shape) + displacement)
        vertex, normals, inset, edge = self._mesh_outline(kinematics, state, posed)
        if len(vertex) < 10 or len(self.points) < 10:
            return OutlinePairs(np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))
        p, q = self.points / self.box, edge / self.box
        squared = (p**2).sum(1)[:, None] + (q**2).sum(1) - 2 * p @ q.T
        squared[self.normals @ normals.T < _PARALLEL] = np.inf
        to_mesh, to_mask = squared.argmin(1), squared.argmin(0)
        near = np.flatnonzero(squared[np.arange(len(p)), to_mesh] < _REACH**2)
        back = np.flatnonzero(squared[to_mask, np.arange(len(q))] < _REACH**2)
        back = back[:: max(1, -(-len(back) // _MAX_POINTS))]
        row, col = np.r_[near, to_mask[back]], np.r_[to_mesh[near], back]
        return OutlinePairs(
            vertex=vertex[col],
            target=self.points[row] - self.normals[row] * inset[col, None],
            normal=self.normals[row],
            weight=self.weights[row],
            displacement=displacement[vertex[col]],
        )

    def _mesh_outline(
        self, kinematics: HandKinematics, state: FitState, posed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Vertices near the mesh's outline above the wrist, their normals, distances inside it [px], and points on it.

        No vertex lies exactly on the outline. Ignoring the distance would fit a hand that is too thick.
        """
        seen, image = state.in_camera(posed), state.project(posed)
        normals = kinematics.vertex_normals(seen)
        depth = cv2.distanceTransform(self.window.silhouette(image, kinematics.faces), cv2.DIST_L2, 3)
        depth = self.window.sample(depth, image)
        vertex = np.flatnonzero(is_grazing(seen, normals, _GRAZING) & (depth <= 3) & self.line.above(image))
        outward, inset = unit(normals[vertex, :2]), np.maximum(depth[vertex] - 0.5, 0) / self.window.scale
        return vertex, outward, inset, image[vertex] + outward * inset[:, None]


def contour(mask: np.ndarray, box: float) -> tuple[np.ndarray, np.ndarray]:
    """All points of the outlines of `mask` [px], and their outward unit normals."""
    found, _ = cv2.findContours((mask > 0.5).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate([np.zeros((0, 2), np.int64), *(line[:, 0] for line in found)])
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), max(1.0, 0.006 * box))
    slope = [cv2.Sobel(soft, cv2.CV_32F, 1 - i, i)[points[:, 1], points[:, 0]] for i in (0, 1)]
    normals = -unit(np.stack(slope, 1).astype(np.float64))
    # The contour runs through pixel centres half a pixel inside the edge.
    return points + 0.5 + 0.5 * normals, normals
