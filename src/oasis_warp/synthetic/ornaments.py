"""What is put on skin: tattoos, plasters, polish; and the hairs that grow out of it."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import bundled_body, smoothstep
from oasis_warp.synthetic.canvas import Canvas
from oasis_warp.synthetic.pigment import Marks, column
from oasis_warp.synthetic.skin_plan import STAR, SkinPlan, Tattoo

INK = (0.86, 0.80, 0.70)
"""Share of each light that ink swallows."""
PLASTER, HAIR = (0.62, 0.42, 0.28), (0.30, 0.18, 0.09)
"""Linear RGB of a plaster, and of fair hair."""


def ornamented(color: Float[Tensor, "3 N"], canvas: Canvas, plan: SkinPlan, marks: Marks) -> Float[Tensor, "3 N"]:
    """Tattoo, plaster, polish, hair, and the fold around the nails."""
    plate, identity = marks.nails.plate, plan.identity
    if plan.tattoo is not None:
        ink = _ink(canvas.points, plan.tattoo, marks.noise["tattoo"]) * smoothstep(0.5, 0.3, canvas.palm)
        color = color * (1 - ink * column(INK, color))
    if identity.polish is not None:
        coat = column(identity.polish, color) * 0.8 + 0.02
        color = color + (coat - color) * plate
    if plan.plaster is not None:
        finger, place, middle, shade = plan.plaster
        bone = bundled_body().bones[finger][place]
        points = canvas.points
        t = (points - points.new_tensor(bone.origin)) @ points.new_tensor(bone.along) - middle
        holes = torch.sin(points[:, 0] * 2.6) * torch.sin(points[:, 1] * 2.6 + points[:, 2] * 2.6) > 0.55
        strip = (canvas.finger == finger) * smoothstep(9.2, 8.8, t.abs()) * (1 - 0.3 * holes)
        tan = column(PLASTER, color) * shade
        color = color + (tan - color) * strip
    if identity.hairs:
        hair = column(HAIR, color) * (1 - identity.hair_melanin) ** 1.5 + 0.02
        color = color + (hair - color) * (0.75 * marks.line["hair"] * (1 - plate)).clamp(0, 1)
    color = color * (1 - 0.30 * marks.nails.rim * column((0.7, 1.0, 1.05), color))
    return color.clamp(0.003, 0.9)


def _ink(points: Tensor, tattoo: Tattoo, noise: Tensor) -> Tensor:
    """Ink, 0 to 1: scrollwork, a star, rows of script, or bands round the forearm."""
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
