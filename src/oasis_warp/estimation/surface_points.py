"""Places on the hand's surface that pixels show, as the dense network reads them."""

import functools

import numpy as np
from scipy.spatial import KDTree

from oasis_warp.estimation.fit import SurfacePoints
from oasis_warp.estimation.pixel_reading import PixelReading
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand

_HAND = 0.6
"""Least probability of the hand at a pixel that is used."""
_SPREAD = 0.015
"""Largest spread of the surface point at a pixel that is used [m]."""
_MOST_POINTS = 500
"""More do not fit better: the errors of neighbouring pixels are alike."""


@functools.cache
def _bundled() -> HandKinematics:
    return HandKinematics(bundled_hand())


@functools.cache
def _rest_places(template: bytes) -> KDTree:
    return KDTree(np.frombuffer(template).reshape(-1, 3))


def surface_points(kinematics: HandKinematics, reading: PixelReading, scale: float) -> SurfacePoints:
    """Where the confident pixels of the hand lie on the mean hand at rest; at most some 500, evenly over the picture.

    `scale` is in pixels of the photo per metre.
    """
    good = (reading.hand > _HAND) & (reading.spread < _SPREAD)
    step = max(1, int(np.ceil(np.sqrt(good.sum() / _MOST_POINTS))))
    rows, columns = np.nonzero(good[step // 2 :: step, step // 2 :: step])
    rows, columns = rows * step + step // 2, columns * step + step // 2
    places = reading.surface[:, rows, columns].T.astype(np.float64)
    learned = kinematics if kinematics.hand.origin is None else _bundled()  # the network knows places on this hand
    _, vertex = _rest_places(learned.template.tobytes()).query(places)
    normal = learned.rest_normals[vertex]
    offset = places - learned.template[vertex]
    offset -= normal * (offset * normal).sum(1, keepdims=True)
    if learned is not kinematics:
        offset[:] = 0  # below half an edge, and turned as the two hands rest differently
    return SurfacePoints(
        vertex=vertex,
        offset=offset,
        displacement=offset,
        xy=reading.to_photo(np.stack([columns, rows], 1) + 0.5),
        spread=scale * reading.spread[rows, columns].astype(np.float64),
        normal=reading.normal[:, rows, columns].T.astype(np.float64),
    )
