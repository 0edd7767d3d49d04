"""Bake one person's skin into the texture atlas: reflectance, relief and gloss. Lengths are millimetres.

Random numbers and the courses of lines come from the CPU, as a `SkinPlan`; whatever is done a texel is done on the
canvas's device.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import body_on, smoothstep
from oasis_warp.synthetic.canvas import Canvas, canvas_on
from oasis_warp.synthetic.drawn_lines import draw_lines
from oasis_warp.synthetic.identity import Identity
from oasis_warp.synthetic.nails import grown_nails
from oasis_warp.synthetic.ops.surface_patterns import NoiseField, surface_dabs, surface_noise
from oasis_warp.synthetic.ornaments import ornamented
from oasis_warp.synthetic.pigment import Marks, skin_color
from oasis_warp.synthetic.skin_plan import SkinPlan

CHANNELS = ("red", "green", "blue", "height", "fold", "wrinkle", "roughness", "oil")
"""Of the texture: linear reflectance; relief, folds (negative: grooves) that flatten when stretched, wrinkles that
appear when squeezed [mm]; GGX roughness; strength of the specular reflection."""

COARSE_NOISES = {
    "palm_edge": (7.0, 2), "wrist_edge": (8.0, 1), "blotch": (14.0, 3), "flush": (11.0, 3), "lumps": (11.0, 3),
    "palm_lumps": (16.0, 2), "gloss": (6.0, 2),
}  # fmt: skip
FINE_NOISES = {
    "grain": (2.2, 2), "palm_flush": (3.2, 2), "dry": (2.5, 1), "lattice_a": (1.5, 1), "lattice_b": (0.95, 1),
    "ridge": (0.8, 1), "tattoo": (9.0, 2),
}  # fmt: skip
"""Cell of the largest octave [mm], and octaves. Coarse ones are evaluated at the vertices, 2 mm apart."""
PALM_NOISES = ("palm_flush", "ridge")
"""Of the fine ones: shown on the palm alone, 0 where nobody has it."""


def _noises(canvas: Canvas, rest: Float[Tensor, "K 3"], identity: Identity) -> dict[str, Tensor]:
    def fields(table: dict[str, tuple[float, int]], names: Sequence[str], seed: int) -> list[NoiseField]:
        numbers = {name: k for k, name in enumerate(table)}
        return [NoiseField(table[name][0], seed + 97 * numbers[name], table[name][1]) for name in names]

    seed = identity.seed
    coarse = canvas.spread(surface_noise(rest, fields(COARSE_NOISES, tuple(COARSE_NOISES), seed)))
    everywhere = [n for n in FINE_NOISES if n not in PALM_NOISES and (n != "tattoo" or identity.tattoo)]
    fine = surface_noise(canvas.points, fields(FINE_NOISES, everywhere, seed + 5000))
    palmar = torch.zeros(len(PALM_NOISES), len(canvas.points), device=canvas.points.device)
    palmar[:, canvas.palmar] = surface_noise(canvas.palmar_points, fields(FINE_NOISES, PALM_NOISES, seed + 5000))
    return dict(zip((*COARSE_NOISES, *everywhere, *PALM_NOISES), (*coarse, *fine, *palmar), strict=True))


def _spots(canvas: Canvas, plan: SkinPlan) -> Float[Tensor, "N"]:
    """Freckles and moles: strength of pigment."""
    if not len(plan.spots):
        return torch.zeros_like(canvas.palm)
    spots = torch.from_numpy(plan.spots).float().to(canvas.points.device)
    kinds = torch.zeros(len(spots), dtype=torch.int32, device=spots.device)
    return surface_dabs(canvas.grid, spots[:, :3], spots[:, 3], spots[:, 4], kinds, 1, flat=True)[0]


def _marks(canvas: Canvas, plan: SkinPlan, noise: dict[str, Tensor]) -> Marks:
    """Everything that random numbers decide but paint."""
    line = draw_lines(plan.lines, canvas.grid)
    nails = grown_nails(canvas, plan.identity, plan.nail_shifts)
    palm = smoothstep(0.28, 0.80, canvas.palm + 0.08 * noise["palm_edge"])
    palm = palm * smoothstep(9.0, -9.0, canvas.points[:, 0] + 3 * noise["wrist_edge"])
    line["crease"] = line["crease"] * smoothstep(0.28, 0.5, canvas.palm + 0.1 * canvas.hand)
    for kind in ("main", "minor", "halo", "wrinkle"):
        line[kind] = line[kind] * palm
    line["fold"] = line["fold"] * (1 - palm) * (1 - nails.plate)
    groove = line["crease"] + line["main"] + 0.7 * line["minor"]
    return Marks(palm, line, groove, nails, _spots(canvas, plan), noise)


@torch.no_grad()
def paint(plan: SkinPlan, device: str) -> Float[Tensor, "H W 8"]:
    """The texture of the person that was planned, `CHANNELS`, float16, made on the device."""
    canvas, identity = canvas_on(device), plan.identity
    noise = _noises(canvas, body_on(device).rest, identity)
    marks = _marks(canvas, plan, noise)
    color = ornamented(skin_color(canvas, identity, marks), canvas, plan, marks)
    palm, plate, gloss = marks.palm, marks.nails.plate, noise["gloss"]
    roughness = identity.roughness + 0.05 * gloss + 0.04 * palm - 0.06 * canvas.tip * palm
    shine = 0.16 + 0.2 * identity.gloss if identity.polish is not None else 0.32
    roughness = roughness * (1 - plate) + plate * shine
    oil = identity.oil * (1 + 0.25 * gloss) * (1 - 0.35 * marks.groove.clamp(0, 1)) * (1 - plate) + plate * 1.15
    channels = [*color, *_relief(canvas, identity, marks), roughness.clamp(0.12, 0.9), oil.clamp(0.05, 1.5)]
    return canvas.image(torch.stack([channel.half() for channel in channels], 1))


def _relief(canvas: Canvas, identity: Identity, marks: Marks) -> tuple[Tensor, Tensor, Tensor]:
    """Heights [mm]: what stays, what flattens under stretch, what rises when squeezed."""
    palm, line, nails, noise = marks.palm, marks.line, marks.nails, marks.noise
    back, plate = 1 - palm, nails.plate
    bare = 1 - plate
    lattice = (noise["lattice_a"].abs() + 0.7 * noise["lattice_b"].abs()).clamp(0, 1)
    texture = back * (0.08 + 0.06 * identity.age) * lattice * bare + palm * (0.03 * noise["ridge"] + 0.05 * lattice)
    height = -(0.50 * line["crease"] + 0.48 * line["main"] + 0.28 * line["minor"]) - 0.28 * line["halo"]
    height = height + texture + 0.13 * noise["lumps"] * (1 - 0.6 * plate)
    height = height + (0.03 + 0.04 * identity.dryness) * noise["dry"] * bare
    toward_wrist = 0.25 + 0.75 * (canvas.on_finger < 0.5)
    height = height + back * toward_wrist * (
        0.15 * identity.tendons * line["tendon"] + 0.6 * identity.veins * line["vein"]
    )
    height = height + 0.35 * palm * noise["palm_lumps"] + 0.05 * line["hair"]
    height = height + plate * (0.25 - 0.2 * nails.free - 0.35 * nails.across**2) - 0.22 * nails.rim
    fold = -(0.42 + 0.2 * identity.age) * line["fold"] * bare
    wrinkle = -(0.55 + 0.25 * identity.age) * line["wrinkle"]
    return height, fold, wrinkle
