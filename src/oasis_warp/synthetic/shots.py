"""Shots: all random choices of pictures before they are rendered, on the CPU; and shots as tables of numbers.

Sampling takes a few milliseconds a shot. A table has one row per picture, so that a batch is copied at once.
"""

import functools
import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.processes import worker_pool
from oasis_warp.core.types import Side
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.body import ARM_LENGTH, ARM_ROWS, bundled_body
from oasis_warp.synthetic.contact import bundled_skeleton, sample_gesture, separate
from oasis_warp.synthetic.furniture import MAX_SOLIDS
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.rooms import Room, sample_room
from oasis_warp.synthetic.sensor import Sensor, sample_sensor, sensor_row
from oasis_warp.synthetic.view_and_light import (
    N_LAMPS,
    Light,
    PictureStyle,
    View,
    avoid_forearm,
    rotate_light,
    rotation_about,
    sample_light,
    sample_view,
)
from oasis_warp.synthetic.wardrobe import SKIN_MATERIAL, Clothes, ring_material, sample_clothes

PICTURES_EACH = 8
"""Number of consecutive indices that show one person, so that each texture is baked once for all of them."""
PICTURE_STREAM = 2
"""Stream number that separates the random numbers of pictures from those of identities with the same seed."""
CAMERA_STREAM = 4
"""Stream number of the camera that moves between pictures of one capture."""
CAMERA_YAW, CAMERA_PITCH = 0.9, 0.3
"""How far it moves around the hand at most [rad]; the rest of a new view comes from the hand's rotation."""
HAND_REACH = 0.11
"""Rough extent of a hand beyond its middle [m]; rooms begin behind it."""
EVERYBODY = Population()


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """What pictures show, apart from the seed's random choices."""

    look: PictureStyle = "photo"
    population: Population = EVERYBODY
    people: int | None = None
    """Number of people, who come again in other pictures; unlimited when None."""
    backgrounds: tuple[Path, ...] = ()
    """Pictures to use as backgrounds (see `backgrounds.list_backgrounds`); rooms when empty."""


PHOTOS = SceneConfig()


class Shot(NamedTuple):
    """All random choices of one picture."""

    index: int
    person: int
    side: Side
    gesture: str
    angles: np.ndarray
    """Angles of all joints about the pose axes [rad], 0 at rest, [16, 3]."""
    bend: np.ndarray
    """Bend of the forearm at the wrist: an axis with the angle as its length [rad], [3]."""
    view: View
    light: Light
    clothes: Clothes
    room: Room | None
    """None in even light, like the sensor."""
    sensor: Sensor | None
    seed: int
    """Seed of all random numbers per pixel."""


def sample_shot(seed: int, index: int, scene: SceneConfig = PHOTOS) -> Shot:
    """Sample picture `index` of the world `seed`; fingers may still penetrate each other."""
    look, even = scene.look, scene.look == "even"
    rng = np.random.default_rng([seed, PICTURE_STREAM, index, even])
    name, angles = sample_gesture(rng, bundled_body().hand)
    bend = np.array([0.0, rng.normal(0, 0.15), rng.normal(0, 0.30)])
    number = index // PICTURES_EACH
    if scene.people is not None:
        number %= scene.people
    view = avoid_forearm(sample_view(rng, look, closed=bool((angles[[1, 4, 7, 10], 0] > 0.9).sum() >= 3)), bend)
    return Shot(
        index=index,
        person=number,
        side="left" if np.random.default_rng([seed, PICTURE_STREAM, number]).random() < 0.5 else "right",
        gesture=name,
        angles=angles,
        bend=bend,
        view=view,
        light=sample_light(rng, look),
        clothes=sample_clothes(rng, bare=even),
        room=None if even else sample_room(rng, view.distance, HAND_REACH),
        sensor=None if even else sample_sensor(rng),
        seed=int(rng.integers(1 << 31)),
    )


@functools.lru_cache(4096)
def cached_identity(seed: int, number: int, population: Population) -> Identity:
    """`sample_identity`, cached."""
    return sample_identity(bundled_body().hand, seed, number, population)


def sample_shots(seed: int, indices: Sequence[int], scene: SceneConfig = PHOTOS) -> list[Shot]:
    """Sample pictures `indices` of the world `seed`, without self-collisions; each is the same in any batch."""
    hand = bundled_body().hand
    shots = [sample_shot(seed, int(index), scene) for index in indices]
    shapes = np.stack([cached_identity(seed, shot.person, scene.population).shape for shot in shots])
    joints, basis = hand.joints.double().numpy(), hand.joint_basis.double().numpy()
    at_rest = joints + (basis * shapes[:, None, None]).sum(-1)
    angles, _ = separate(np.stack([shot.angles for shot in shots]), at_rest * 1e3)
    return [shot._replace(angles=a) for shot, a in zip(shots, angles, strict=True)]


def camera_rotation(seed: int, index: int) -> np.ndarray:
    """Rotation from the photo's camera frame to that of picture `index` of the same capture."""
    random = np.random.default_rng([seed, CAMERA_STREAM, index])
    yaw, pitch = random.uniform(-1, 1, 2) * (CAMERA_YAW, CAMERA_PITCH)
    return rotation_about([1, 0, 0], pitch) @ rotation_about([0, 1, 0], yaw)


def capture_shots(seed: int, photo: Shot, others: Sequence[Shot]) -> list[Shot]:
    """Put `others`, sampled in even light, into the light of `photo` and before its sensor.

    Lamps and walls stay; the hand rotates in front of them, and the camera moves around it.
    """
    return [
        shot._replace(light=rotate_light(photo.light, camera_rotation(seed, shot.index)), sensor=photo.sensor)
        for shot in others
    ]


AHEAD = 3
"""Batches that are sampled ahead per worker."""
ARM_BEND = 0.15
"""Share of the forearm over which it bends at the wrist."""


class ShotTable(NamedTuple):
    """B shots, as processes exchange them."""

    numbers: np.ndarray
    """float32, one row per picture with the fields of `ShotTensors`."""
    whole: np.ndarray
    """int64, [B, 4]: index, person, 1 for left hands, seed of the random numbers per pixel."""
    gestures: tuple[str, ...]


class ShotTensors(NamedTuple):
    """What pictures are rendered from. Those in even light have no room and no sensor: these fields are 0."""

    angles: Float[Tensor, "B 15 3"]
    """As `HandPose.angles`."""
    rotations: Float[Tensor, "B 16 3 3"]
    """With `translations` [m] the transform of each bone from rest to pose, with the wrist fixed."""
    translations: Float[Tensor, "B 16 3"]
    knuckles: Float[Tensor, "B 15"]
    """Factor of `Body.knuckle_rise` for each joint."""
    shape: Float[Tensor, "B S"]
    arm_rotations: Float[Tensor, "B R 3 3"]
    """Rotations of the forearm's rings."""
    arm_girth: Float[Tensor, "B"]
    ring_rotation: Float[Tensor, "B 3 3"]
    """With `ring_translation` the transform of the ring from rest to pose."""
    ring_translation: Float[Tensor, "B 3"]
    wears: Float[Tensor, "B 3"]
    """1 for a sleeve, a wristband, a ring."""
    sleeve_start: Float[Tensor, "B"]
    sleeve_gap: Float[Tensor, "B"]
    sleeve_phases: Float[Tensor, "B 4"]
    band_start: Float[Tensor, "B"]
    band_width: Float[Tensor, "B"]
    band_thickness: Float[Tensor, "B"]
    materials: Float[Tensor, "B 4 6"]
    """Materials of skin, sleeve, wristband and ring."""
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
    """See `sensor.sensor_row`."""


@functools.cache
def _places() -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Columns and shape of each field of `ShotTensors`, from its annotation."""
    sizes = {"S": len(bundled_hand().shape_names), "R": ARM_ROWS, "L": N_LAMPS, "N": MAX_SOLIDS}
    places, start = {}, 0
    for name, annotation in ShotTensors.__annotations__.items():
        shape = tuple(sizes.get(axis) or int(axis) for axis in annotation.dim_str.split()[1:])
        end = start + math.prod(shape)
        places[name], start = (slice(start, end), shape), end
    return places


def sample_table(seed: int, indices: Sequence[int], scene: SceneConfig) -> ShotTable:
    """`sample_shots` as a table."""
    return tabulate(seed, sample_shots(seed, indices, scene), scene)


def tabulate(seed: int, shots: Sequence[Shot], scene: SceneConfig) -> ShotTable:
    """Shots as a table."""
    identities = [cached_identity(seed, shot.person, scene.population) for shot in shots]
    joints = np.stack([_joints(seed, shot.person, scene.population) for shot in shots])
    columns = _columns(shots, identities, joints)
    places = _places()
    numbers = np.empty((len(shots), places[ShotTensors._fields[-1]][0].stop), np.float32)
    for name, (place, _) in places.items():
        numbers[:, place] = np.reshape(columns[name], (len(shots), -1)) if name in columns else 0
    whole = np.array([(s.index, s.person, s.side == "left", s.seed) for s in shots], np.int64)
    return ShotTable(numbers, whole, tuple(s.gesture for s in shots))


def concatenate_tables(plans: Sequence[ShotTable]) -> ShotTable:
    """Several tables as one."""
    numbers, whole = (np.concatenate(tables) for tables in list(zip(*plans, strict=True))[:2])
    return ShotTable(numbers, whole, tuple(itertools.chain.from_iterable(p.gestures for p in plans)))


def sample_tables_ahead(
    seed: int, blocks: Iterable[tuple[Sequence[int], SceneConfig]], workers: int
) -> Iterator[ShotTable]:
    """`sample_table` of each of `blocks`, in order, computed ahead by `workers` processes if there are any."""
    if workers < 1:
        for indices, scene in blocks:
            yield sample_table(seed, indices, scene)
        return
    with worker_pool(workers) as pool:
        waiting: deque = deque()
        try:
            for indices, scene in blocks:
                waiting.append(pool.submit(sample_table, seed, indices, scene))
                if len(waiting) >= AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def copy_to(tensor: Tensor, device: torch.device) -> Tensor:
    """Copy a CPU tensor to `device` without waiting for it."""
    # A copy to a GPU waits for all work before it, unless the source is in page-locked memory.
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def shot_tensors(table: ShotTable, device: torch.device) -> ShotTensors:
    """The numbers of a table on `device`, in one copy."""
    numbers = copy_to(torch.from_numpy(table.numbers), device)
    return ShotTensors(**{name: numbers[:, place].view(-1, *shape) if shape else numbers[:, place.start]
                      for name, (place, shape) in _places().items()})  # fmt: skip


@functools.lru_cache(4096)
def _joints(seed: int, number: int, population: Population) -> np.ndarray:
    """Rest joints of a person [m], with the rounding of `people.Person`."""
    hand = bundled_hand()
    shape = torch.from_numpy(cached_identity(seed, number, population).shape).float()
    return (hand.joints + hand.joint_basis @ shape).double().numpy()


def arm_rotations(bends: np.ndarray) -> np.ndarray:
    """Rotations of the forearm's rings, [B, R, 3, 3], for bends at the wrist as rotation vectors [rad], [B, 3]."""
    share = np.minimum(1.0, np.linspace(0, 1, ARM_ROWS + 1)[1:] / ARM_BEND)
    lengths = np.linalg.norm(bends, axis=1)
    x, y, z = (bends / np.maximum(lengths, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 1, 3, 3)
    angles = (lengths[:, None] * share)[..., None, None]
    return np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * cross @ cross


def _columns(shots: Sequence[Shot], identities: Sequence[Identity], joints: np.ndarray) -> dict[str, Any]:
    """The fields of `ShotTensors`, without those that are 0."""
    angles = np.stack([s.angles for s in shots])
    rotations, translations = bundled_skeleton().transforms(angles, joints)
    flexion = angles[:, 1:, 0] + bundled_hand().rest_bend[1:].numpy()
    bent = (1 - np.cos(np.maximum(flexion, 0))).astype(np.float32)
    bony = np.array([0.9 * (i.bony - 0.5) for i in identities], np.float32)  # beside the hand's own correctives
    each, finger_root = np.arange(len(shots)), [3 * max(i.ring_finger, 0) + 1 for i in identities]
    clothes, views, lights = ([getattr(s, name) for s in shots] for name in ("clothes", "view", "light"))
    columns: dict[str, Any] = {
        "angles": angles[:, 1:],
        "rotations": rotations,
        "translations": translations,
        "knuckles": bent * bony[:, None],
        "shape": [i.shape for i in identities],
        "arm_rotations": arm_rotations(np.stack([s.bend for s in shots])),
        "arm_girth": [i.arm_girth for i in identities],
        "ring_rotation": rotations[each, finger_root],
        "ring_translation": translations[each, finger_root],
        "wears": [(c.sleeve_start < ARM_LENGTH, c.band_start < ARM_LENGTH, i.ring_finger >= 0)
                  for c, i in zip(clothes, identities, strict=True)],
        "materials": [(SKIN_MATERIAL, c.sleeve_material, c.band_material, ring_material(i))
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
