"""The parameters of one person's hand, drawn from a seed."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from oasis_warp.core.hand_model import HandModel

IDENTITY_STREAM = 1
"""Stream number that separates the random numbers of identities from those of pictures with the same seed."""
PCA_SPREAD = (0.5, 0.8, 0.8, 0.8, 0.6, 0.6, 0.3, 0.3, 0.3, 0.3)
"""Standard deviations of the first ten shapes: size, proportions, width, thickness, wrist."""
ANATOMY_SPREAD = 0.8
"""Standard deviation of the other shapes: lengths and girths of single bones."""
SHAPE_LIMIT = 2.2


@dataclass(frozen=True, kw_only=True)
class Population:
    """How often things occur among people; 0 for a kind that training must never see."""

    freckles: float = 0.4
    hair: float = 0.5
    polish: float = 0.16
    tattoo: float = 0.06
    ring: float = 0.14
    plaster: float = 0.04
    melanin: tuple[float, float] = (0.006, 0.34)
    """Lightest and darkest skin: volume fractions of melanosomes, log-uniform between them."""


class Identity(NamedTuple):
    """One person's hand. Amounts are in [0, 1] unless said otherwise."""

    shape: np.ndarray
    """Shape coefficients of the hand model, in standard deviations."""
    arm_girth: float
    melanin: float
    """Volume fraction of melanosomes on the back of the hand."""
    blood: float
    oxygen: float
    epidermis: float
    """Thickness [um]."""
    carotene: float
    tan: float
    """How much darker the back is than untanned skin, 1 to 1.6."""
    age: float
    bony: float
    tendons: float
    veins: float
    mottle: float
    line_depth: float
    """Depth of the palm's lines, .6 to 1.4."""
    line_wealth: float
    knuckles: float
    """Depth of the folds over the joints, .5 to 1.5."""
    dryness: float
    oil: float
    roughness: float
    freckles: int
    moles: int
    hairs: int
    hair_melanin: float
    nail_length: float
    """Free edge beyond the bed [mm], negative when bitten."""
    nail_width: float
    nail_shape: float
    """Exponent of the nail's outline: 2 round, 3.4 square."""
    lunula: float
    polish: tuple[float, float, float] | None
    """Linear RGB."""
    gloss: float
    tattoo: int
    """The pattern's number, 0 for none."""
    plaster: bool
    ring_finger: int
    """Index into `body.FINGERS`, -1 for none."""
    ring_place: float
    """Position along the first phalanx, as a share of its length."""
    ring_width: float
    """[mm]."""
    ring_metal: tuple[float, float, float]
    seed: int
    """Seed of all patterns on the skin."""


def sample_identity(hand: HandModel, seed: int, number: int, population: Population) -> Identity:
    """Person `number` of the world `seed`. The same random values are drawn for any population."""
    rng = np.random.default_rng([seed, IDENTITY_STREAM, number])
    u = rng.uniform
    spread = np.full(len(hand.shape_names), ANATOMY_SPREAD)
    spread[: len(PCA_SPREAD)] = PCA_SPREAD
    shape = np.clip(rng.normal(size=len(spread)), -SHAPE_LIMIT, SHAPE_LIMIT) * spread
    low, high = np.log(population.melanin)
    melanin = float(np.exp(u(low, high)))
    age = float(rng.beta(1.5, 2.0))
    hue = u(0, 1)
    polish = _polish(rng)
    has = {name: rng.random() < getattr(population, name)
           for name in ("freckles", "hair", "polish", "tattoo", "ring", "plaster")}  # fmt: skip
    freckles = int(rng.choice([rng.poisson(14), rng.poisson(130)], p=[0.7, 0.3]))
    hairs, tattoo = int(u(60, 600)), int(rng.integers(1, 5))
    ring_finger = int(rng.choice([0, 1, 3, 3, 3, 2]))
    return Identity(
        shape=shape,
        arm_girth=u(0.2, 0.6),
        melanin=melanin,
        blood=float(np.exp(rng.normal(np.log(0.0135), 0.25))),
        oxygen=u(0.6, 0.88),
        epidermis=u(65, 95),
        carotene=u(0, 0.25),
        tan=u(1.0, 1.6),
        age=age,
        bony=float(np.clip(rng.beta(1.6, 1.6) * 0.8 + 0.2 * age, 0, 1)),
        tendons=u(0.2, 1.0),
        veins=float(rng.beta(1.4, 2.6)),
        mottle=u(0.5, 1.5),
        line_depth=u(0.55, 1.35),
        line_wealth=float(np.clip(rng.beta(1.5, 1.8) * 0.7 + 0.3 * age, 0, 1)),
        knuckles=u(0.5, 1.5),
        dryness=u(0, 1),
        oil=u(0.2, 0.7),
        roughness=u(0.46, 0.66),
        freckles=freckles * has["freckles"],
        moles=int(rng.integers(0, 5)),
        hairs=hairs * has["hair"],
        hair_melanin=float(np.clip(hue + (melanin > 0.06), 0, 1)),
        nail_length=float(rng.choice([u(-0.6, 0.6), u(0.6, 3.0)], p=[0.7, 0.3])),
        nail_width=u(0.8, 1.7),
        nail_shape=u(2.1, 3.2),
        lunula=u(0, 1),
        polish=polish if has["polish"] else None,
        gloss=u(0, 1),
        tattoo=tattoo * has["tattoo"],
        plaster=bool(has["plaster"]),
        ring_finger=ring_finger if has["ring"] else -1,
        ring_place=u(0.5, 0.66),
        ring_width=u(1.8, 5.5),
        ring_metal=tuple(np.array([[0.9, 0.65, 0.25], [0.85, 0.82, 0.78], [0.8, 0.5, 0.4]])[rng.integers(3)]),
        seed=int(rng.integers(1 << 20)),
    )


def _polish(rng: np.random.Generator) -> tuple[float, float, float]:
    """A nail polish: red or pink mostly, then nude or dark, sometimes any colour."""
    kind = rng.choice(4, p=[0.4, 0.25, 0.15, 0.2])
    value = rng.random(3)
    color = [
        np.array([0.35 + 0.45 * value[0], 0.02 + 0.2 * value[1] ** 2, 0.04 + 0.2 * value[1] ** 2]),
        np.array([0.62, 0.36, 0.30]) * (0.7 + 0.5 * value[0]),
        0.01 + 0.07 * value,
        value**1.6,
    ][kind]
    red, green, blue = (float(c) for c in np.clip(color, 0.01, 0.85))
    return red, green, blue
