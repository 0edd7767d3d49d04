"""The finest of a hand's skin: furrows around small cells, and cells that differ in tone."""

import functools

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.cells import CELL, LONGER, TRIED, apart, furrows_and_tones
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

ON_PALM = 1.5
"""How much of it palms have, over backs: their ridges and furrows. With .5 palms were smooth."""


def skin_grain(hand: HandModel, gaussians: CanonicalGaussians, seed: int) -> Float[Tensor, "N"]:
    """What is added to the logarithm of the colour at each Gaussian on a face; 0 on nails and on vertices."""
    index, place = gaussians.face_index.cpu(), gaussians.barycentrics.cpu()
    template, faces = hand.template.cpu(), hand.faces.cpu()
    points = (template[faces[index]] * place[..., None]).sum(1)
    values = furrows_and_tones(_cells(hand, seed), _stretched(points.double().numpy()), seed + 5)
    regions = skin_regions(hand)
    share = (1 - (1 - ON_PALM) * regions.palm) * (1 - regions.nail)
    values = torch.from_numpy(values).to(gaussians.colors)
    shares = vertex_to_gaussians(share.to(values)[:, None], hand.faces.to(values.device), gaussians)[:, 0]
    return torch.cat([values.new_zeros(len(gaussians.vertex_index)), values]) * shares


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
    return cKDTree(apart(points, CELL))
