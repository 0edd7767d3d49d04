"""Lines of the arm: creases of the wrist, tendons before them and veins."""

import math

import numpy as np

CREASES = (-0.006, 1.0), (0.002, 0.75), (0.0125, 0.5)
"""Places of the wrist's creases on the palm's side, from the rim towards the arm [m], and their strengths."""
CREASE = -0.11, -0.154, -0.165
"""What the strongest adds to the logarithms of the colours."""
NARROW, WIDE, IN_WIDE = 0.00045, 0.0014, 0.3
"""Standard deviations of a crease and of the hollow around it [m], and how dark the hollow is over the crease."""
HALF_LENGTH, SHORTER, ENDS = 0.016, 0.12, 0.002
"""Half of the first crease's length [m], the share by which each further one is shorter, and over what they end [m]."""
VEIN = -0.07, -0.035, -0.03
"""What a vein adds to the logarithms of the colours."""
INNER_VEINS = (-0.009, 0.8), (0.004, 1.0), (0.013, 0.7)
"""Places beside the middle of the palm's side [m], and strengths."""
OUTER_VEINS = (-0.008, 0.64), (0.007, 0.8)
"""The same beside the middle of the back's side."""
VEIN_WIDTH = 0.0012
"""Standard deviation [m]."""
TENDONS = (-0.004, 1.0), (0.0025, 0.8)
"""Places beside the middle of the palm's side [m], and strengths."""
TENDON, TENDON_WIDTH, TENDON_END = 0.045, 0.0018, 0.03
"""What light on a tendon adds to the logarithms, its standard deviation and the length over which it ends [m]."""

TABLE = 500
"""Steps of a wave's period: between them it is off by 4e-4 of its deviation."""


def arm_lines(radius: float, angle: np.ndarray, along: np.ndarray, seed: int) -> np.ndarray:
    """What lines add to the logarithms of colours [M, 3].

    Args:
        radius: Of the arm [m].
        angle: Around the arm from the middle of the palm's side, -pi to pi, [M].
        along: From the rim towards the arm [m], [M].
        seed: Of their paths.
    """
    rng = np.random.default_rng(seed)
    inner, outer = radius * angle, radius * (np.mod(angle, 2 * math.pi) - math.pi)
    logs = np.zeros((len(angle), 3))
    for k, (place, strength) in enumerate(CREASES):
        path = place + 0.0012 * _wave(rng, inner, 0.05) + 0.0003 * _wave(rng, inner, 0.015)
        width = NARROW * (1 + 0.3 * _wave(rng, inner, 0.02))
        middle, half = 0.004 * rng.normal(), HALF_LENGTH * (1 - SHORTER * k) + 0.003 * rng.normal()
        depth = _bump(along - path, width) + IN_WIDE * _bump(along - path, WIDE)
        logs += (strength * _step((half - np.abs(inner - middle)) / ENDS) * depth)[:, None] * np.array(CREASE)
    for beside, veins in ((inner, INNER_VEINS), (outer, OUTER_VEINS)):
        for place, strength in veins:
            path = place + 0.004 * _wave(rng, along, 0.11)
            line = strength * _step((along - 0.006) / 0.005) * _bump(beside - path, VEIN_WIDTH)
            logs += line[:, None] * np.array(VEIN)
    for place, strength in TENDONS:
        across = inner - place - 0.001 * _wave(rng, along, 0.15)
        shadows = sum(_bump(across + side * 1.8 * TENDON_WIDTH, TENDON_WIDTH) for side in (-1, 1))
        shown = _step((along + 0.002) / 0.004) * np.exp(-np.maximum(along - 0.02, 0) / TENDON_END)
        logs += (TENDON * strength * shown * (_bump(across, TENDON_WIDTH) - 0.6 * shadows))[:, None]
    return logs


def _wave(rng: np.random.Generator, place: np.ndarray, length: float) -> np.ndarray:
    """Smooth noise with a deviation of about 1 that repeats after `length`, read from a table."""
    order, turns = np.arange(1, 6), np.arange(TABLE + 1)[:, None] / TABLE
    heights, phases = rng.normal(size=5) / order / 1.2, rng.uniform(0, 2 * math.pi, 5)
    wave = (heights * np.cos(2 * math.pi * order * turns + phases)).sum(1)
    steps = place * (TABLE / length)
    before = np.floor(steps)
    at = before.astype(int) % TABLE
    return wave[at] + (steps - before) * np.diff(wave)[at]


def _bump(distance: np.ndarray, width: float | np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (distance / width) ** 2)


def _step(x: np.ndarray) -> np.ndarray:
    """0 below, 1 above."""
    return 0.5 + 0.5 * np.tanh(0.5 * x)
