"""Hand masks by GrabCut (Rother et al. 2004), cut off at the wrist.

The seeds come from capsules around the landmarks, or, better, from the fitted mesh. The arm is skin too, so it counts
as hand while the colour models are estimated, and is cut off at the wrist afterwards.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from oasis_warp.core.hand_model import KNUCKLES
from oasis_warp.estimation.landmarks import FINGERS
from oasis_warp.hand.kinematics import unit

# Half widths of a finger at its four joints [m]: thumb, index, middle, ring, little.
_RADII = np.array([[.016, .014, .0115, .0095], [.0115, .0105, .009, .0078], [.0115, .0105, .009, .0078],
                   [.011, .010, .0087, .0075], [.010, .009, .0078, .0068]])  # fmt: skip
_WRIST_CUT = 0.02
"""How far the mask extends past the wrist point towards the arm [m]."""
_WORK_SIZE = 384
"""Longer side of the image that is segmented [px]."""
_ITERATIONS = 4
_LEAST = 20
"""Smallest number of pixels for a colour model."""
_SUBPIXEL = 16


@dataclass(frozen=True)
class Seeds:
    """Nested regions of the window."""

    sure: np.ndarray
    """Foreground."""
    near: np.ndarray
    """Probably foreground."""
    far: np.ndarray
    """Everything outside is background."""


@dataclass(frozen=True)
class Window:
    """The part of the photo around the hand, at working size."""

    corner: tuple[int, int]
    size: tuple[int, int]
    """Width and height in the photo [px]."""
    rgb: np.ndarray
    scale: np.ndarray
    """Working pixels per photo pixel, in x and y."""

    def points(self, xy: np.ndarray) -> np.ndarray:
        """Photo points in the window."""
        return (xy - self.corner) * self.scale

    def part(self, image: np.ndarray) -> np.ndarray:
        """The window's part of an image [H, W], at working size."""
        (x, y), (width, height) = self.corner, self.size
        return cv2.resize(image[y : y + height, x : x + width], self.rgb.shape[1::-1], interpolation=cv2.INTER_AREA)

    def back(self, mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """A window's mask in the photo."""
        out = np.zeros(shape, np.float32)
        (x, y), (width, height) = self.corner, self.size
        out[y : y + height, x : x + width] = cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR)
        return out


def window_of(rgb: np.ndarray, xy: np.ndarray, scale: float) -> Window:
    """The window 5 cm around the landmarks; `scale` is in pixels per metre."""
    height, width = rgb.shape[:2]
    pad = 0.05 * scale
    x0, y0 = np.clip(np.floor(xy.min(0) - pad), 0, [width - 8, height - 8]).astype(int)
    x1, y1 = np.clip(np.ceil(xy.max(0) + pad), [x0 + 8, y0 + 8], [width, height]).astype(int)
    factor = min(1.0, _WORK_SIZE / max(x1 - x0, y1 - y0))
    part = rgb[y0:y1, x0:x1]
    small = cv2.resize(part, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else part
    size = (int(x1 - x0), int(y1 - y0))
    return Window((int(x0), int(y0)), size, small, np.array(small.shape[1::-1]) / size)


def mask_from_landmarks(rgb: np.ndarray, xy: np.ndarray, scale: float) -> np.ndarray:
    """Share of each pixel that is hand, [H, W] float32, seeded by capsules around the landmarks.

    Args:
        rgb: The photo, [H, W, 3] bytes.
        xy: Landmarks [px].
        scale: Pixels per metre at the hand.
    """
    window = window_of(rgb, xy, scale)
    points, size, metre = window.points(xy), window.rgb.shape[:2], scale * float(window.scale.mean())
    seeds = Seeds(
        sure=_capsules(size, points, metre, 0.45, 0.5 * _WRIST_CUT),
        near=_capsules(size, points, metre, 1.0, _WRIST_CUT),
        far=_capsules(size, points, metre, 2.2, _WRIST_CUT + 0.02),
    )
    return window.back(_cut(window, points, metre, seeds), rgb.shape[:2])


def mask_from_fit(rgb: np.ndarray, xy: np.ndarray, scale: float, mask: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Segment again, from the first `mask` ([H, W]) and the silhouette `drawn` ([H, W] bytes) of the fitted mesh.

    Pixels more than 7 mm outside the mesh are background, which removes leaks. Pixels more than 6 mm inside the mesh
    and within the capsules are foreground, which fills missing parts.
    """
    window = window_of(rgb, xy, scale)
    points, size, metre = window.points(xy), window.rgb.shape[:2], scale * float(window.scale.mean())
    mesh = (window.part(drawn) > 127).astype(np.uint8)
    inside, outside = cv2.distanceTransform(mesh, cv2.DIST_L2, 5), cv2.distanceTransform(1 - mesh, cv2.DIST_L2, 5)
    below = _below(size, points, -0.01 * metre)  # the mesh ends at the wrist, the arm does not
    far = (outside < 0.007 * metre) | (below & _capsules(size, points, metre, 2.2, _WRIST_CUT + 0.02))
    sure = _capsules(size, points, metre, 0.45, 0.5 * _WRIST_CUT)
    sure |= (inside > 0.006 * metre) & _capsules(size, points, metre, 0.6, 0.0)  # not in slits between fingers
    near = (window.part(mask) > 0.5) & far
    return window.back(_cut(window, points, metre, Seeds(sure & far, near, far)), rgb.shape[:2])


def mask_from_alpha(alpha: np.ndarray, xy: np.ndarray, scale: float) -> np.ndarray | None:
    """The file's own alpha channel [H, W] without the arm, or None if it does not show this hand alone.

    A cut-out of a hand is opaque on the hand and transparent around it; that of a whole person is opaque around it too.
    """
    metre, shape = scale, alpha.shape
    inside = _capsules(shape, xy, metre, 0.6, 0.0)
    hand_side = ~_below(shape, xy, 0.0)
    around = ~_capsules(shape, xy, metre, 2.2, 0.0) & _capsules(shape, xy, metre, 3.5, 0.0) & hand_side
    if alpha[inside].mean() < 0.8 or (around.any() and alpha[around].mean() > 0.35):
        return None
    mask = np.where(_below(shape, xy, _WRIST_CUT * metre), 0, alpha).astype(np.float32)
    return np.where(_touching(mask > 0.5, inside) | (mask <= 0.5), mask, 0)


def _below(shape: tuple[int, int], points: np.ndarray, past: float) -> np.ndarray:
    """Pixels on the arm's side of a line `past` pixels beyond the wrist point."""
    up = unit(points[KNUCKLES].mean(0) - points[0])
    start = points[0] - up * past
    x, y = np.arange(shape[1]) + 0.5 - start[0], np.arange(shape[0]) + 0.5 - start[1]
    return (x * up[0])[None] + (y * up[1])[:, None] < 0


def _capsules(shape: tuple[int, int], points: np.ndarray, metre: float, grow: float, wrist: float) -> np.ndarray:
    """Mask of capsules around the landmarks, `grow` times as thick, extending `wrist` metres into the arm."""
    mask = np.zeros(shape, np.uint8)

    def cone(a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> None:
        n = max(2, int(np.ceil(np.linalg.norm(b - a) / max(0.5, 0.5 * min(radius_a, radius_b)))))
        for t in np.linspace(0, 1, n):
            centre = np.round((a + t * (b - a) - 0.5) * _SUBPIXEL).astype(int)
            radius = max(1, round(float((1 - t) * radius_a + t * radius_b) * _SUBPIXEL))
            cv2.circle(mask, (int(centre[0]), int(centre[1])), radius, 255, -1, cv2.LINE_8, 4)

    radii = _RADII * metre * grow
    for finger, rows in enumerate(FINGERS.values()):
        for k in range(3):
            cone(points[rows[k]], points[rows[k + 1]], radii[finger, k], radii[finger, k + 1])
    up = unit(points[KNUCKLES].mean(0) - points[0])
    across = np.array([-up[1], up[0]]) * (0.006 + 0.016 * min(grow, 1.2)) * metre
    base = points[0] - up * wrist * metre
    corners = [*points[[1, *KNUCKLES]], points[0] + across, points[0] - across, base + across, base - across]
    hull = cv2.convexHull(np.array(corners, np.float32))[:, 0].astype(np.float64)
    cv2.fillConvexPoly(mask, np.round((hull - 0.5) * _SUBPIXEL).astype(np.int32), 255, cv2.LINE_8, 4)
    for a, b in zip(hull, np.roll(hull, -1, 0), strict=True):
        cone(a, b, 0.010 * metre * grow, 0.010 * metre * grow)
    cone(points[0], points[1], 0.014 * metre * grow, radii[0, 0])
    return mask > 0


def _cut(window: Window, points: np.ndarray, metre: float, seeds: Seeds) -> np.ndarray:
    """GrabCut in the window: soft mask [h, w] float32."""
    arm = _below(window.rgb.shape[:2], points, _WRIST_CUT * metre)
    if seeds.sure.sum() < _LEAST:  # nearly the whole hand is outside the photo
        return (seeds.near & ~arm).astype(np.float32)
    colour = cv2.cvtColor(window.rgb, cv2.COLOR_RGB2YCrCb).astype(np.float64)
    own = colour[seeds.sure]
    difference = colour - own.mean(0)
    precision = np.linalg.inv(np.cov(own.T) + 16 * np.eye(3))
    mahalanobis = np.einsum("hwi,ij,hwj->hw", difference, precision, difference, optimize=True)
    labels = np.full(window.rgb.shape[:2], cv2.GC_BGD, np.uint8)
    labels[seeds.far] = cv2.GC_PR_BGD
    labels[(seeds.near & (mahalanobis < 25)) | (seeds.far & (mahalanobis < 6))] = cv2.GC_PR_FGD
    labels[seeds.sure] = cv2.GC_FGD
    labels[arm & (mahalanobis < 12)] = cv2.GC_PR_FGD
    background = np.isin(labels, (cv2.GC_BGD, cv2.GC_PR_BGD))
    if background.sum() >= _LEAST:  # else the hand fills the photo
        cv2.setRNGSeed(0)  # GrabCut starts from random clusters
        cv2.grabCut(window.rgb[..., ::-1].copy(), labels, None, np.zeros((1, 65)), np.zeros((1, 65)),
                    _ITERATIONS, cv2.GC_INIT_WITH_MASK)  # fmt: skip
    mask = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)) & ~arm
    mask = _fill_pinholes(_touching(mask, seeds.sure), 3 * (0.006 * metre) ** 2)
    soft = cv2.ximgproc.guidedFilter(window.rgb, mask.astype(np.float32), max(2, int(0.0025 * metre)), 1e-4 * 255**2)
    return np.clip((soft - 0.1) / 0.8, 0, 1)


def _touching(mask: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """The connected parts of `mask` that hold a sure pixel."""
    _, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return np.isin(label, np.setdiff1d(np.unique(label[sure & mask]), [0]))


def _fill_pinholes(mask: np.ndarray, smallest: float) -> np.ndarray:
    """`mask` without holes of fewer than `smallest` pixels."""
    n, label, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = [i for i in range(1, n) if stats[i, cv2.CC_STAT_AREA] < smallest]
    return mask | np.isin(label, small)
