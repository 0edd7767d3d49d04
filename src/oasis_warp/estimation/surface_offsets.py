"""Close the last gap between the fitted hand and its mask: a smooth displacement of the rest surface.

Where the outline of the posed mesh misses the mask's, the vertices on the rim are told how far to move along their
normal in the image. The whole surface follows by a screened bi-Laplacian: it minimises

    sum over the rim of w |D - target|^2 + BEND |L D|^2 + STAY |D|^2

with the umbrella operator L, so that neighbours follow and the far side stays.
"""

import functools
from collections.abc import Callable

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import splu
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandFit
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.estimation.mirrored_input import mirrored_fit
from oasis_warp.estimation.outline import WRIST_LINE, wrist_line
from oasis_warp.estimation.silhouette import silhouette, vertex_normals
from oasis_warp.hand.kinematics import HandKinematics, unit

LONGEST = 0.006
"""No vertex moves farther [m]."""
_REJECT = 0.04
"""A gap wider than this share of the box is the mask's fault and is left."""
_ROUNDS = 4
_BEND, _STAY = 100.0, 0.02
"""Weights against one observation a vertex. With edges of 2 mm an observation is shared along about 3 mm, and its
effect ends after about 12 mm: (BEND / STAY / 16)^(1/4) edges."""
_SETTLED = 1e-6
"""Step of the displacement at which it is found [m]."""
_MOST_STEPS = 100
_TINY = 1e-300
"""Where a column is solved, nothing is divided by 0."""
_GRAZING = 0.5
"""Largest |normal . view| of a vertex that speaks for the rim."""
_STEP = 0.25
"""Spacing of the samples across the outline, in pixels of the window."""
_WINDOW = 1000
"""Longer side of the picture in which outlines are compared [px]."""


def outline_offsets(hand: HandModel, *fits: HandFit) -> Float[Tensor, "V 3"]:
    """Displacement of the rest surface that brings the posed outlines onto the masks' [m].

    Add it to the vertices at rest (`skinning.rest_hand`) before skinning; for a left hand, before mirroring, as the
    pose is. Zero where no outline says anything: at the wrist, at a photo's border, across gaps wider than 4 % of
    the hand, and towards the far side of the hand.

    Args:
        hand: The model.
        fits: One photo of a hand, or several of the same hand, all with one shape: then one displacement for all.
    """
    views = [_View(hand, fit) for fit in fits]
    sheet = ThinSheet(views[0].rig.faces, len(views[0].rig.template))
    moved = np.zeros_like(views[0].rest)
    for _ in range(_ROUNDS):
        seen = zip(*(view.observe(moved) for view in views), strict=True)
        vertices, target, weight = (np.concatenate(part) for part in seen)
        if len(vertices) == 0:
            break
        moved = sheet.drawn(vertices, target, weight)
        moved *= np.minimum(1, LONGEST / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12))
    return torch.from_numpy(moved.astype(np.float32))


class _View:
    """A posed hand before its camera, mirrored into a right one, and its mask."""

    def __init__(self, hand: HandModel, fit: HandFit):
        self.rig = rig = HandKinematics(hand)
        state, table, xy, mask = mirrored_fit(rig, fit)
        chain = rig.chain_of(table, state.shape)
        self.rest = rig.rest_surface(state.shape) + rig.correctives(table)
        self.state, self.box, self.line = state, box_size(xy), wrist_line(xy)
        self.turn = state.turn @ rig.blended(chain)
        """Rest frame to camera, [V, 3, 3]."""
        self.seen = state.in_camera(rig.pose_surface(chain, self.rest))
        self.photo = np.array(mask.shape[::-1])
        reach = 1.5 * _REJECT * self.box
        image = self._image(self.seen)
        self.low = np.maximum(image.min(0) - reach, -reach)
        high = np.minimum(image.max(0) + reach, self.photo + reach)
        self.scale = _WINDOW / float((high - self.low).max())
        self.size = (int(np.ceil((high - self.low)[0] * self.scale)), int(np.ceil((high - self.low)[1] * self.scale)))
        # Window pixel (centre) -> mask pixel (centre).
        shift = self.low + 0.5 / self.scale - 0.5
        affine = np.array([[1 / self.scale, 0, shift[0]], [0, 1 / self.scale, shift[1]]])
        self.mask = cv2.warpAffine(mask, affine, self.size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    def _image(self, seen: np.ndarray) -> np.ndarray:
        return self.state.focal * seen[:, :2] / seen[:, 2:] + self.state.centre

    def observe(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices on the rim, where in the rest frame they should be moved to [m], and how far to trust that."""
        seen = self.seen + (self.turn @ moved[..., None])[..., 0]
        image = self._image(seen)
        drawn = silhouette(image, self.rig.faces, self.size, self.low, self.scale)
        depth = cv2.distanceTransform(drawn, cv2.DIST_L2, 3)
        pixel = np.clip(np.floor((image - self.low) * self.scale).astype(int), 0, np.array(self.size) - 1)
        normals = vertex_normals(seen, self.rig.faces)
        grazing = np.abs((normals * unit(seen)).sum(1)) < _GRAZING
        rim = np.flatnonzero(grazing & (depth[pixel[:, 1], pixel[:, 0]] <= 0.008 * _WINDOW) & self.line.above(image))
        out = unit(normals[rim, :2])
        start, reach = (image[rim] - self.low) * self.scale, 1.5 * _REJECT * self.box * self.scale
        mesh_edge = crossing(drawn.astype(np.float32) / 255, start, out, reach)
        gap = (crossing(self.mask, start, out, reach) - mesh_edge) / self.scale
        edge = image[rim] + out * (mesh_edge / self.scale + gap)[:, None]
        on_photo = ((edge > 2) & (edge < self.photo - 2)).all(1)
        good = np.isfinite(gap) & (np.abs(np.nan_to_num(gap)) < _REJECT * self.box) & on_photo
        rim, out, gap = rim[good], out[good], gap[good]
        shift = np.zeros((len(rim), 3))
        shift[:, :2] = out * (gap * seen[rim, 2] / self.state.focal)[:, None]
        target = moved[rim] + (self.turn[rim].transpose(0, 2, 1) @ shift[..., None])[..., 0]
        # A wide gap is more often a fault of the mask; the weight fades in above the wrist line.
        weight = 1 / (1 + (gap / (0.4 * _REJECT * self.box)) ** 2)
        weight *= np.clip(((image[rim] - self.line.wrist) @ self.line.up / self.line.length - WRIST_LINE) / 0.15, 0, 1)
        return rim, target, weight


def crossing(picture: np.ndarray, start: np.ndarray, out: np.ndarray, reach: float) -> np.ndarray:
    """Signed way from each `start` along `out` to the nearest place where `picture` falls through a half; else NaN."""
    t = np.arange(-reach, reach + _STEP, _STEP)
    x, y = (start[:, k, None] + out[:, k, None] * t - 0.5 for k in (0, 1))
    values = cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    before, after = values[:, :-1], values[:, 1:]
    falls = (before >= 0.5) & (after < 0.5)
    away = np.where(falls, np.abs(t[:-1]), np.inf)
    row, nearest = np.arange(len(start)), away.argmin(1)
    a, b = before[row, nearest], after[row, nearest]
    place = t[nearest] + _STEP * (a - 0.5) / np.maximum(a - b, 1e-6)
    return np.where(np.isfinite(away[row, nearest]), place, np.nan)


class ThinSheet:
    """The surface as a sheet that resists bending, and is drawn to where its vertices are wanted."""

    def __init__(self, faces: np.ndarray, n_vertices: int):
        self._stiffness = _bending(np.ascontiguousarray(faces, np.int64).tobytes(), n_vertices)
        self._solve: Callable[[np.ndarray], np.ndarray] | None = None

    def drawn(self, vertices: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """The displacement [V, D] that comes nearest to the targets [K, D] of some vertices.

        The first is exact. For those that follow its factors serve as preconditioner of conjugate gradients: nearly the
        same vertices are drawn again, so that a few steps take less than factors of their own.
        """
        n_vertices = len(self._stiffness.diagonal())
        diagonal, right = np.zeros(n_vertices), np.zeros((n_vertices, target.shape[1]))
        np.add.at(diagonal, vertices, weight)
        np.add.at(right, vertices, weight[:, None] * target)
        system = (self._stiffness + sparse.diags_array(diagonal)).tocsc()
        if self._solve is None:
            options = {"SymmetricMode": True}
            factors = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
            self._solve = factors.solve
            return factors.solve(right)
        return _conjugate_gradients(system, right, self._solve)


def _conjugate_gradients(
    system: sparse.csc_array, right: np.ndarray, precondition: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """The solution of each column of `right`, until no vertex moves by more than `_SETTLED` in a step."""
    solution, residual = np.zeros_like(right), right
    direction = preconditioned = precondition(residual)
    product = (residual * preconditioned).sum(0)
    for _ in range(_MOST_STEPS):
        image = system @ direction
        length = product / np.maximum((direction * image).sum(0), _TINY)
        step = length * direction
        solution, residual = solution + step, residual - length * image
        if np.abs(step).max() < _SETTLED:
            break
        preconditioned = precondition(residual)
        product, before = (residual * preconditioned).sum(0), product
        direction = preconditioned + product / np.maximum(before, _TINY) * direction
    return solution


@functools.lru_cache(1)
def _bending(faces: bytes, n: int) -> sparse.csc_array:
    """BEND L^T L + STAY with the umbrella operator L (mean of the neighbours minus the vertex)."""
    a, b, c = np.frombuffer(faces, np.int64).reshape(-1, 3).T
    i, j = np.r_[a, b, c, b, c, a], np.r_[b, c, a, a, b, c]
    pairs = np.unique(np.stack([i, j]), axis=1)
    share = 1 / np.bincount(pairs[0], minlength=n)[pairs[0]]
    umbrella = sparse.csr_array((share, tuple(pairs)), shape=(n, n)) - sparse.eye_array(n)
    return (_BEND * umbrella.T @ umbrella + _STAY * sparse.eye_array(n)).tocsc()
