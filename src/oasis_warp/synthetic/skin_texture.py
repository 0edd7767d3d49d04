"""Bake one person's skin into the texture atlas: reflectance, relief and gloss. Lengths are millimetres.

Random numbers and the courses of lines come from the CPU, as a `SkinPlan`; all work per texel runs on the device of the
texels. Nails are superellipses in the frames of the last bones, fitted to the nail labels of the hand model.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import FINGERS, THUMB, body_on, bundled_body, smoothstep
from oasis_warp.synthetic.identity import Identity
from oasis_warp.synthetic.ops.surface_patterns import NoiseField, surface_dabs, surface_noise
from oasis_warp.synthetic.skin_plan import STAR, SkinPlan, Tattoo
from oasis_warp.synthetic.spectrum import Tint, skin_colors
from oasis_warp.synthetic.texels import Texels, draw_lines, texels_on

_NEAR = 2.0
"""Distance from its outline up to which a nail affects the skin [mm]."""
OPAL, HORN, LUNULA = (0.75, 0.62, 0.52), (0.74, 0.68, 0.56), (0.72, 0.60, 0.53)
"""Colours of a nail's plate, its free edge and its lunula, linear RGB."""
INK = (0.86, 0.80, 0.70)
"""Share of red, green and blue light that ink absorbs."""
PLASTER, HAIR = (0.62, 0.42, 0.28), (0.30, 0.18, 0.09)
"""Colours of a plaster and of fair hair, linear RGB."""


class NailMaps(NamedTuple):
    """Share of each texel that is this part of a nail, [N]."""

    plate: Tensor
    lunula: Tensor
    free: Tensor
    """The free edge beyond the bed."""
    across: Tensor
    """Position across the plate, -1 to 1."""
    rim: Tensor
    """The fold around the plate."""


class _Outline(NamedTuple):
    """The nail of each finger, or of each texel's finger [mm]."""

    low: Tensor
    high: Tensor
    middle: Tensor
    half: Tensor
    moon: Tensor
    """Radius of the lunula; 0 for none."""
    edge: Tensor
    """Where the free edge begins."""


@functools.cache
def _labelled() -> np.ndarray:
    """Extent of the nail labels along and across each last bone [mm], [5, 4]."""
    body, rows = bundled_body(), []
    hand = body.hand
    for finger in range(len(FINGERS)):
        on_nail = ((hand.nail > 0.6) & (hand.segment == 3 * finger + 3)).numpy()
        along, side, _ = body.bones[finger][2].local(hand.template.double().numpy()[on_nail] * 1e3).T
        rows.append((along.min(), along.max(), side.min(), side.max()))
    return np.array(rows)


def nail_maps(texels: Texels, identity: Identity, shifts: np.ndarray) -> NailMaps:
    """The nails of a person; the root of each is moved along its finger by `shifts` [mm], [5]."""
    start, end, left, right = _labelled().T
    low = start - 1.2 + shifts
    high = end + 0.2 + 0.5 * identity.nail_length
    size = identity.lunula * np.where(np.arange(len(FINGERS)) == THUMB, 0.7, 0.4) * (high - low) / 2
    outline = np.stack([
        low, high, (right + left) / 2, (right - left) / 2 + identity.nail_width, np.where(size > 0.8, 1.3 * size, 0),
        high - max(0.45, 0.5 * identity.nail_length + 0.5),
    ])  # fmt: skip
    device = texels.points.device
    of = _Outline(*torch.from_numpy(outline).float().to(device)[:, texels.nail_fingers])
    t, x = texels.nail_places.unbind(1)
    center, reach, x = (of.high + of.low) / 2, (of.high - of.low) / 2, x - of.middle
    power = identity.nail_shape
    round_ = (x.abs() / of.half) ** power + ((t - center).abs() / reach) ** power
    distance = (round_.clamp_min(1e-6) ** (1 / power) - 1) * of.half  # negative inside
    plate = smoothstep(0.12, -0.12, distance)
    moon = torch.hypot(x * 0.75, t - of.low + reach * 0.1) - of.moon
    near = distance < _NEAR
    values = torch.zeros(len(NailMaps._fields), len(texels.points), device=device)
    values[:, texels.nails] = torch.stack([
        plate,
        (of.moon > 0) * plate * smoothstep(0.5, -0.3, moon),
        plate * smoothstep(-0.15, 0.3, t - of.edge + 0.03 * x**2),
        near * x / of.half,
        near * torch.exp(-(((distance - 0.15) / 0.3) ** 2)),
    ])  # fmt: skip
    return NailMaps(*values)


class SkinMaps(NamedTuple):
    """Features of one person's skin at every texel, [N] each."""

    palm: Float[Tensor, "N"]
    """Share of each texel that is palm."""
    line: dict[str, Tensor]
    """Strength of each of `strokes.KINDS`."""
    groove: Float[Tensor, "N"]
    """Strength of the lines in which blood shows and oil gathers."""
    nails: NailMaps
    spots: Float[Tensor, "N"]
    noise: dict[str, Tensor]
    """The fields of `COARSE_NOISES` and `FINE_NOISES`."""


def column(values: tuple[float, ...], like: Tensor) -> Float[Tensor, "3 1"]:
    """A colour that broadcasts over `like`."""
    return like.new_tensor(values)[:, None]


def _pigments(texels: Texels, identity: Identity, maps: SkinMaps) -> tuple[Tensor, Tensor]:
    """Volume fractions of melanin and blood."""
    noise, line, palm = maps.noise, maps.line, maps.palm
    back, m = 1 - palm, identity.melanin
    knuckles = texels.knuckle * back
    palm_melanin = min(0.6 * m, 0.006 + 0.33 * m)
    melanin = m * (1 + (identity.tan - 1) * back) * back + palm_melanin * palm
    lattice = (noise["lattice_a"].abs() + noise["lattice_b"].abs()).clamp(0, 1)
    melanin = melanin * (1 + (0.10 * back + 0.06 * palm) * (0.5 - lattice))
    melanin = melanin * (1 + 0.18 * noise["blotch"] + 0.15 * noise["grain"])
    melanin = melanin * (1 + (0.35 + 0.18 * identity.knuckles) * knuckles + 0.25 * line["fold"])
    pigmented = line["main"] + line["crease"] + 0.6 * line["minor"]  # dark palms have darker lines
    melanin = melanin + palm * pigmented * (0.05 * m + 0.35 * max(0.0, m - 0.06))
    inner_arm = smoothstep(0.45, 0.75, texels.palm) * (1 - texels.hand)
    melanin = melanin * (1 - 0.3 * inner_arm) + maps.spots * back * (0.03 + 0.5 * m)

    blood = identity.blood * (
        1 + 0.55 * palm + 1.1 * texels.tip * (0.5 + 0.5 * palm) + 0.9 * knuckles + 0.35 * texels.on_finger
    )
    pad = palm * (1 - texels.on_finger)
    blood = blood * (1 + identity.mottle * (0.42 * noise["flush"] + 0.45 * palm * noise["palm_flush"]) + 0.15 * pad)
    vein = line["vein"] * identity.veins
    blood = blood * (1 + 0.55 * maps.groove.clamp(max=1.2) * (0.8 * palm + 0.2) + 0.2 * line["halo"])
    return melanin, (blood * (1 - 0.25 * vein)).clamp_min(0.002)


def skin_color(texels: Texels, identity: Identity, maps: SkinMaps) -> Float[Tensor, "3 N"]:
    """Linear reflectance of skin and unpolished nails."""
    line, palm, m = maps.line, maps.palm, identity.melanin
    melanin, blood = _pigments(texels, identity, maps)
    yellow, oxygen = 0.5 * identity.carotene, identity.oxygen
    horny = identity.carotene + 0.12 * (m < 0.08)
    color, palm_color = skin_colors(
        melanin, blood, [Tint(oxygen, identity.epidermis, yellow), Tint(oxygen, identity.epidermis, horny)]
    )
    color = color + (palm_color - color) * palm
    (deep,) = skin_colors(melanin, 0.9 * blood, [Tint(0.15, identity.epidermis, yellow)])
    deep = deep * column((0.8, 0.95, 1.05), deep)
    color = color + (deep - color) * (0.5 * identity.veins * line["vein"] * (1 - palm)).clamp(0, 1)
    color[:, texels.nails] = _with_nails(color[:, texels.nails], texels, identity, maps)
    dark = 0.40 * line["crease"] + 0.38 * line["main"] + 0.20 * line["minor"] + 0.09 * line["halo"]
    return color * torch.exp(-dark * column((0.75, 1.1, 1.15), dark))  # cavities: dark and warm


def _with_nails(
    color: Float[Tensor, "3 M"], texels: Texels, identity: Identity, maps: SkinMaps
) -> Float[Tensor, "3 M"]:
    """Blend the nails into the colours of `Texels.nails`."""
    nails, m = NailMaps(*(share[texels.nails] for share in maps.nails)), identity.melanin
    blood = identity.blood * (1.6 + 0.3 * maps.noise["dry"][texels.nails])
    melanin = torch.full_like(blood, 0.62 * m + 0.004)
    (bed,) = skin_colors(melanin, blood, [Tint(identity.oxygen, identity.epidermis, 0.0)])
    bed = 0.94 * bed + 0.05 * column(OPAL, bed)
    pale = column(LUNULA, bed) * (0.75 + 0.25 * (m < 0.1))
    bed = bed + (pale - bed) * (0.35 * nails.lunula)
    bed = bed + (column(HORN, bed) - bed) * (0.55 * nails.free)
    return color + (bed - color) * nails.plate


def add_ornaments(color: Float[Tensor, "3 N"], texels: Texels, plan: SkinPlan, maps: SkinMaps) -> Float[Tensor, "3 N"]:
    """Add tattoo, polish, plaster, hair and the folds around the nails."""
    plate, identity = maps.nails.plate, plan.identity
    if plan.tattoo is not None:
        ink = _ink(texels.points, plan.tattoo, maps.noise["tattoo"]) * smoothstep(0.5, 0.3, texels.palm)
        color = color * (1 - ink * column(INK, color))
    if identity.polish is not None:
        coat = column(identity.polish, color) * 0.8 + 0.02
        color = color + (coat - color) * plate
    if plan.plaster is not None:
        finger, place, middle, shade = plan.plaster
        bone = bundled_body().bones[finger][place]
        points = texels.points
        t = (points - points.new_tensor(bone.origin)) @ points.new_tensor(bone.along) - middle
        holes = torch.sin(points[:, 0] * 2.6) * torch.sin(points[:, 1] * 2.6 + points[:, 2] * 2.6) > 0.55
        strip = (texels.finger == finger) * smoothstep(9.2, 8.8, t.abs()) * (1 - 0.3 * holes)
        tan = column(PLASTER, color) * shade
        color = color + (tan - color) * strip
    if identity.hairs:
        hair = column(HAIR, color) * (1 - identity.hair_melanin) ** 1.5 + 0.02
        color = color + (hair - color) * (0.75 * maps.line["hair"] * (1 - plate)).clamp(0, 1)
    color = color * (1 - 0.30 * maps.nails.rim * column((0.7, 1.0, 1.05), color))
    return color.clamp(0.003, 0.9)


def _ink(points: Tensor, tattoo: Tattoo, noise: Tensor) -> Tensor:
    """Amount of ink in [0, 1]: scrollwork, a star, rows of script, or bands around the forearm."""
    pattern, r = tattoo.pattern, tattoo.radius
    x, z = points[:, 0] - tattoo.x, points[:, 2] - tattoo.z
    d, angle = torch.hypot(x, z), torch.atan2(z, x)
    if pattern == 1:
        ink = smoothstep(0.14, 0.08, noise.abs()) * smoothstep(r, r - 1, d)
    elif pattern == STAR:
        edge = r * (0.55 + 0.4 * torch.cos(tattoo.points * angle))
        ink = smoothstep(1.0, 0.6, (d - edge).abs()) + 0.8 * smoothstep(0.5, -0.1, d - 0.45 * edge)
        ink = ink + smoothstep(0.6, 0.3, (d - 1.05 * r).abs())
    elif pattern == 3:
        letter = torch.sin(2.1 * x) + torch.sin(3.7 * x + 2 * torch.sin(0.9 * x))
        row = torch.remainder(z + 30, 5.0) - 2.5
        ink = smoothstep(0.5, 0.25, (row - 0.7 * letter).abs()) * smoothstep(r, r - 0.5, x.abs())
        ink = ink * smoothstep(7.6, 7.4, z.abs())
    else:
        arm = points[:, 0] - tattoo.band
        ink = smoothstep(3.0, 2.6, arm.abs()) + smoothstep(0.9, 0.6, (arm.abs() - 6 + noise).abs())
    return (ink.clamp(0, 1) * tattoo.strength).clamp(0, 1)


CHANNELS = ("red", "green", "blue", "height", "fold", "wrinkle", "roughness", "oil")
"""Channels of the texture: linear reflectance; relief, folds (negative) that flatten when stretched, wrinkles that
appear when compressed [mm]; GGX roughness; strength of the specular reflection."""

COARSE_NOISES = {
    "palm_edge": (7.0, 2), "wrist_edge": (8.0, 1), "blotch": (14.0, 3), "flush": (11.0, 3), "lumps": (11.0, 3),
    "palm_lumps": (16.0, 2), "gloss": (6.0, 2),
}  # fmt: skip
FINE_NOISES = {
    "grain": (2.2, 2), "palm_flush": (3.2, 2), "dry": (2.5, 1), "lattice_a": (1.5, 1), "lattice_b": (0.95, 1),
    "ridge": (0.8, 1), "tattoo": (9.0, 2),
}  # fmt: skip
"""Cell of the largest octave [mm], and number of octaves. Coarse ones are evaluated at the vertices, 2 mm apart."""
PALM_NOISES = ("palm_flush", "ridge")
"""Fine noises that appear on the palm only; 0 elsewhere."""


def _noises(texels: Texels, rest: Float[Tensor, "K 3"], identity: Identity) -> dict[str, Tensor]:
    def fields(table: dict[str, tuple[float, int]], names: Sequence[str], seed: int) -> list[NoiseField]:
        numbers = {name: k for k, name in enumerate(table)}
        return [NoiseField(table[name][0], seed + 97 * numbers[name], table[name][1]) for name in names]

    seed = identity.seed
    coarse = texels.spread(surface_noise(rest, fields(COARSE_NOISES, tuple(COARSE_NOISES), seed)))
    everywhere = [n for n in FINE_NOISES if n not in PALM_NOISES and (n != "tattoo" or identity.tattoo)]
    fine = surface_noise(texels.points, fields(FINE_NOISES, everywhere, seed + 5000))
    palmar = torch.zeros(len(PALM_NOISES), len(texels.points), device=texels.points.device)
    palmar[:, texels.palmar] = surface_noise(texels.palmar_points, fields(FINE_NOISES, PALM_NOISES, seed + 5000))
    return dict(zip((*COARSE_NOISES, *everywhere, *PALM_NOISES), (*coarse, *fine, *palmar), strict=True))


def _spots(texels: Texels, plan: SkinPlan) -> Float[Tensor, "N"]:
    """Strength of pigment in freckles and moles."""
    if not len(plan.spots):
        return torch.zeros_like(texels.palm)
    spots = torch.from_numpy(plan.spots).float().to(texels.points.device)
    kinds = torch.zeros(len(spots), dtype=torch.int32, device=spots.device)
    return surface_dabs(texels.grid, spots[:, :3], spots[:, 3], spots[:, 4], kinds, 1, flat=True)[0]


def _skin_maps(texels: Texels, plan: SkinPlan, noise: dict[str, Tensor]) -> SkinMaps:
    """Lines, nails, spots and the border of the palm."""
    line = draw_lines(plan.lines, texels.grid)
    nails = nail_maps(texels, plan.identity, plan.nail_shifts)
    palm = smoothstep(0.28, 0.80, texels.palm + 0.08 * noise["palm_edge"])
    palm = palm * smoothstep(9.0, -9.0, texels.points[:, 0] + 3 * noise["wrist_edge"])
    line["crease"] = line["crease"] * smoothstep(0.28, 0.5, texels.palm + 0.1 * texels.hand)
    for kind in ("main", "minor", "halo", "wrinkle"):
        line[kind] = line[kind] * palm
    line["fold"] = line["fold"] * (1 - palm) * (1 - nails.plate)
    groove = line["crease"] + line["main"] + 0.7 * line["minor"]
    return SkinMaps(palm, line, groove, nails, _spots(texels, plan), noise)


@torch.no_grad()
def bake_texture(plan: SkinPlan, device: str) -> Float[Tensor, "H W 8"]:
    """The texture of a planned person: `CHANNELS` in float16 on the device."""
    texels, identity = texels_on(device), plan.identity
    noise = _noises(texels, body_on(device).rest, identity)
    maps = _skin_maps(texels, plan, noise)
    color = add_ornaments(skin_color(texels, identity, maps), texels, plan, maps)
    palm, plate, gloss = maps.palm, maps.nails.plate, noise["gloss"]
    roughness = identity.roughness + 0.05 * gloss + 0.04 * palm - 0.06 * texels.tip * palm
    shine = 0.16 + 0.2 * identity.gloss if identity.polish is not None else 0.32
    roughness = roughness * (1 - plate) + plate * shine
    oil = identity.oil * (1 + 0.25 * gloss) * (1 - 0.35 * maps.groove.clamp(0, 1)) * (1 - plate) + plate * 1.15
    channels = [*color, *_relief(texels, identity, maps), roughness.clamp(0.12, 0.9), oil.clamp(0.05, 1.5)]
    return texels.image(torch.stack([channel.half() for channel in channels], 1))


def _relief(texels: Texels, identity: Identity, maps: SkinMaps) -> tuple[Tensor, Tensor, Tensor]:
    """Heights [mm]: constant, flattening under stretch, and rising under compression."""
    palm, line, nails, noise = maps.palm, maps.line, maps.nails, maps.noise
    back, plate = 1 - palm, nails.plate
    bare = 1 - plate
    lattice = (noise["lattice_a"].abs() + 0.7 * noise["lattice_b"].abs()).clamp(0, 1)
    texture = back * (0.08 + 0.06 * identity.age) * lattice * bare + palm * (0.03 * noise["ridge"] + 0.05 * lattice)
    height = -(0.50 * line["crease"] + 0.48 * line["main"] + 0.28 * line["minor"]) - 0.28 * line["halo"]
    height = height + texture + 0.13 * noise["lumps"] * (1 - 0.6 * plate)
    height = height + (0.03 + 0.04 * identity.dryness) * noise["dry"] * bare
    toward_wrist = 0.25 + 0.75 * (texels.on_finger < 0.5)
    height = height + back * toward_wrist * (
        0.15 * identity.tendons * line["tendon"] + 0.6 * identity.veins * line["vein"]
    )
    height = height + 0.35 * palm * noise["palm_lumps"] + 0.05 * line["hair"]
    height = height + plate * (0.25 - 0.2 * nails.free - 0.35 * nails.across**2) - 0.22 * nails.rim
    fold = -(0.42 + 0.2 * identity.age) * line["fold"] * bare
    wrinkle = -(0.55 + 0.25 * identity.age) * line["wrinkle"]
    return height, fold, wrinkle
