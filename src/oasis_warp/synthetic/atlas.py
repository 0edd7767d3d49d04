"""The texture atlas: which point of the resting surface each texel shows, and what is known of that point.

Everything that is painted is a function of these points, so it has no seams. Lengths are millimetres of the mean hand.
"""

import functools
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.ops import depth_map
from oasis_warp.synthetic.body import FINGERS, Body, bundled_body

WIDTH, HEIGHT = 1024, 1408
"""Texels of the atlas: .34 mm each on the hand, enough for a hand that fills 512 pixels."""


class Atlas:
    """Labels of the N texels that show skin."""

    points: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]
    palm: Float[Tensor, "N"]
    finger: Tensor
    """int64 [N]: place in `body.FINGERS`, -1 on palm and arm."""
    finger_weight: Float[Tensor, "N"]
    local: Float[Tensor, "N 3 3"]
    """Coordinates (along, side, back) about each of the three bones of the texel's finger; nonsense off the fingers."""

    def __init__(self, body: Body):
        scale = torch.tensor([WIDTH, HEIGHT], dtype=torch.float32)
        flat = torch.cat([body.uv * scale, torch.ones(len(body.uv), 1)], 1)
        seen = depth_map(flat, body.uv_faces, torch.eye(4), torch.eye(3), WIDTH, HEIGHT)
        shown = seen.face_ids >= 0
        corners = body.faces[seen.face_ids[shown].long()]
        self.body, self._corners, self._weights = body, corners, seen.barycentrics[shown][..., None]
        self.points, self.palm = self.spread(body.rest), self.spread(body.palm[:, None])[:, 0]
        self.normals = torch.nn.functional.normalize(self.spread(body.normals), dim=-1)
        share = self.spread(body.finger_weights)
        self.finger_weight, best = share.max(1)
        self.finger = torch.where(self.finger_weight > 0.5, best, -1)
        self._positions = self.points.double().numpy()
        local = np.zeros((len(self.points), 3, 3), np.float32)
        for finger, bones in enumerate(body.bones):
            here = (self.finger == finger).numpy()
            for place, bone in enumerate(bones):
                local[here, place] = bone.local(self._positions[here])
        self.local = torch.from_numpy(local)
        nearest = np.asarray(distance_transform_edt(~shown.numpy(), return_distances=False, return_indices=True))
        number = torch.full((HEIGHT, WIDTH), -1, dtype=torch.int64)
        number[shown] = torch.arange(int(shown.sum()))
        self._fill = number[torch.from_numpy(nearest[0]).long(), torch.from_numpy(nearest[1]).long()]
        """Texel shown at each place; beyond the islands the nearest, so that interpolation does not bleed."""
        self._trees: dict[str, tuple[np.ndarray, cKDTree, tuple[int, ...]]] = {}

    def spread(self, values: Float[Tensor, "K C"]) -> Float[Tensor, "N C"]:
        """Values of the vertices of hand and forearm, interpolated at the texels."""
        return (values[self._corners] * self._weights).sum(1)

    def image(self, values: Float[Tensor, "N C"]) -> Float[Tensor, "H W C"]:
        """Values of the texels as a picture of the atlas."""
        return values[self._fill.to(values.device)]

    def snap(self, points: np.ndarray, region: str) -> np.ndarray:
        """The nearest surface points [mm] of a named region: a finger's name, "palm", "back" or "wrist".

        Off the fingers nearness is judged in the plane of the palm, so that the height of `points` does not matter.
        """
        if region not in self._trees:
            keep, axes = self._region(region)
            index = np.nonzero(keep)[0]
            self._trees[region] = index, cKDTree(self._positions[index][:, axes]), axes
        index, tree, axes = self._trees[region]
        return self._positions[index[tree.query(np.asarray(points)[:, axes])[1]]]

    def _region(self, region: str) -> tuple[np.ndarray, tuple[int, ...]]:
        if region in FINGERS:
            return (self.finger == FINGERS.index(region)).numpy(), (0, 1, 2)
        n, x = self.normals[:, 1].numpy(), self._positions[:, 0]
        on_hand = ((self.finger < 0) | (self.finger_weight < 0.92)).numpy()
        keep: dict[str, Callable[[], np.ndarray]] = {
            "palm": lambda: (n < -0.15) & on_hand & (x < 8),
            "back": lambda: (n > 0.15) & on_hand,
            "wrist": lambda: (n < -0.1) & (x > -14),
        }
        return keep[region](), (0, 2)


@functools.cache
def bundled_atlas() -> Atlas:
    """The atlas of `bundled_body`: about a second the first time."""
    return Atlas(bundled_body())
