"""The finest of skin: furrows around small cells, and cells that differ in tone."""

import functools

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.processes import kernel_threads
from oasis_warp.core.types import CanonicalGaussians

CELL = 0.0008
"""Least distance between the middles of cells on the mean hand [m]. Finer ones do not show at the spacing of painted
skin."""
LONGER = 1.3
"""How much longer cells are across fingers than along them."""
TRIED = 3.0
"""Points that are tried for each square of that side; a sixth of them become cells."""
FURROW = 0.4
"""Width of furrows over `CELL`, as a difference of the distances to two cells."""
MEAN, DEVIATION = 0.717, 0.339
"""Of this difference over that width, at most 1, on 200,000 random points of the mean hand."""
OF_FURROWS, OF_CELLS = 0.018, 0.008
"""Standard deviations that furrows and tones of cells add to the logarithms of colours. A blind grader liked more than
twice as much as well as this, 4 : 4 on hands of tests/data/photos/same_hand, but in pictures of 256 px it has twice the
contrast of real backs below 1 px."""
ON_PALM = 0.5
"""Share of both that palms have."""


def skin_grain(hand: HandModel, gaussians: CanonicalGaussians, seed: int) -> Float[Tensor, "N"]:
    """What is added to the logarithm of the colour at each Gaussian on a face; 0 on nails and on vertices.

    Worley's cellular noise (1996) on the surface of the mean hand: with distances d1 <= d2 to the nearest two cells,
    furrows lie where d2 - d1 is small.
    """
    index, place = gaussians.face_index.cpu(), gaussians.barycentrics.cpu()
    template, faces = hand.template.cpu(), hand.faces.cpu()
    points = (template[faces[index]] * place[..., None]).sum(1)
    values = _grain_at(_cells(hand, seed), points.double().numpy(), seed)
    regions = skin_regions(hand)
    share = (1 - (1 - ON_PALM) * regions.palm) * (1 - regions.nail)
    values = torch.from_numpy(values).to(gaussians.colors)
    shares = vertex_to_gaussians(share.to(values)[:, None], hand.faces.to(values.device), gaussians)[:, 0]
    return torch.cat([values.new_zeros(len(gaussians.vertex_index)), values]) * shares


def _grain_at(cells: cKDTree, points: np.ndarray, seed: int) -> np.ndarray:
    near, which = cells.query(_stretched(points), 2, workers=kernel_threads())
    tones = torch.randn(cells.n, generator=torch.Generator().manual_seed(seed + 5)).numpy()
    beside = np.minimum((near[:, 1] - near[:, 0]) / (FURROW * CELL), 1)
    return OF_FURROWS * (beside - MEAN) / DEVIATION + OF_CELLS * tones[which[:, 0]]


def _stretched(points: np.ndarray) -> np.ndarray:
    return points * [LONGER, 1, 1]  # fingers point to -x


@functools.lru_cache(2)
@torch.inference_mode(False)
@torch.no_grad()
def _cells(hand: HandModel, seed: int) -> cKDTree:
    """Middles of cells, no two nearer than `CELL`. On the CPU, for equal bits."""
    template, faces = hand.template.cpu().double(), hand.faces.cpu()
    _, areas = surface.face_normals(template, faces)
    generator = torch.Generator().manual_seed(seed + 4)
    count = round(TRIED * LONGER * float(areas.sum()) / CELL**2)
    chance = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    index = torch.searchsorted(areas.cumsum(0), chance[:, 0] * areas.sum()).clamp(max=len(faces) - 1)
    root, share = chance[:, 1:2].sqrt(), chance[:, 2:]  # uniform on a triangle
    weights = torch.cat([1 - root, root * (1 - share), root * share], 1)
    points = _stretched((template[faces[index]] * weights[..., None]).sum(1).numpy())
    return cKDTree(points[_apart(points, CELL)])


def _apart(points: np.ndarray, distance: float) -> np.ndarray:
    """Whether each point is kept: in their order, those that no kept one is nearer to than `distance`."""
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    first, second = pairs.min(1), pairs.max(1)
    kept, undecided = np.zeros(len(points), bool), np.ones(len(points), bool)
    while undecided.any():
        both = undecided[first] & undecided[second]
        first, second = first[both], second[both]
        later = np.zeros_like(undecided)
        later[second] = True
        now = undecided & ~later  # all before them, and near, are decided
        kept |= now
        undecided &= ~now
        undecided[second[now[first]]] = False
    return kept
