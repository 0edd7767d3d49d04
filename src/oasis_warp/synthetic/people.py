"""People of a world, baked once and kept: texture, resting surface and what goes with them."""

import multiprocessing
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.logging import Progress, silent
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
    return _keep(key, _born(seed, number, population))


def bake_people(
    seed: int, numbers: Sequence[int], population: Population, device: str, *, jobs: int, progress: Progress = silent
) -> None:
    """Make `person` ready for each of `numbers`, in `jobs` processes: before training, so that it never waits.

    Raises:
        ValueError: more people than are kept on the device.
    """
    most = KEPT[torch.device(device).type]
    if len(numbers) > most:
        raise ValueError(
            f"numbers: expected at most {most} people on {device}, got {len(numbers)}. Others are forgotten."
        )
    missing = [n for n in numbers if (seed, n, population, device) not in _known]
    # A forked child of a process with a CUDA context or threads may hang, a spawned one does not.
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        born = pool.map(_born, [seed] * len(missing), missing, [population] * len(missing))
        for k, (number, found) in enumerate(zip(missing, born, strict=True)):
            _keep((seed, number, population, device), found)
            progress("people", k + 1, len(missing))


def _keep(key: tuple[int, int, Population, str], found: Person) -> Person:
    """Move a person to the key's device and remember it, and forget the one that was not met for longest."""
    device = key[3]
    moved = {name: value.to(device) for name, value in found._asdict().items() if isinstance(value, Tensor)}
    found = found._replace(**moved)
    _known[key] = found
    if sum(k[3] == device for k in _known) > KEPT[torch.device(device).type]:
        del _known[next(k for k in _known if k[3] == device)]
    return found


def _born(seed: int, number: int, population: Population) -> Person:
    """On the CPU."""
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
        texture,
        rest,
        joints,
        tips,
        areas,
        texture[..., :3].float().mean((0, 1)),
        ring_at_rest(body, rest, joints, identity),
        ring_look(identity),
    )
