"""What is on one person's skin, drawn from the person's seed before any of it is painted.

Host numbers alone, less than a megabyte, made without a device and without Warp: processes plan people for one that
paints them. Lengths are millimetres.
"""

from typing import NamedTuple

import numpy as np

from oasis_warp.synthetic.atlas import bundled_atlas
from oasis_warp.synthetic.body import FINGERS, bundled_body
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.skin_lines import Palm, draw_back, draw_fingers, draw_wrist
from oasis_warp.synthetic.strokes import Lines, Strokes

STAR, BANDS = 2, 4
"""Patterns of tattoos that take a number of their own."""


class Tattoo(NamedTuple):
    """A picture in ink."""

    pattern: int
    x: float
    z: float
    radius: float
    points: int
    """Of a star, else 0."""
    band: float
    """Place along the forearm of bands, else 0."""
    strength: float


class Plaster(NamedTuple):
    """A strip round a finger."""

    finger: int
    place: int
    """Number of the bone."""
    middle: float
    """Along the bone."""
    shade: float


class SkinPlan(NamedTuple):
    """All that `skin_texture.bake_texture` needs to know of a person."""

    identity: Identity
    lines: Lines
    nail_shifts: np.ndarray
    """How far each nail's root lies from its usual place, [5]."""
    spots: np.ndarray
    """Freckles and moles: centre, radius, strength of pigment, [S, 5]."""
    tattoo: Tattoo | None
    plaster: Plaster | None


def plan_skin(identity: Identity) -> SkinPlan:
    """The skin of one person: a tenth of a second of one CPU core, most of it the courses of lines."""
    rng = np.random.default_rng([identity.seed])
    atlas, strokes = bundled_atlas(), Strokes(rng)
    draw_fingers(atlas, strokes, identity)
    Palm(atlas, strokes, identity).draw()
    draw_wrist(atlas, strokes)
    draw_back(atlas, strokes, identity)
    return SkinPlan(  # in the order in which random numbers are drawn
        identity=identity,
        lines=strokes.lines(),
        nail_shifts=rng.normal(0, 0.3, len(FINGERS)),
        spots=_spots(identity, rng),
        tattoo=_tattoo(identity.tattoo, rng) if identity.tattoo else None,
        plaster=_plaster(rng) if identity.plaster else None,
    )


def plan_person(seed: int, number: int, population: Population) -> SkinPlan:
    """The skin of person `number` of the world `seed`."""
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
