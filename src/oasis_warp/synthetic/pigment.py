"""The colour of each texel: melanin and blood, where they vary and what they make of light."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import smoothstep
from oasis_warp.synthetic.canvas import Canvas
from oasis_warp.synthetic.identity import Identity
from oasis_warp.synthetic.nails import Nails
from oasis_warp.synthetic.spectrum import Tint, skin_colors

OPAL, HORN, LUNULA = (0.75, 0.62, 0.52), (0.74, 0.68, 0.56), (0.72, 0.60, 0.53)
"""What shines in a nail's plate, its free edge, its moon: linear RGB."""


class Marks(NamedTuple):
    """What is on the skin of one person, [N] each."""

    palm: Float[Tensor, "N"]
    """Share of each texel."""
    line: dict[str, Tensor]
    """Strength of each of `strokes.KINDS`."""
    groove: Float[Tensor, "N"]
    """Of the lines in which blood shows and oil gathers."""
    nails: Nails
    spots: Float[Tensor, "N"]
    noise: dict[str, Tensor]
    """Fields of `bake`."""


def column(values: tuple[float, ...], like: Tensor) -> Float[Tensor, "3 1"]:
    """A colour beside planes of colours."""
    return like.new_tensor(values)[:, None]


def _pigments(canvas: Canvas, identity: Identity, marks: Marks) -> tuple[Tensor, Tensor]:
    """Shares of melanin and blood."""
    noise, line, palm = marks.noise, marks.line, marks.palm
    back, m = 1 - palm, identity.melanin
    knuckles = canvas.knuckle * back
    palm_melanin = min(0.6 * m, 0.006 + 0.33 * m)
    melanin = m * (1 + (identity.tan - 1) * back) * back + palm_melanin * palm
    lattice = (noise["lattice_a"].abs() + noise["lattice_b"].abs()).clamp(0, 1)
    melanin = melanin * (1 + (0.10 * back + 0.06 * palm) * (0.5 - lattice))
    melanin = melanin * (1 + 0.18 * noise["blotch"] + 0.15 * noise["grain"])
    melanin = melanin * (1 + (0.35 + 0.18 * identity.knuckles) * knuckles + 0.25 * line["fold"])
    pigmented = line["main"] + line["crease"] + 0.6 * line["minor"]  # dark palms have darker lines
    melanin = melanin + palm * pigmented * (0.05 * m + 0.35 * max(0.0, m - 0.06))
    inner_arm = smoothstep(0.45, 0.75, canvas.palm) * (1 - canvas.hand)
    melanin = melanin * (1 - 0.3 * inner_arm) + marks.spots * back * (0.03 + 0.5 * m)

    blood = identity.blood * (
        1 + 0.55 * palm + 1.1 * canvas.tip * (0.5 + 0.5 * palm) + 0.9 * knuckles + 0.35 * canvas.on_finger
    )
    pad = palm * (1 - canvas.on_finger)
    blood = blood * (1 + identity.mottle * (0.42 * noise["flush"] + 0.45 * palm * noise["palm_flush"]) + 0.15 * pad)
    vein = line["vein"] * identity.veins
    blood = blood * (1 + 0.55 * marks.groove.clamp(max=1.2) * (0.8 * palm + 0.2) + 0.2 * line["halo"])
    return melanin, (blood * (1 - 0.25 * vein)).clamp_min(0.002)


def skin_color(canvas: Canvas, identity: Identity, marks: Marks) -> Float[Tensor, "3 N"]:
    """Linear reflectance of skin and bare nails."""
    line, palm, m = marks.line, marks.palm, identity.melanin
    melanin, blood = _pigments(canvas, identity, marks)
    yellow, oxygen = 0.5 * identity.carotene, identity.oxygen
    horny = identity.carotene + 0.12 * (m < 0.08)
    color, palm_color = skin_colors(
        melanin, blood, [Tint(oxygen, identity.epidermis, yellow), Tint(oxygen, identity.epidermis, horny)]
    )
    color = color + (palm_color - color) * palm
    (deep,) = skin_colors(melanin, 0.9 * blood, [Tint(0.15, identity.epidermis, yellow)])
    deep = deep * column((0.8, 0.95, 1.05), deep)
    color = color + (deep - color) * (0.5 * identity.veins * line["vein"] * (1 - palm)).clamp(0, 1)
    color[:, canvas.nails] = _with_nails(color[:, canvas.nails], canvas, identity, marks)
    dark = 0.40 * line["crease"] + 0.38 * line["main"] + 0.20 * line["minor"] + 0.09 * line["halo"]
    return color * torch.exp(-dark * column((0.75, 1.1, 1.15), dark))  # cavities: dark and warm


def _with_nails(color: Float[Tensor, "3 M"], canvas: Canvas, identity: Identity, marks: Marks) -> Float[Tensor, "3 M"]:
    """Colours of `Canvas.nails` with the nails on them."""
    nails, m = Nails(*(share[canvas.nails] for share in marks.nails)), identity.melanin
    blood = identity.blood * (1.6 + 0.3 * marks.noise["dry"][canvas.nails])
    melanin = torch.full_like(blood, 0.62 * m + 0.004)
    (bed,) = skin_colors(melanin, blood, [Tint(identity.oxygen, identity.epidermis, 0.0)])
    bed = 0.94 * bed + 0.05 * column(OPAL, bed)
    pale = column(LUNULA, bed) * (0.75 + 0.25 * (m < 0.1))
    bed = bed + (pale - bed) * (0.35 * nails.lunula)
    bed = bed + (column(HORN, bed) - bed) * (0.55 * nails.free)
    return color + (bed - color) * nails.plate
