"""People of a world, baked once and kept: texture, resting surface and what goes with them."""

from collections import OrderedDict
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.ops.skin_shading import surface_state
from oasis_warp.synthetic.atlas import bundled_atlas
from oasis_warp.synthetic.bake import bake
from oasis_warp.synthetic.body import ARM_ROWS, arm_rows, bundled_body
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.relief import relief
from oasis_warp.synthetic.wardrobe import ring_at_rest, ring_look

KEPT = {"cpu": 48, "cuda": 1024}
"""People kept on a device, 23 MB each."""


class Person(NamedTuple):
    """Ready to be photographed; metres, the hand's frame."""

    identity: Identity
    texture: Float[Tensor, "Y X 8"]
    """float16, see `bake.CHANNELS`."""
    rest: Float[Tensor, "V 3"]
    """The hand's vertices: shape and relief."""
    joints: Float[Tensor, "16 3"]
    tips: Float[Tensor, "5 3"]
    areas: Float[Tensor, "K"]
    """Of hand and forearm at rest, as `ops.surface_state` gives them."""
    tone: Float[Tensor, "3"]
    """Mean reflectance."""
    ring: Float[Tensor, "R 3"]
    ring_look: tuple[float, ...]


_known: OrderedDict[tuple[int, int, Population, str], Person] = OrderedDict()


def person(seed: int, number: int, population: Population, device: str) -> Person:
    """Person `number` of the world `seed`; a few seconds the first time, then kept until many others have come."""
    key = (seed, number, population, device)
    if key in _known:
        _known.move_to_end(key)
        return _known[key]
    found = _born(seed, number, population, device)
    _known[key] = found
    if len(_known) > KEPT[torch.device(device).type]:
        _known.popitem(last=False)
    return found


def _born(seed: int, number: int, population: Population, device: str) -> Person:
    body, atlas = bundled_body(), bundled_atlas()
    hand = body.hand
    identity = sample_identity(hand, seed, number, population)
    shape = torch.from_numpy(identity.shape).float()
    smooth = hand.template + hand.shape_basis @ shape
    rest = smooth + body.normals[: body.n_hand] * relief(body, identity)[:, None]
    joints, tips = hand.joints + hand.joint_basis @ shape, hand.tips + hand.tip_basis @ shape
    texture = bake(atlas, identity)
    still = torch.eye(3).expand(1, ARM_ROWS, 3, 3)
    arm = arm_rows(rest[hand.rim][None], still, torch.tensor([identity.arm_girth]))
    n_skin = len(body.uv_faces)
    whole = torch.cat([rest, arm.reshape(-1, 3)])[None]
    areas = surface_state(whole, body.faces[:n_skin]).areas[0]
    return Person(
        identity,
        texture.to(device),
        rest.to(device),
        joints.to(device),
        tips.to(device),
        areas.to(device),
        texture[..., :3].float().mean((0, 1)).to(device),
        ring_at_rest(body, rest, joints, identity).to(device),
        ring_look(identity),
    )
