"""Plans as tables: the numbers that pictures are rendered from, a row a picture, so that they travel in one copy."""

import functools
import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.processes import worker_pool
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.body import ARM_LENGTH, ARM_ROWS
from oasis_warp.synthetic.contact import bundled_skeleton
from oasis_warp.synthetic.furniture import MAX_SOLIDS, SOLID_WORDS
from oasis_warp.synthetic.identity import Identity, Population
from oasis_warp.synthetic.sensor import SENSOR_WORDS, sensor_row
from oasis_warp.synthetic.shots import SceneConfig, Shot, identity_of, sample_shots
from oasis_warp.synthetic.view_and_light import N_LAMPS
from oasis_warp.synthetic.wardrobe import SKIN_LOOK, ring_look

AHEAD = 3
"""Batches a worker that are planned ahead."""
ARM_BEND = 0.15
"""Share of the forearm over which it bends at the wrist."""


class ShotTable(NamedTuple):
    """B plans, as processes hand them over."""

    numbers: np.ndarray
    """float32, a row a picture: see `ShotTensors`."""
    whole: np.ndarray
    """int64, [B, 4]: index, person, 1 for left hands, seed of whatever is drawn a pixel at a time."""
    gestures: tuple[str, ...]


class ShotTensors(NamedTuple):
    """What pictures are rendered from. A picture in even light has no room and no sensor: there all is 0."""

    angles: Float[Tensor, "B 15 3"]
    """As `HandPose.angles`."""
    rotations: Float[Tensor, "B 16 3 3"]
    """With `shifts` [m] they carry the rest points of each bone, the wrist fixed."""
    shifts: Float[Tensor, "B 16 3"]
    knuckles: Float[Tensor, "B 15"]
    """How far each stands out, in `Body.knuckle_rise`."""
    shape: Float[Tensor, "B S"]
    arm_turns: Float[Tensor, "B R 3 3"]
    """Of the forearm's rings."""
    arm_girth: Float[Tensor, "B"]
    ring_rotation: Float[Tensor, "B 3 3"]
    """With `ring_shift` it carries the ring."""
    ring_shift: Float[Tensor, "B 3"]
    wears: Float[Tensor, "B 3"]
    """1 for a sleeve, a wristband, a ring."""
    sleeve_start: Float[Tensor, "B"]
    sleeve_gap: Float[Tensor, "B"]
    sleeve_phases: Float[Tensor, "B 4"]
    band_start: Float[Tensor, "B"]
    band_width: Float[Tensor, "B"]
    band_thickness: Float[Tensor, "B"]
    looks: Float[Tensor, "B 4 6"]
    """Of skin, sleeve, wristband and ring."""
    view_rotation: Float[Tensor, "B 3 3"]
    view_distance: Float[Tensor, "B"]
    view_fill: Float[Tensor, "B"]
    view_shift: Float[Tensor, "B 2"]
    sky: Float[Tensor, "B 9 3"]
    lamp_directions: Float[Tensor, "B L 3"]
    lamp_distances: Float[Tensor, "B L"]
    lamp_colors: Float[Tensor, "B L 3"]
    lamp_spreads: Float[Tensor, "B L"]
    incident: Float[Tensor, "B 3"]
    solids: Float[Tensor, "B N 27"]
    aperture: Float[Tensor, "B"]
    sensor: Float[Tensor, "B 15"]
    """`sensor.sensor_row`."""


@functools.cache
def _places() -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Columns and shape of each of `ShotTensors`."""
    shapes: dict[str, tuple[int, ...]] = {
        "angles": (15, 3),
        "rotations": (16, 3, 3),
        "shifts": (16, 3),
        "knuckles": (15,),
        "shape": (len(bundled_hand().shape_names),),
        "arm_turns": (ARM_ROWS, 3, 3),
        "ring_rotation": (3, 3),
        "ring_shift": (3,),
        "wears": (3,),
        "sleeve_phases": (4,),
        "looks": (4, len(SKIN_LOOK)),
        "view_rotation": (3, 3),
        "view_shift": (2,),
        "sky": (9, 3),
        "lamp_directions": (N_LAMPS, 3),
        "lamp_distances": (N_LAMPS,),
        "lamp_colors": (N_LAMPS, 3),
        "lamp_spreads": (N_LAMPS,),
        "incident": (3,),
        "solids": (MAX_SOLIDS, SOLID_WORDS),
        "sensor": (SENSOR_WORDS,),
    }
    places, start = {}, 0
    for name in ShotTensors._fields:
        shape = shapes.get(name, ())
        end = start + math.prod(shape)
        places[name], start = (slice(start, end), shape), end
    return places


def sample_table(seed: int, indices: Sequence[int], scenery: SceneConfig) -> ShotTable:
    """`sample_shots` as tables."""
    return tabulate(seed, sample_shots(seed, indices, scenery), scenery)


def tabulate(seed: int, shots: Sequence[Shot], scenery: SceneConfig) -> ShotTable:
    """Shots as tables."""
    identities = [identity_of(seed, shot.person, scenery.population) for shot in shots]
    joints = np.stack([_joints(seed, shot.person, scenery.population) for shot in shots])
    columns = _columns(shots, identities, joints)
    places = _places()
    numbers = np.empty((len(shots), places[ShotTensors._fields[-1]][0].stop), np.float32)
    for name, (place, _) in places.items():
        numbers[:, place] = np.reshape(columns[name], (len(shots), -1)) if name in columns else 0
    whole = np.array([(s.index, s.person, s.side == "left", s.seed) for s in shots], np.int64)
    return ShotTable(numbers, whole, tuple(s.gesture for s in shots))


def concatenate_tables(plans: Sequence[ShotTable]) -> ShotTable:
    """Several plans as one."""
    numbers, whole = (np.concatenate(tables) for tables in list(zip(*plans, strict=True))[:2])
    return ShotTable(numbers, whole, tuple(itertools.chain.from_iterable(p.gestures for p in plans)))


def sample_tables_ahead(
    seed: int, blocks: Iterable[tuple[Sequence[int], SceneConfig]], workers: int
) -> Iterator[ShotTable]:
    """`sample_table` of each of `blocks` in turn, drawn ahead by `workers` processes where there are any."""
    if workers < 1:
        for indices, scenery in blocks:
            yield sample_table(seed, indices, scenery)
        return
    with worker_pool(workers) as pool:
        waiting: deque = deque()
        try:
            for indices, scenery in blocks:
                waiting.append(pool.submit(sample_table, seed, indices, scenery))
                if len(waiting) >= AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """A copy of a CPU tensor on `device`, for which nobody waits."""
    # Only from page-locked memory does a copy to a GPU not wait for all work before it.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def shot_tensors(planned: ShotTable, device: torch.device) -> ShotTensors:
    """The numbers of `planned` on `device`, in one copy."""
    table = send(torch.from_numpy(planned.numbers), device)
    return ShotTensors(**{name: table[:, place].view(-1, *shape) if shape else table[:, place.start]
                      for name, (place, shape) in _places().items()})  # fmt: skip


@functools.lru_cache(4096)
def _joints(seed: int, number: int, population: Population) -> np.ndarray:
    """Of a person at rest [m], rounded as `people.Person` has them."""
    hand = bundled_hand()
    shape = torch.from_numpy(identity_of(seed, number, population).shape).float()
    return (hand.joints + hand.joint_basis @ shape).double().numpy()


def arm_turns(bends: np.ndarray) -> np.ndarray:
    """Rotations of the arm's rings, [B, R, 3, 3], for bends at the wrist about axes with lengths [rad], [B, 3]."""
    share = np.minimum(1.0, np.linspace(0, 1, ARM_ROWS + 1)[1:] / ARM_BEND)
    lengths = np.linalg.norm(bends, axis=1)
    x, y, z = (bends / np.maximum(lengths, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 1, 3, 3)
    angles = (lengths[:, None] * share)[..., None, None]
    return np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * cross @ cross


def _columns(shots: Sequence[Shot], identities: Sequence[Identity], joints: np.ndarray) -> dict[str, Any]:
    """The fields of `ShotTensors` that are not 0."""
    angles = np.stack([s.angles for s in shots])
    rotations, shifts = bundled_skeleton().transforms(angles, joints)
    flexion = angles[:, 1:, 0] + bundled_hand().rest_bend[1:].numpy()
    bent = (1 - np.cos(np.maximum(flexion, 0))).astype(np.float32)
    bony = np.array([0.4 + 0.9 * i.bony for i in identities], np.float32)
    each, finger_root = np.arange(len(shots)), [3 * max(i.ring_finger, 0) + 1 for i in identities]
    clothes, views, lights = ([getattr(s, name) for s in shots] for name in ("clothes", "view", "light"))
    columns: dict[str, Any] = {
        "angles": angles[:, 1:],
        "rotations": rotations,
        "shifts": shifts,
        "knuckles": bent * bony[:, None],
        "shape": [i.shape for i in identities],
        "arm_turns": arm_turns(np.stack([s.bend for s in shots])),
        "arm_girth": [i.arm_girth for i in identities],
        "ring_rotation": rotations[each, finger_root],
        "ring_shift": shifts[each, finger_root],
        "wears": [(c.sleeve_start < ARM_LENGTH, c.band_start < ARM_LENGTH, i.ring_finger >= 0)
                  for c, i in zip(clothes, identities, strict=True)],
        "looks": [(SKIN_LOOK, c.sleeve_look, c.band_look, ring_look(i))
                  for c, i in zip(clothes, identities, strict=True)],
    }  # fmt: skip
    for name in ("sleeve_start", "sleeve_gap", "sleeve_phases", "band_start", "band_width", "band_thickness"):
        columns[name] = [getattr(c, name) for c in clothes]
    for name in ("rotation", "distance", "fill", "shift"):
        columns[f"view_{name}"] = [getattr(v, name) for v in views]
    for name in ("directions", "distances", "colors", "spreads"):
        columns[f"lamp_{name}"] = [getattr(light, name) for light in lights]
    for name in ("sky", "incident"):
        columns[name] = [getattr(light, name) for light in lights]
    rooms, sensors = [s.room for s in shots if s.room], [s.sensor for s in shots if s.sensor]
    if rooms:  # all are photos
        columns["solids"] = [room.solids for room in rooms]
        columns["aperture"] = [room.aperture for room in rooms]
    if sensors:  # photos, or pictures of the hand alone that were taken with one
        columns["sensor"] = [sensor_row(sensor) for sensor in sensors]
    return columns
