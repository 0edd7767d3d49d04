"""Bake one person's skin into the texture atlas: reflectance, relief and gloss. Lengths are millimetres."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.ops.surface_patterns import NoiseField, surface_noise
from oasis_warp.synthetic.atlas import Atlas
from oasis_warp.synthetic.body import FINGERS, smoothstep
from oasis_warp.synthetic.hand_lines import THUMB, draw_back, draw_fingers, draw_wrist
from oasis_warp.synthetic.identity import Identity
from oasis_warp.synthetic.palm_lines import Palm
from oasis_warp.synthetic.spectrum import SkinColor
from oasis_warp.synthetic.strokes import Strokes

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


class Regions(NamedTuple):
    """Shares of each texel."""

    palm: Tensor
    hand: Tensor
    """1 on the hand, 0 on the arm."""
    tip: Tensor
    knuckle: Tensor
    on_finger: Tensor


class Nails(NamedTuple):
    """The nails, each texel's share."""

    plate: Tensor
    lunula: Tensor
    free: Tensor
    """Edge beyond the bed."""
    distance: Tensor
    """To the outline, negative inside; 9 far off [mm]."""
    across: Tensor
    """-1 to 1 over the plate."""


def _noises(atlas: Atlas, identity: Identity) -> dict[str, Tensor]:
    def fields(table: dict[str, tuple[float, int]], seed: int) -> list[NoiseField]:
        return [NoiseField(cell, seed + 97 * k, octaves) for k, (cell, octaves) in enumerate(table.values())]

    fine = {name: how for name, how in FINE_NOISES.items() if name != "tattoo" or identity.tattoo}
    coarse = atlas.spread(surface_noise(atlas.body.rest, fields(COARSE_NOISES, identity.seed)))
    values = torch.cat([coarse, surface_noise(atlas.points, fields(fine, identity.seed + 5000))], 1)
    return dict(zip((*COARSE_NOISES, *fine), values.unbind(1), strict=True))


def _regions(atlas: Atlas, noise: dict[str, Tensor]) -> Regions:
    x = atlas.points[:, 0]
    palm = smoothstep(0.28, 0.80, atlas.palm + 0.08 * noise["palm_edge"])
    palm = palm * smoothstep(9.0, -9.0, x + 3 * noise["wrist_edge"])
    tip, knuckle = torch.zeros_like(x), torch.zeros_like(x)
    for finger in range(len(FINGERS)):
        here = atlas.finger == finger
        for place in range(3):
            bone = atlas.body.bones[finger][place]
            if place == 0:  # the knuckle lies on the hand, too
                local = (atlas.points - atlas.points.new_tensor(bone.origin)) @ atlas.points.new_tensor(
                    np.stack([bone.along, bone.side, bone.back], 1)
                )
                if finger == THUMB:
                    continue
                where = (local[:, 0].abs() < 16) & (local[:, 1].abs() < 18)
            else:
                local, where = atlas.local[:, place], here
            t, side, back = local.unbind(1)
            long = (6.5, 6.5, 4.0)[place]
            bump = torch.exp(-(((t - float(place == 0)) / long) ** 2) - (side / 8) ** 2) * smoothstep(0.0, 3.0, back)
            knuckle = knuckle + where * bump * (0.5 if place == 0 else 0.8)
            if place == 2:
                tip = torch.maximum(tip, here * smoothstep(bone.length * 0.25, bone.length * 0.85, t))
    on_finger = atlas.finger_weight.clamp(0, 1) * (atlas.finger >= 0)
    return Regions(palm, smoothstep(6.0, -6.0, x), tip, knuckle.clamp(max=1.2), on_finger)


def _nails(atlas: Atlas, identity: Identity, rng: np.random.Generator) -> Nails:
    """Superellipses in the frames of the last bones, fitted to the model's nail labels."""
    hand = atlas.body.hand
    n = len(atlas.points)
    plate, lunula, free, across = (torch.zeros(n) for _ in range(4))
    distance = torch.full((n,), 9.0)
    for finger in range(len(FINGERS)):
        bone = atlas.body.bones[finger][2]
        labelled = (hand.nail > 0.6) & (hand.segment == 3 * finger + 3)
        along, side, _ = bone.local(hand.template[labelled].double().numpy() * 1e3).T
        low, high = along.min() - 1.2 + rng.normal(0, 0.3), along.max() + 0.2 + 0.5 * identity.nail_length
        middle, half = (side.max() + side.min()) / 2, (side.max() - side.min()) / 2 + identity.nail_width
        center, reach = (low + high) / 2, (high - low) / 2
        t, x, y = atlas.local[:, 2].unbind(1)
        power = identity.nail_shape
        round_ = ((x - middle).abs() / half) ** power + ((t - center).abs() / reach) ** power
        here = (atlas.finger == finger) & (y > 0)
        d = torch.where(here, (round_.clamp_min(1e-6) ** (1 / power) - 1) * half, 9.0)
        shown = smoothstep(0.12, -0.12, d)
        plate = torch.maximum(plate, shown)
        distance = torch.where(d < 2, d, distance)
        across = torch.where(d < 2, (x - middle) / half, across)
        size = identity.lunula * (0.7 if finger == THUMB else 0.4) * reach
        if size > 0.8:
            moon = torch.hypot((x - middle) * 0.75, t - low + reach * 0.1) - size * 1.3
            lunula = torch.maximum(lunula, shown * smoothstep(0.5, -0.3, moon))
        edge = high - max(0.45, 0.5 * identity.nail_length + 0.5)
        free = torch.maximum(free, shown * smoothstep(-0.15, 0.3, t - edge + 0.03 * (x - middle) ** 2))
    return Nails(plate, lunula, free, distance, across)


def _spots(atlas: Atlas, identity: Identity, rng: np.random.Generator) -> Tensor:
    """Freckles and moles: strength of pigment."""
    total = identity.freckles + identity.moles
    out = torch.zeros(len(atlas.points))
    if not total:
        return out
    centers = atlas.points[torch.from_numpy(rng.choice(len(atlas.points), total))]
    radius = torch.from_numpy(rng.uniform(0.35, 1.1, total)).float()
    strength = torch.from_numpy(rng.uniform(0.2, 1.2, total)).float()
    strength[identity.freckles :] *= 1.6
    for center, r, s in zip(centers, radius, strength, strict=True):
        near = (atlas.points[:, 0] - center[0]).abs() < 3
        d = (atlas.points[near] - center).norm(dim=1)
        out[near] = torch.maximum(out[near], s * torch.exp(-((d / r) ** 4)))
    return out


def bake(atlas: Atlas, identity: Identity) -> Float[Tensor, "H W 8"]:
    """The texture of one person, `CHANNELS`, float16."""
    rng = np.random.default_rng([identity.seed])
    noise = _noises(atlas, identity)
    strokes = Strokes(rng)
    draw_fingers(atlas, strokes, identity)
    Palm(atlas, strokes, identity).draw()
    draw_wrist(atlas, strokes)
    draw_back(atlas, strokes, identity)
    line = strokes.draw(atlas.points)
    region = _regions(atlas, noise)
    nails = _nails(atlas, identity, rng)
    palm, back = region.palm, 1 - region.palm
    line["crease"] = line["crease"] * smoothstep(0.28, 0.5, atlas.palm + 0.1 * region.hand)
    line["main"], line["minor"], line["halo"] = line["main"] * palm, line["minor"] * palm, line["halo"] * palm
    line["wrinkle"] = line["wrinkle"] * palm
    line["fold"] = line["fold"] * back * (1 - nails.plate)
    groove = line["crease"] + line["main"] + 0.7 * line["minor"]

    color = _color(identity, region, nails, line, noise, groove, _spots(atlas, identity, rng), atlas)
    color = _painted(color, atlas, identity, nails, noise, rng, line)
    height, fold, wrinkle = _relief(identity, region, nails, line, noise)
    plate = nails.plate
    roughness = identity.roughness + 0.05 * noise["gloss"] + 0.04 * palm - 0.06 * region.tip * palm
    shine = 0.16 + 0.2 * identity.gloss if identity.polish is not None else 0.32
    roughness = roughness * (1 - plate) + plate * shine
    oil = identity.oil * (1 + 0.25 * noise["gloss"]) * (1 - 0.35 * groove.clamp(0, 1)) * (1 - plate) + plate * 1.15
    channels = [*color.unbind(1), height, fold, wrinkle, roughness.clamp(0.12, 0.9), oil.clamp(0.05, 1.5)]
    return atlas.image(torch.stack(channels, 1)).half()


def _color(identity: Identity, region: Regions, nails: Nails, line: dict[str, Tensor], noise: dict[str, Tensor],
           groove: Tensor, spots: Tensor, atlas: Atlas) -> Tensor:  # fmt: skip
    """Linear reflectance of bare skin and nails."""
    m, palm, back = identity.melanin, region.palm, 1 - region.palm
    palm_melanin = min(0.6 * m, 0.006 + 0.33 * m)
    melanin = m * (1 + (identity.tan - 1) * back) * back + palm_melanin * palm
    lattice = (noise["lattice_a"].abs() + noise["lattice_b"].abs()).clamp(0, 1)
    melanin = melanin * (1 + (0.10 * back + 0.06 * palm) * (0.5 - lattice))
    melanin = melanin * (1 + 0.18 * noise["blotch"] + 0.15 * noise["grain"])
    melanin = melanin * (1 + (0.35 + 0.18 * identity.knuckles) * region.knuckle * back + 0.25 * line["fold"])
    pigmented = line["main"] + line["crease"] + 0.6 * line["minor"]  # dark palms have darker lines
    melanin = melanin + palm * pigmented * (0.05 * m + 0.35 * max(0.0, m - 0.06))
    inner_arm = smoothstep(0.45, 0.75, atlas.palm) * (1 - region.hand)
    melanin = melanin * (1 - 0.3 * inner_arm) + spots * back * (0.03 + 0.5 * m)

    blood = identity.blood * (
        1 + 0.55 * palm + 1.1 * region.tip * (0.5 + 0.5 * palm) + 0.9 * region.knuckle * back + 0.35 * region.on_finger
    )
    pad = palm * (1 - region.on_finger)
    blood = blood * (1 + identity.mottle * (0.42 * noise["flush"] + 0.45 * palm * noise["palm_flush"]) + 0.15 * pad)
    vein = line["vein"] * identity.veins
    blood = blood * (1 + 0.55 * groove.clamp(max=1.2) * (0.8 * palm + 0.2) + 0.2 * line["halo"]) * (1 - 0.25 * vein)
    blood = blood.clamp_min(0.002)

    def person(oxygen: float, carotene: float) -> SkinColor:
        return SkinColor(oxygen=oxygen, epidermis=identity.epidermis, carotene=carotene)

    horn = identity.carotene + 0.12 * (m < 0.08)
    color = person(identity.oxygen, 0.5 * identity.carotene)(melanin, blood)
    color = color + (person(identity.oxygen, horn)(melanin, blood) - color) * palm[:, None]
    deep = person(0.15, 0.5 * identity.carotene)(melanin, 0.9 * blood) * color.new_tensor([0.8, 0.95, 1.05])
    color = color + (deep - color) * (0.5 * vein * back).clamp(0, 1)[:, None]
    bed = person(identity.oxygen, 0.0)(0.62 * m + 0.004 + 0 * melanin, identity.blood * (1.6 + 0.3 * noise["dry"]))
    bed = 0.94 * bed + 0.05 * color.new_tensor([0.75, 0.62, 0.52])
    pale = color.new_tensor([0.72, 0.60, 0.53]) * (0.75 + 0.25 * (m < 0.1))
    bed = bed + (pale - bed) * (0.35 * nails.lunula)[:, None]
    bed = bed + (color.new_tensor([0.74, 0.68, 0.56]) - bed) * (0.55 * nails.free)[:, None]
    color = color + (bed - color) * nails.plate[:, None]
    dark = 0.40 * line["crease"] + 0.38 * line["main"] + 0.20 * line["minor"] + 0.09 * line["halo"]
    return color * torch.exp(-dark)[:, None] ** color.new_tensor([0.75, 1.1, 1.15])  # cavities: dark and warm


def _painted(color: Tensor, atlas: Atlas, identity: Identity, nails: Nails, noise: dict[str, Tensor],
             rng: np.random.Generator, line: dict[str, Tensor]) -> Tensor:  # fmt: skip
    """Tattoo, plaster, polish, hair, and the fold around the nails."""
    points = atlas.points
    if identity.tattoo:
        ink = _tattoo(points, identity.tattoo, rng, noise["tattoo"]) * smoothstep(0.5, 0.3, atlas.palm)
        color = color * (1 - ink[:, None] * color.new_tensor([0.86, 0.80, 0.70]))
    if identity.polish is not None:
        coat = color.new_tensor(identity.polish) * 0.8 + 0.02
        color = color + (coat - color) * nails.plate[:, None]
    if identity.plaster:
        finger, place = int(rng.integers(4)), int(rng.integers(0, 2))
        t = atlas.local[:, place, 0] - rng.uniform(4, 14)
        holes = torch.sin(points[:, 0] * 2.6) * torch.sin(points[:, 1] * 2.6 + points[:, 2] * 2.6) > 0.55
        strip = (atlas.finger == finger) * smoothstep(9.2, 8.8, t.abs()) * (1 - 0.3 * holes)
        tan = color.new_tensor([0.62, 0.42, 0.28]) * rng.uniform(0.6, 1.25)
        color = color + (tan - color) * strip[:, None]
    if identity.hairs:
        hair = color.new_tensor([0.30, 0.18, 0.09]) * (1 - identity.hair_melanin) ** 1.5 + 0.02
        color = color + (hair - color) * (0.75 * line["hair"] * (1 - nails.plate)).clamp(0, 1)[:, None]
    rim = torch.exp(-(((nails.distance - 0.15) / 0.3) ** 2)) * (nails.distance < 2)
    color = color * (1 - 0.30 * rim[:, None] * color.new_tensor([0.7, 1, 1.05]))
    return color.clamp(0.003, 0.9)


def _tattoo(points: Tensor, pattern: int, rng: np.random.Generator, noise: Tensor) -> Tensor:
    """Ink, 0 to 1: scrollwork, a star, rows of script, or bands round the forearm."""
    x, z = points[:, 0], points[:, 2]
    cx, cz = rng.uniform(-70, 40), rng.uniform(-16, 12)
    r = rng.uniform(11, 24)
    x, z = x - cx, z - cz
    d, angle = torch.hypot(x, z), torch.atan2(z, x)
    if pattern == 1:
        ink = smoothstep(0.14, 0.08, noise.abs()) * smoothstep(r, r - 1, d)
    elif pattern == 2:
        n = int(rng.integers(4, 8))
        edge = r * (0.55 + 0.4 * torch.cos(n * angle))
        ink = smoothstep(1.0, 0.6, (d - edge).abs()) + 0.8 * smoothstep(0.5, -0.1, d - 0.45 * edge)
        ink = ink + smoothstep(0.6, 0.3, (d - 1.05 * r).abs())
    elif pattern == 3:
        letter = torch.sin(2.1 * x) + torch.sin(3.7 * x + 2 * torch.sin(0.9 * x))
        row = torch.remainder(z + 30, 5.0) - 2.5
        ink = smoothstep(0.5, 0.25, (row - 0.7 * letter).abs()) * smoothstep(r, r - 0.5, x.abs())
        ink = ink * smoothstep(7.6, 7.4, z.abs())
    else:
        arm = points[:, 0] - rng.uniform(25, 60)
        ink = smoothstep(3.0, 2.6, arm.abs()) + smoothstep(0.9, 0.6, (arm.abs() - 6 + noise).abs())
    return (ink.clamp(0, 1) * rng.uniform(0.6, 0.92)).clamp(0, 1)


def _relief(
    identity: Identity, region: Regions, nails: Nails, line: dict[str, Tensor], noise: dict[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Heights [mm]: what stays, what flattens under stretch, what rises when squeezed."""
    palm, back, plate = region.palm, 1 - region.palm, nails.plate
    bare = 1 - plate
    lattice = (noise["lattice_a"].abs() + 0.7 * noise["lattice_b"].abs()).clamp(0, 1)
    texture = back * (0.08 + 0.06 * identity.age) * lattice * bare + palm * (0.03 * noise["ridge"] + 0.05 * lattice)
    height = -(0.50 * line["crease"] + 0.48 * line["main"] + 0.28 * line["minor"]) - 0.28 * line["halo"]
    height = height + texture + 0.13 * noise["lumps"] * (1 - 0.6 * plate)
    height = height + (0.03 + 0.04 * identity.dryness) * noise["dry"] * bare
    toward_wrist = 0.25 + 0.75 * (region.on_finger < 0.5)
    height = height + back * toward_wrist * (
        0.15 * identity.tendons * line["tendon"] + 0.6 * identity.veins * line["vein"]
    )
    height = height + 0.35 * palm * noise["palm_lumps"] + 0.05 * line["hair"]
    rim = torch.exp(-(((nails.distance - 0.15) / 0.3) ** 2)) * (nails.distance < 2)
    height = height + plate * (0.25 - 0.2 * nails.free - 0.35 * nails.across**2) - 0.22 * rim
    fold = -(0.42 + 0.2 * identity.age) * line["fold"] * bare
    wrinkle = -(0.55 + 0.25 * identity.age) * line["wrinkle"]
    return height, fold, wrinkle
