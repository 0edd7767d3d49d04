"""Smooth displacements of the rest surface that bring outlines onto masks: those of the mesh, then those of Gaussians.

First the outline of the posed mesh is compared with the mask's. The vertices on it get targets along their normals in
the image, and the surface follows as a thin sheet: the displacement D minimises

    sum over the targets of w |D - target|^2 + BEND |L D|^2 + STAY |D|^2

with the umbrella operator L. So neighbours follow, and the far side stays.

Gaussians reach beyond the mesh by their size and by a pixel's blur, more at the tip of a finger than along it, and
across slits. One depth below the skin would leave outlines too wide in one place and too narrow in another. So a second
displacement along the normals is found in the same way, from the outlines of rendered Gaussians.
"""

import functools
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, cg
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import PRIOR_SIZE
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.sparse_factors import factorized, sparse_order
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit
from oasis_warp.estimation.fit_problem import mirrored_fit
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.estimation.outline import WRIST_LINE, is_grazing, window, wrist_line
from oasis_warp.hand.contact import flesh_thickness
from oasis_warp.hand.kinematics import HandKinematics, unit
from oasis_warp.render import render

LONGEST, OF_FINGER = 0.006, 0.3
"""Largest displacement of a vertex by outlines of the mesh [m], and over its distance from its finger's bone. Where two
fingers cross, a fit that is a little off would make a bulb of the tip behind."""
BEYOND = 0.5
"""Distance of the outline of Gaussians, at half opacity, outside the mask's [px]. A pixel on the outline is half
background in the photo and half black in an image over black, so what fits best is opaque there: see docs/avatar.md."""
_OPAQUE, _OVERLAP = 0.85, 0.3
"""Opacity below which there is a slit that the photo does not have, and how far beyond its middle each side goes [px].
In pictures twice as fine, slits of half a pixel are white lines between fingers."""
_ROUNDS, _RENDERED_ROUNDS = 4, 2
_REJECT, _RENDERED_REJECT = 0.04, 4 / PRIOR_SIZE
"""Gaps beyond this are faults of the mask and ignored, as fractions of the landmarks' box and of the crop's side."""
_GRAZING = 0.5
"""Largest |normal . view| of a vertex on the outline."""
_WINDOW = 1000
"""Longer side of the image in which outlines of the mesh are compared [px]."""
_NEAR, _RENDERED_NEAR = 0.008 * _WINDOW, 2.5 / PRIOR_SIZE
"""Largest distance of a vertex from the outline, in pixels of the window and as a fraction of the crop's side."""
_BORDER = 2
"""Outlines nearer to the border of the image may be cut by it [px]."""
_BEND, _STAY = 100.0, 0.02
"""Weights relative to one target per vertex. With edges of 2 mm a target is shared along about 3 mm, and its effect
ends after about 12 mm: (BEND / STAY / 16)^(1/4) edges."""
_TOLERANCE, _MAX_STEPS = 1e-3, 100
"""Relative residual at which conjugate gradients end: no vertex is then off by more than 4e-6 m, 2 % of a pixel."""
_STEP = 0.25
"""Spacing of the samples across the outline, in pixels of the window."""
_CLOSE = 12.0
"""Distance up to which outlines are looked for first [px]; nearly all are found there."""


def outline_offsets(hand: HandModel, *fits: HandFit, sheet: "ThinSheet | None" = None) -> Float[Tensor, "V 3"]:
    """Displacement of the rest surface that brings the outlines of the posed mesh onto the masks' [m].

    Add it to the vertices at rest (`skinning.rest_hand`) before skinning. For a left hand, add it before mirroring, as
    with the pose. It is zero where no outline is seen: at the wrist, at a photo's border, across gaps wider than 4 % of
    the hand, and towards the far side of the hand.

    Args:
        hand: The model.
        fits: One photo of a hand, or several photos of one hand with one shape, which share the displacement.
        sheet: What to solve with, where `rendered_outline_offsets` of the same photos follows.
    """
    views, sheet = [_View(hand, fit) for fit in fits], sheet or ThinSheet(hand)
    offsets = np.zeros_like(views[0].rest)
    longest = np.minimum(LONGEST, OF_FINGER * flesh_thickness(hand))[:, None]
    for _ in range(_ROUNDS):
        vertices, target, weight = _joined([view.observe(offsets) for view in views])
        if len(vertices) == 0:
            break
        offsets = sheet.solve(vertices, target, weight)
        offsets *= np.minimum(1, longest / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12))
    return torch.from_numpy(offsets.astype(np.float32))


@torch.no_grad()
def rendered_outline_offsets(
    hand: HandModel, guesses: Sequence[CanonicalGaussians], crops: Sequence[HandCrop],
    sheet: "ThinSheet | None" = None,
) -> Float[Tensor, "V 3"]:  # fmt: skip
    """Displacement of the rest surface that brings the outlines of Gaussians on it onto the masks' [m].

    Args:
        hand: The model.
        guesses: Gaussians for each photo. Colours play no part, neither theirs nor the photos'.
        crops: Photos of one hand with one surface at rest, at the size of the images that will be rendered.
        sheet: That of `outline_offsets` of these photos: vertices on the outline are nearly the same.
    """
    faces, like = hand.faces.to(crops[0].mask.device), crops[0].rest.vertices
    normals = [
        [surface.vertex_normals(part.vertices, faces) for part in (crop.rest, crop.posed)] for crop in crops
    ]
    sheet = sheet or ThinSheet(hand)
    outward = np.zeros(len(hand.template))
    target, weight = np.zeros((2, len(crops), len(outward)))
    for _ in range(_RENDERED_ROUNDS):
        step = torch.from_numpy(outward).to(like)[:, None]
        for k, (guess, crop, (at_rest, posed)) in enumerate(zip(guesses, crops, normals, strict=True)):
            moved = crop._replace(
                rest=crop.rest._replace(vertices=crop.rest.vertices + step * at_rest),
                posed=crop.posed._replace(vertices=crop.posed.vertices + step * posed),
            )
            vertices, gap, sure = _compare_rendered(guess, faces, moved)
            target[k, vertices], weight[k, vertices] = outward[vertices] + gap, sure
        # Sides of a slit that has closed are seen no more: without their targets it would open again.
        known = weight.nonzero()
        if len(known[1]) == 0:
            break
        outward = sheet.solve(known[1], target[known][:, None], weight[known])[:, 0]
    return torch.from_numpy(outward).to(like)[:, None] * normals[0][0]


def _joined(observed: Sequence[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    return [np.concatenate(part) for part in zip(*observed, strict=True)]


class _View:
    """A posed hand, as a right hand, in front of its camera, and its mask."""

    def __init__(self, hand: HandModel, fit: HandFit):
        self.kinematics = kinematics = HandKinematics(hand)
        self.state, table, xy, mask = mirrored_fit(kinematics, fit)
        joints = kinematics.pose_all_joints(table, self.state.shape)
        self.rest = kinematics.rest_surface(joints.shape) + kinematics.correctives(table)
        self.box, self.line = box_size(xy), wrist_line(xy)
        self.rotation = self.state.rotation @ kinematics.blended(joints)
        """Rest frame to camera, [V, 3, 3]."""
        self.seen = self.state.in_camera(kinematics.pose_surface(joints, self.rest))
        self.photo = np.array(mask.shape[::-1])
        reach = 1.5 * _REJECT * self.box
        image = self._image(self.seen)
        low, high = np.maximum(image.min(0) - reach, -reach), np.minimum(image.max(0) + reach, self.photo + reach)
        self.window = window(low, high, _WINDOW)
        # Pixel centres of the window to pixel centres of the mask.
        scale, shift = 1 / self.window.scale, low + 0.5 / self.window.scale - 0.5
        affine = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        self.mask = cv2.warpAffine(mask, affine, self.window.size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    def _image(self, seen: np.ndarray) -> np.ndarray:
        return self.state.focal * seen[:, :2] / seen[:, 2:] + self.state.centre

    def observe(self, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices on the outline, their targets in the rest frame [m], and the weights of these."""
        seen, window = self.seen + (self.rotation @ offsets[..., None])[..., 0], self.window
        image = self._image(seen)
        drawn = window.silhouette(image, self.kinematics.faces)
        depth = window.sample(cv2.distanceTransform(drawn, cv2.DIST_L2, 3), image)
        normals = self.kinematics.vertex_normals(seen)
        vertex = np.flatnonzero(is_grazing(seen, normals, _GRAZING) & (depth <= _NEAR) & self.line.above(image))
        outward = unit(normals[vertex, :2])
        start, reach = (image[vertex] - window.low) * window.scale, 1.5 * _REJECT * self.box * window.scale
        mesh_edge = crossing(drawn.astype(np.float32) / 255, start, outward, reach)
        gap = (crossing(self.mask, start, outward, reach) - mesh_edge) / window.scale
        edge = image[vertex] + outward * (mesh_edge / window.scale + gap)[:, None]
        on_photo = ((edge > _BORDER) & (edge < self.photo - _BORDER)).all(1)
        good = on_photo & (np.abs(np.nan_to_num(gap, nan=np.inf)) < _REJECT * self.box)
        vertex, outward, gap = vertex[good], outward[good], gap[good]
        shift = np.zeros((len(vertex), 3))
        shift[:, :2] = outward * (gap * seen[vertex, 2] / self.state.focal)[:, None]
        target = offsets[vertex] + (self.rotation[vertex].transpose(0, 2, 1) @ shift[..., None])[..., 0]
        fade_in = np.clip((self.line.height(image[vertex]) - WRIST_LINE) / 0.15, 0, 1)
        return vertex, target, _gap_weight(gap, _REJECT * self.box) * fade_in


def _gap_weight(gap: np.ndarray, reject: float) -> np.ndarray:
    """Weights of gaps: the wider one is, the more likely it is a fault of the mask."""
    return 1 / (1 + (gap / (0.4 * reject)) ** 2)


def _compare_rendered(
    gaussians: CanonicalGaussians, faces: Int[Tensor, "F 3"], crop: HandCrop
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices on the outline of rendered Gaussians, their distances from the mask's outline [m], and weights."""
    vertices, camera = crop.posed.vertices, crop.camera
    posed = pose_gaussians(gaussians, faces, crop.rest.vertices, vertices)
    alpha = render(posed, camera).alpha.cpu().numpy()
    mask, side = crop.mask.cpu().numpy(), len(alpha)

    rotation = camera.viewmat[:3, :3]
    normals = surface.vertex_normals(vertices, faces) @ rotation.T
    seen = vertices @ rotation.T + camera.viewmat[:3, 3]
    grazing = ((normals * normalize(seen, dim=-1)).sum(-1).abs() < _GRAZING).cpu().numpy()
    uv, depth = (part.cpu().numpy() for part in project(camera, vertices))
    x, y = np.clip(np.floor(uv).astype(int), 0, side - 1).T
    inside = cv2.distanceTransform((alpha > 0.5).astype(np.uint8), cv2.DIST_L2, 3)
    near = inside[y, x] < max(_RENDERED_NEAR * side, 1)
    vertex = np.flatnonzero(grazing & near & (crop.above_wrist.cpu().numpy()[y, x] > 0.5))

    across = normals.cpu().numpy()[vertex, :2]
    steepness = np.linalg.norm(across, axis=1)
    reject = _RENDERED_REJECT * side
    outward, start, reach = across / steepness[:, None], uv[vertex], 1.5 * reject
    drawn, shown = crossing(alpha, start, outward, reach), crossing(mask, start, outward, reach)
    gap = shown + BEYOND - drawn
    # A slit that the photo does not have: the opacity falls and rises again where the mask stays.
    thick = alpha - (_OPAQUE - 0.5)
    thins = crossing(thick, start, outward, reach)
    edge = start + outward * np.nan_to_num(thins)[:, None]
    width = np.nan_to_num(crossing(1 - thick, edge, outward, reach))
    slit = np.isfinite(thins) & (width > 0)
    for share in (0.0, 0.5, 1.0):
        x, y = np.clip(np.floor(edge + share * outward * width[:, None]).astype(int), 0, side - 1).T
        slit &= mask[y, x] > 0.5
    gap = np.where(slit, width / 2 + _OVERLAP, gap)
    edge = start + outward * np.nan_to_num(np.where(slit, thins, drawn))[:, None]
    on_photo = ((edge > _BORDER) & (edge < side - _BORDER)).all(1)
    good = on_photo & (np.abs(np.nan_to_num(gap, nan=np.inf)) < reject)
    vertex, gap = vertex[good], gap[good]
    pixel_size = depth[vertex] / float(camera.K[0, 0])
    return vertex, gap * pixel_size / steepness[good], _gap_weight(gap, reject)


def crossing(image: np.ndarray, start: np.ndarray, outward: np.ndarray, reach: float) -> np.ndarray:
    """Signed distance from each `start` along `outward` to the nearest place where `image` falls through .5, or NaN."""
    t = np.arange(-reach, reach + _STEP, _STEP)
    close = t[np.abs(t) < _CLOSE]
    if len(close) < 2 or len(close) == len(t):
        return _nearest_fall(image, start, outward, t)
    place = _nearest_fall(image, start, outward, close)  # what is found here is nearer than all beyond
    rest = np.flatnonzero(np.isnan(place))
    place[rest] = _nearest_fall(image, start[rest], outward[rest], t)
    return place


def _nearest_fall(image: np.ndarray, start: np.ndarray, outward: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The same among the samples at the distances `t`."""
    if not len(start):  # a few pixels of hand have no outline, and OpenCV reads no empty list
        return np.zeros(0)
    x, y = (start[:, k, None] + outward[:, k, None] * t - 0.5 for k in (0, 1))
    values = cv2.remap(image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    before, after = values[:, :-1], values[:, 1:]
    falls = (before >= 0.5) & (after < 0.5)
    distance = np.where(falls, np.abs(t[:-1]), np.inf)
    row, nearest = np.arange(len(start)), distance.argmin(1)
    a, b = before[row, nearest], after[row, nearest]
    place = t[nearest] + _STEP * (a - 0.5) / np.maximum(a - b, 1e-6)
    return np.where(np.isfinite(distance[row, nearest]), place, np.nan)


class ThinSheet:
    """The surface as a sheet that resists bending, and is drawn to targets at some of its vertices."""

    def __init__(self, hand: HandModel):
        faces = np.ascontiguousarray(hand.faces.cpu().numpy(), np.int64)
        self._stiffness, self._order = _bending(faces.tobytes(), len(hand.template))
        self._factors: SuperLU | None = None
        self._last = np.zeros(0)

    def solve(self, vertices: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """The displacement [V, D] that comes nearest to the targets [K, D] of some vertices [K].

        By conjugate gradients from the last solution of D columns. Float32 factors of the first system precondition all
        of them: later ones have targets at nearly the same vertices, and some iterations take less time than factors.
        Those of the sheet without targets, which could be kept for all photos, take three times as many iterations,
        more than they save.
        """
        n = len(self._order)
        diagonal, right = np.zeros(n), np.zeros((n, target.shape[1]))
        np.add.at(diagonal, vertices, weight)
        np.add.at(right, vertices, weight[:, None] * target)
        diagonal, right = diagonal[self._order], right[self._order]
        factors = self._factors or factorized((self._stiffness + sparse.diags_array(diagonal)).astype(np.float32))
        self._factors = factors

        def system(x: np.ndarray) -> np.ndarray:
            return self._stiffness @ x + diagonal[:, None] * x

        def precondition(residual: np.ndarray) -> np.ndarray:
            return factors.solve(residual.astype(np.float32)).astype(np.float64)

        solution, _ = cg(
            _operator(system, right.shape), right.ravel(), self._last if self._last.size == right.size else None,
            M=_operator(precondition, right.shape), rtol=_TOLERANCE, maxiter=_MAX_STEPS,
        )  # fmt: skip
        self._last = solution
        found = np.empty_like(right)
        found[self._order] = solution.reshape(right.shape)
        return found


def _operator(function: Callable[[np.ndarray], np.ndarray], shape: tuple[int, int]) -> LinearOperator:
    """A linear function of matrices of `shape`, as an operator on flat vectors."""
    size = shape[0] * shape[1]
    return LinearOperator((size, size), matvec=lambda x: function(x.reshape(shape)).ravel(), dtype=np.float64)


@functools.lru_cache(1)
def _bending(faces: bytes, n: int) -> tuple[sparse.csc_array, np.ndarray]:
    """BEND L^T L + STAY with the umbrella operator L (mean of the neighbours minus the vertex), and its order.

    The matrix is given in an order of the vertices that makes factors sparse (minimum degree). Targets add to the
    diagonal alone, so that one order serves every photo.
    """
    a, b, c = np.frombuffer(faces, np.int64).reshape(-1, 3).T
    i, j = np.r_[a, b, c, b, c, a], np.r_[b, c, a, a, b, c]
    pairs = np.unique(np.stack([i, j]), axis=1)
    share = 1 / np.bincount(pairs[0], minlength=n)[pairs[0]]
    umbrella = sparse.csr_array((share, tuple(pairs)), shape=(n, n)) - sparse.eye_array(n)
    stiffness = (_BEND * umbrella.T @ umbrella + _STAY * sparse.eye_array(n)).tocsc()
    order = sparse_order(stiffness.astype(np.float32))
    return stiffness[order][:, order].tocsc(), order
