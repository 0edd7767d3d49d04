"""Clothes: the meshes of sleeves, wristbands and rings on a posed hand, and their materials."""

import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import ARM_LENGTH, ARM_ROWS, BAND_ROWS, RING_COLUMNS, RING_ROWS, SLEEVE_ROWS, Body
from oasis_warp.synthetic.identity import Identity

BAND_PLACES = (0.0, 0.02, 0.15, 0.5, 0.85, 0.98, 1.0)
"""Positions of a wristband's rows over its width."""
BAND_PROFILE = (-0.6, 0.7, 1.0, 1.0, 1.0, 0.7, -0.6)
"""Heights of a wristband's rows over the skin, over its thickness."""
RING_ROUNDNESS = 0.6
"""Half thickness of a ring [mm]."""
SKIN_MATERIAL = (0.0, 0.0, 0.0, 0.5, 0.0, 0.0)
"""Material of skin: see `ops.skin_shading`. Its colour comes from the texture."""
HIDDEN_POSITION = (0.0, 0.0, -1.0)
"""Position of vertices that an image does not show, in the camera's frame: behind it."""


class Clothes(NamedTuple):
    """The clothes of one picture; lengths in metres."""

    sleeve_start: float
    """Distance of its edge from the wrist; beyond the arm for none."""
    sleeve_gap: float
    sleeve_phases: np.ndarray
    """Phases of the wrinkles, [4]."""
    sleeve_material: tuple[float, ...]
    band_start: float
    """Distance from the wrist; beyond the arm for none."""
    band_width: float
    band_thickness: float
    band_material: tuple[float, ...]


def sample_clothes(rng: np.random.Generator, bare: bool) -> Clothes:
    """Sample clothes: a sleeve on a third of the arms, a wristband on an eighth, none if `bare`."""
    u = rng.uniform

    def cloth_color() -> tuple[float, float, float]:
        dark = np.exp(u(-4.2, -0.5))
        tint = np.exp(rng.normal(0, rng.choice([0.08, 0.5], p=[0.6, 0.4]), 3))
        return tuple(np.clip(dark * tint, 0.008, 0.85))

    sleeve, band = rng.random() < 0.36 and not bare, rng.random() < 0.12 and not bare
    start = u(0.008, 0.13)
    look = (*cloth_color(), 0.85, 0.0, 1.0)
    metal = float(rng.random() < 0.35)
    strap = (0.75, 0.74, 0.72) if metal else cloth_color()
    return Clothes(
        sleeve_start=start if sleeve else 2 * ARM_LENGTH,
        sleeve_gap=u(0.002, 0.009),
        sleeve_phases=u(0, 2 * np.pi, 4),
        sleeve_material=look,
        band_start=u(0.012, 0.035) if band else 2 * ARM_LENGTH,
        band_width=u(0.006, 0.022),
        band_thickness=u(0.0012, 0.003),
        band_material=(*strap, u(0.22, 0.55), metal, 0.0),
    )


def _along_arm(rows: Tensor, s: Tensor) -> Tensor:
    """Interpolate the arm's rows [B, ARM_ROWS + 1, C, 3] at positions `s` [B, R], 0 at the wrist, 1 at the elbow."""
    place = s.clamp(0, 1) * ARM_ROWS
    low = place.floor().clamp(max=ARM_ROWS - 1)
    index = low.long()[..., None, None].expand(-1, -1, *rows.shape[2:])
    start, end = rows.gather(1, index), rows.gather(1, index + 1)
    return start + (place - low)[..., None, None] * (end - start)


def _outward(rings: Tensor) -> Tensor:
    """Unit vectors from the centre of each ring to its points."""
    return torch.nn.functional.normalize(rings - rings.mean(2, keepdim=True), dim=-1)


def sleeves(
    rows: Float[Tensor, "B R C 3"], start: Float[Tensor, "B"], gap: Float[Tensor, "B"], phases: Float[Tensor, "B 4"]
) -> Float[Tensor, "B K C 3"]:
    """Wrinkled tubes around arms, whose rows start with the wrist's rim. The sleeves of bare arms are undefined."""
    start, gap = start[:, None] / ARM_LENGTH, gap[:, None]
    share = torch.linspace(0, 1, SLEEVE_ROWS - 2, device=rows.device)
    s = torch.cat([start, start, start + (1 - start) * share], 1)
    rings = _along_arm(rows, s)
    lift = gap.expand(-1, SLEEVE_ROWS).clone()
    lift[:, 0] = -1e-3
    lift[:, 1] = (gap - 1.2e-3)[:, 0]
    phase = phases[:, :, None, None]
    angle = torch.linspace(0, 2 * torch.pi, rows.shape[2] + 1, device=rows.device)[:-1]
    along = s[:, :, None] * ARM_LENGTH
    folds = (
        torch.sin(along / 0.0065 + 1.7 * torch.sin(angle + phase[:, 0]) + phase[:, 1])
        + 0.8 * torch.sin(along / 0.011 + 2 * torch.sin(2 * angle + phase[:, 2]))
        + 0.9 * torch.sin(3 * angle + phase[:, 3] + along / 0.03)
    )
    folds = folds * (torch.arange(SLEEVE_ROWS, device=rows.device) > 1)[:, None]
    lift = lift[:, :, None] + 0.22 * gap[:, :, None].clamp(max=0.006) * folds
    return rings + _outward(rings) * lift[..., None]


@functools.cache
def _band_profile(device: torch.device) -> tuple[Tensor, Tensor]:
    """`BAND_PLACES` and `BAND_PROFILE` on a device."""
    assert len(BAND_PLACES) == len(BAND_PROFILE) == BAND_ROWS
    return torch.tensor(BAND_PLACES, device=device), torch.tensor(BAND_PROFILE, device=device)


def bands(
    rows: Float[Tensor, "B R C 3"], start: Float[Tensor, "B"], width: Float[Tensor, "B"], thickness: Float[Tensor, "B"]
) -> Float[Tensor, "B K C 3"]:
    """Flat bands around wrists. The bands of bare arms are undefined."""
    share, profile = _band_profile(rows.device)
    rings = _along_arm(rows, (start[:, None] + width[:, None] * share) / ARM_LENGTH)
    lift = thickness[:, None] * profile
    return rings + _outward(rings) * lift[..., None, None]


def ring_at_rest(
    body: Body, rest: Float[Tensor, "V 3"], joints: Float[Tensor, "16 3"], identity: Identity
) -> Float[Tensor, "K 3"]:
    """A ring that fits the person's finger, in the hand's frame at rest [m]; undefined for people without ring."""
    finger = max(identity.ring_finger, 0)
    bone = body.bones[finger][0]
    joint = 3 * finger + 1
    axes = rest.new_tensor(np.stack([bone.along, bone.side, bone.back], 1), dtype=torch.float64)
    joints = joints.double() * 1e3
    local = (rest.double() * 1e3 - joints[joint]) @ axes
    place = identity.ring_place * (joints[joint + 1] - joints[joint]).norm()
    near = (body.finger_weights[: body.n_hand, finger] > 0.6) & ((local[:, 0] - place).abs() < 3.5)
    high = local[:, 1:].where(near[:, None], -torch.inf).amax(0)
    low = local[:, 1:].where(near[:, None], torch.inf).amin(0)
    middle = (high + low) / 2
    side, up = (local[:, 1:] - middle).unbind(1)
    angle, radius = torch.atan2(up, side), torch.hypot(side, up)
    angles = torch.arange(RING_COLUMNS, device=rest.device, dtype=torch.float64) * (2 * torch.pi / RING_COLUMNS)
    angles = angles - torch.pi
    weight = torch.exp(30 * (torch.cos(angle - angles[:, None]) - 1)) * near
    fit = (weight @ radius) / weight.sum(1) + 0.15
    across = torch.arange(RING_ROWS, device=rest.device, dtype=torch.float64)[:, None] * (2 * torch.pi / RING_ROWS)
    wide = place + identity.ring_width / 2 * torch.cos(across).sign() * torch.cos(across).abs() ** 0.6 + 0 * fit
    reach = fit + RING_ROUNDNESS * torch.sin(across)
    points = torch.stack([wide, reach * torch.cos(angles) + middle[0], reach * torch.sin(angles) + middle[1]], -1)
    return ((points.reshape(-1, 3) @ axes.T + joints[joint]) * 1e-3).float()


def ring_material(identity: Identity) -> tuple[float, ...]:
    """The material of a ring: metal."""
    return (*identity.ring_metal, 0.18 + 0.2 * identity.gloss, 1.0, 0.0)
