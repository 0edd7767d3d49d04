"""Low-frequency shape that the template lacks: pads, knuckles, tendons and hollows, as vertex displacements."""

import functools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.synthetic.body import body_on, bundled_body
from oasis_warp.synthetic.identity import Identity
from oasis_warp.synthetic.ops.surface_patterns import NoiseField, surface_noise

_UP, _PAD, _BACK_OF_KNUCKLE = np.array([0.0, 8, 0]), np.array([-5.0, -12, 0]), np.array([1.5, 0, 0])
_ACROSS = (1, 4, 10, 7)
"""First joints of index, middle, ring and little finger, in anatomical order."""


def _step(low: float, high: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


@functools.cache
def relief_forms() -> np.ndarray:
    """Heights of the hand's vertices [mm], [V, 4]: constant, and per unit of bony, tendons, and bony x tendons."""
    body = bundled_body()
    n = body.n_hand
    points, normals = body.rest[:n].double().numpy(), body.normals[:n].double().numpy()
    weights = body.finger_weights[:n].double().numpy()
    common, bony, tendons, both = out = np.zeros((4, n))
    back, palm = _step(0.1, 0.7, normals[:, 1]), _step(0.1, 0.7, -normals[:, 1])

    def blob(center: np.ndarray, radius: float | list[float | int]) -> np.ndarray:
        return np.exp(-(((points - center) / radius) ** 2).sum(1))

    for finger, bones in enumerate(body.bones):
        here = _step(0.3, 0.7, weights[:, finger])
        for place, bone in enumerate(bones):
            along = (points - bone.origin) @ bone.along
            up = normals @ bone.back
            level = 1 - np.abs(up)
            if place or finger == 4:
                joint = np.exp(-((along / 4.5) ** 2)) * here
                valley = 0.65 * np.exp(-((along / 2.2) ** 2)) * _step(0.1, 0.6, -up)
                common += joint * (0.3 * level - valley)
                bony += joint * (0.5 * _step(-0.2, 0.4, up) + 0.5 * level)
            pad = np.exp(-(((along - 0.52 * bone.length) / (0.30 * bone.length)) ** 2))
            common += here * _step(0.1, 0.7, -up) * 0.85 * pad
            if place < 2:  # phalanges are waisted between the joints
                common -= here * level * 0.15 * pad
                bony -= here * level * 0.45 * pad
    joints = body.hand.joints.double().numpy() * 1e3
    knuckles = joints[list(_ACROSS)]
    for i, knuckle in enumerate(knuckles):
        up = body.hand.pose_axes[_ACROSS[i], 1].double().numpy()
        bony += back * 1.7 * blob(knuckle + up * 9 + _BACK_OF_KNUCKLE, 8.5)
        s = np.clip((points - knuckle) @ -knuckle / (knuckle @ knuckle), 0, 1)
        off = np.linalg.norm((points - knuckle * (1 - s)[:, None])[:, [0, 2]], axis=1)
        tendon = back * _step(1.0, 0.75, s) * 1.2 * np.exp(-((off / 2.6) ** 2))
        tendons += 0.3 * tendon
        both += 0.9 * tendon
        if i < 3:
            between = (knuckle + knuckles[i + 1]) / 2
            hollow = back * (blob(between + _UP, 6.5) + 0.55 * blob(between * 0.72 + _UP, [18, 15, 4.0]))
            common -= 0.4 * hollow
            bony -= 1.5 * hollow
        common += palm * 0.7 * blob(knuckle + _PAD, 8.0)
    common += palm * (
        1.6 * blob(np.array([-42, -22, 24]), [22, 20, 13])
        + 1.3 * blob(np.array([-35, -18, -26]), [26, 20, 11])
        - 1.6 * blob(np.array([-62, -14, -2]), [17, 20, 15])
    )
    return out.T


@functools.cache
def _forms_on(device: str) -> Float[Tensor, "V 4"]:
    return torch.from_numpy(relief_forms()).float().to(device)


def relief(identity: Identity, device: str) -> Float[Tensor, "V"]:
    """Displacement of the hand's vertices along their normals [m]."""
    bony, tendons = identity.bony, identity.tendons
    forms, body = _forms_on(device), body_on(device)
    lumps = surface_noise(body.rest[: body.n_hand], [NoiseField(13.0, identity.seed + 5, 2)])[0]
    return (forms @ forms.new_tensor([1, bony, tendons, bony * tendons]) + 0.25 * lumps) * 1e-3
