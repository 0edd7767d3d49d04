"""The skin of the arm: the tone of the hand's before the wrist, with a pattern of its own."""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import RIM_FADE, centers_at_rest
from oasis_warp.avatar.arm_lines import arm_lines
from oasis_warp.avatar.cells import CELL, LONGER, TRIED, apart, blotches, furrows_and_tones
from oasis_warp.core.processes import kernel_threads
from oasis_warp.core.types import CanonicalGaussians

SMOOTHING = 0.0015
"""Standard deviation of the average of the hand's colours, where they are nearest [m]."""
PLACES = 2000
"""About as many places of the hand's skin count for that average, 1.2 mm apart."""
DETAIL_PLACES = 4000
"""And about as many for the mean below detail."""
BLOTCHES = (0.0011, 0.022), (0.0022, 0.018), (0.006, 0.014)
"""Least distances of the points that blotches are made of [m], and what they add to logarithms."""
FINEST = 0.002
"""Blotches of points nearer than this are mirrored as grain is [m]."""
BLOOD = 0.7, 1.0, 1.0
"""Of a blotch, in red, green and blue."""
OWN_ON_BACK = 0.4
"""Strength of grain and blotches on the back's side, where detail of the hand is repeated."""
MIRRORED = 0.05
"""The stretch of skin before the rim whose detail the arm repeats in the mirror [m]."""
REPEATED = MIRRORED - RIM_FADE
"""The stretch after which the mirror turns again [m]: past it the skin's last row would go on as streaks. The arm's own
grain and finest blotches are mirrored as often, which saves three quarters of their points."""
AVERAGED = 100
"""Neighbours, within some 6 mm, over which the mean of each place is taken. Detail is the difference of a colour from
the mean of the nearest place."""
TOGETHER = 128
"""Points whose distances to all `PLACES` are computed at once (1 MB): all at once take three times as long."""
FAINTEST = -60.0
"""Least logarithm of a weight there: denormal numbers, which count nothing, take three times as long."""
BLENDED, APART = 6, 0.0004
"""Places that detail is blended of, and the standard deviation of their weights [m]; the nearest alone is a mosaic."""
CONTRAST = 0.045
"""Largest standard deviation of that detail's logarithm, what palms have from one to four pixels of 256: more is the
edge of a shadow or of a sleeve."""
DARKEST = 0.02
"""Colours are clamped to it before their logarithm is taken [sRGB]."""
SPAN = -0.04, 0.125
"""The stretch along the arm that has a pattern, from the rim [m]."""


def arm_colors(
    skin: CanonicalGaussians, rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], rim: Int[Tensor, "R"],
    axis: Float[Tensor, "3"], palm: Float[Tensor, "3"], points: Float[Tensor, "M 3"], seed: int,
) -> Float[Tensor, "M 3"]:  # fmt: skip
    """Colours at `points` of the arm.

    They are averages of the hand's skin, and wider where that is farther away: with one width the middle of the arm
    would have wedges of one colour each. On them lies a pattern on a cylinder around the arm, which ends towards its
    axis. On the palm's side it is all its own; towards the back more and more of it is the detail of the hand in the
    mirror. That of palms, with their creases and shadows, looked like grain of wood.

    Args:
        skin: Gaussians of the hand before the arm, those less than `MIRRORED` from the rim.
        rest: The surface at rest [m].
        faces: Its faces.
        rim: Vertices where it ends.
        axis: Direction of the arm.
        palm: Direction into which the palm faces.
        points: Where colours are wanted [m].
        seed: Of the pattern.
    """
    centers, start = centers_at_rest(skin, rest, faces), rest[rim]
    middle, radius = start.mean(0), float((start - start.mean(0)).norm(dim=1).mean())
    first = normalize(palm - (palm @ axis) * axis, dim=0)
    second = torch.linalg.cross(axis, first)

    def unrolled(at: Tensor) -> tuple[np.ndarray, np.ndarray, Tensor]:
        """Angle around the arm from the palm's side, place along it, and distance from its axis."""
        along = (at - middle) @ axis
        arm = at - middle - along[:, None] * axis
        around = torch.atan2(arm @ second, arm @ first)
        return around.cpu().double().numpy(), along.cpu().double().numpy(), arm.norm(dim=1)

    around, along, out = unrolled(points)
    back = ((1 - np.cos(around)) / 2)[:, None]
    pattern = (1 - (1 - OWN_ON_BACK) * back) * _pattern(radius, around, along, seed)
    pattern += arm_lines(radius, around, along, seed + 20)
    on_faces = slice(len(skin.vertex_index) if len(skin.face_index) else 0, None)  # vertices have less detail
    angles, places, _ = unrolled(centers[on_faces])
    detail = _detail(skin.colors[on_faces], centers[on_faces])
    sources = cKDTree(_on_cylinder(radius, angles, places))
    pattern += back * _blended(detail, sources, _on_cylinder(radius, around, _mirrored(along)))
    near = _thinned(torch.nonzero(torch.cdist(centers, start).amin(1) < 2 * RIM_FADE)[:, 0], PLACES)
    tone = _tone(skin.colors[near], centers[near], points)
    outer = (2 * out / radius - 1).clamp(0, 1)[:, None]
    return (tone * (torch.from_numpy(pattern).to(tone) * outer).exp()).clamp(max=1)


def _tone(colors: Float[Tensor, "N 3"], centers: Float[Tensor, "N 3"], points: Tensor) -> Float[Tensor, "M 3"]:
    middle = centers.mean(0)  # the nearer the origin is, the less is lost by |p|^2 - 2 p c + |c|^2
    points, centers = points - middle, centers - middle
    far, one = points.square().sum(1, keepdim=True), torch.ones_like(centers[:, :1])
    left = torch.cat([-2 * points, far, torch.ones_like(far)], 1)
    right = torch.cat([centers, one, centers.square().sum(1, keepdim=True)], 1).T
    weighted = torch.cat([colors, one], 1)
    parts = []
    for some in left.split(TOGETHER):
        squared = some @ right
        spread = SMOOTHING**2 + squared.amin(1, keepdim=True).clamp_min(0)
        parts.append(squared.mul_(-0.5 / spread).clamp_(min=FAINTEST).exp_() @ weighted)
    sums = torch.cat(parts)
    return sums[:, :3] / sums[:, 3:]


def _thinned(index: Int[Tensor, "N"], count: int) -> Int[Tensor, "M"]:
    """Every k-th, `count` or so."""
    return index[:: max(1, round(len(index) / count))]


def _detail(colors: Float[Tensor, "N 3"], centers: Float[Tensor, "N 3"]) -> np.ndarray:
    """Differences of the colours' logarithms from those around them, no louder than `CONTRAST`."""
    logs, places = colors.clamp_min(DARKEST).log().cpu().double().numpy(), centers.cpu().double().numpy()
    some = _thinned(torch.arange(len(places)), DETAIL_PLACES).numpy()
    tree = cKDTree(places[some])
    _, near = tree.query(places[some], min(AVERAGED, len(some)), workers=kernel_threads())
    ends = np.arange(0, near.size + 1, near.shape[1])
    average = sparse.csr_array((np.full(near.size, 1 / near.shape[1]), near.ravel(), ends))
    mean, squares = np.split(average @ np.hstack([logs[some], logs[some] ** 2]), 2, axis=1)
    deviation = np.sqrt(np.maximum(squares - mean**2, 0)).mean(1, keepdims=True)
    _, nearest = tree.query(places, workers=kernel_threads())
    detail = (logs - mean[nearest]).clip(-3 * CONTRAST, 3 * CONTRAST)
    return detail * CONTRAST / np.maximum(deviation[nearest], CONTRAST)


def _back_and_forth(places: np.ndarray, length: float) -> np.ndarray:
    """From 0 to `length`, back to 0, and so on."""
    return length - np.abs(places % (2 * length) - length)


def _mirrored(along: np.ndarray) -> np.ndarray:
    """Where the detail at places along the arm is taken from [m]: themselves before the fade, then back and forth."""
    past = along + RIM_FADE
    return np.where(past > 0, -RIM_FADE - _back_and_forth(past, REPEATED), along)


def _blended(detail: np.ndarray, sources: cKDTree, points: np.ndarray) -> np.ndarray:
    far, near = sources.query(points, min(BLENDED, sources.n), workers=kernel_threads())
    shares = np.exp(-0.5 * (far**2 - far[:, :1] ** 2) / APART**2)
    return (detail[near] * shares[..., None]).sum(1) / shares.sum(1)[:, None]


def _on_cylinder(radius: float, angle: np.ndarray, place: np.ndarray, stretch: float = 1.0) -> np.ndarray:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), stretch * place], 1)


def _pattern(radius: float, around: np.ndarray, along: np.ndarray, seed: int) -> np.ndarray:
    """What is added to the logarithms of colours at angles around the arm from the palm and places along it [m]."""

    def scattered(distance: float, seed: int, start: float, end: float, stretch: float = 1.0) -> cKDTree:
        generator = torch.Generator().manual_seed(seed)
        area = 2 * math.pi * radius * (end - start) * stretch
        count = round(TRIED * area / distance**2)
        angle, place = torch.rand(2, count, generator=generator, dtype=torch.float64).numpy()
        place = start + place * (end - start)
        return cKDTree(apart(_on_cylinder(radius, 2 * math.pi * angle, place, stretch), distance))

    cells = scattered(CELL, seed + 8, -2 * CELL, REPEATED + 2 * CELL, LONGER)
    repeated = _back_and_forth(along, REPEATED)
    grain = furrows_and_tones(cells, _on_cylinder(radius, around, repeated, LONGER), seed + 9)
    blood = np.zeros_like(grain)
    for k, (distance, strength) in enumerate(BLOTCHES):
        span, places = (SPAN, along) if distance > FINEST else ((-distance, REPEATED + distance), repeated)
        among = scattered(distance, seed + 10 + 2 * k, *span)
        blood += strength * blotches(among, _on_cylinder(radius, around, places), distance, seed + 11 + 2 * k)
    return grain[:, None] + blood[:, None] * np.array(BLOOD)
