"""Sample everything on one person's skin before it is baked into a texture.

A plan is less than a megabyte of numbers, sampled without a device and without Warp, so that worker processes can plan
people for the process that bakes them. Lengths are millimetres.
"""

from typing import NamedTuple

import numpy as np

from oasis_warp.synthetic.atlas import bundled_atlas
from oasis_warp.synthetic.body import FINGERS, bundled_body
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.skin_lines import Lines, Palm, Strokes, draw_back, draw_fingers, draw_wrist

STAR, BANDS = 2, 4
"""Tattoo patterns with a parameter of their own."""


class Tattoo(NamedTuple):
    """Parameters of a tattoo."""

    pattern: int
    x: float
    z: float
    radius: float
    points: int
    """Number of a star's points, else 0."""
    band: float
    """Position of bands along the forearm, else 0."""
    strength: float


class Plaster(NamedTuple):
    """A strip around a finger."""

    finger: int
    place: int
    """Index of the bone."""
    middle: float
    """Position along the bone."""
    shade: float


class SkinPlan(NamedTuple):
    """All that `skin_texture.bake_texture` needs of a person."""

    identity: Identity
    lines: Lines
    nail_shifts: np.ndarray
    """Shift of each nail's root along its finger, [5]."""
    spots: np.ndarray
    """Freckles and moles: centre, radius, strength of pigment, [S, 5]."""
    tattoo: Tattoo | None
    plaster: Plaster | None


def plan_skin(identity: Identity) -> SkinPlan:
    """Plan the skin of one person: 0.1 s on one CPU core, mostly for the courses of lines."""
    rng = np.random.default_rng([identity.seed])
    atlas, strokes = bundled_atlas(), Strokes(rng)
    draw_fingers(atlas, strokes, identity)
    Palm(atlas, strokes, identity).draw()
    draw_wrist(atlas, strokes)
    draw_back(atlas, strokes, identity)
    return SkinPlan(  # the order decides on the random numbers
        identity=identity,
        lines=strokes.lines(),
        nail_shifts=rng.normal(0, 0.3, len(FINGERS)),
        spots=_spots(identity, rng),
        tattoo=_tattoo(identity.tattoo, rng) if identity.tattoo else None,
        plaster=_plaster(rng) if identity.plaster else None,
    )


def plan_person(seed: int, number: int, population: Population) -> SkinPlan:
    """Plan the skin of person `number` of the world `seed`."""
    return plan_skin(sample_identity(bundled_body().hand, seed, number, population))


def _spots(identity: Identity, rng: np.random.Generator) -> np.ndarray:
    total = identity.freckles + identity.moles
    if not total:
        return np.empty((0, 5))
    positions = bundled_atlas().positions
    centers = positions[rng.choice(len(positions), total)]
    radius, strength = rng.uniform(0.35, 1.1, total), rng.uniform(0.2, 1.2, total)
    strength[identity.freckles :] *= 1.6
    return np.c_[centers, radius, strength]


def _tattoo(pattern: int, rng: np.random.Generator) -> Tattoo:
    x, z, radius = rng.uniform(-70, 40), rng.uniform(-16, 12), rng.uniform(11, 24)
    points = int(rng.integers(4, 8)) if pattern == STAR else 0
    band = rng.uniform(25, 60) if pattern == BANDS else 0.0
    return Tattoo(pattern, x, z, radius, points, band, rng.uniform(0.6, 0.92))


def _plaster(rng: np.random.Generator) -> Plaster:
    finger, place = int(rng.integers(4)), int(rng.integers(0, 2))
    return Plaster(finger, place, rng.uniform(4, 14), rng.uniform(0.6, 1.25))
