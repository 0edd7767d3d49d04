"""Plan pictures: all that is drawn at random, before anything is rendered. On the CPU, a few milliseconds each."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from oasis_warp.core.types import Side
from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.contact import separate
from oasis_warp.synthetic.gestures import sample_gesture
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.rooms import Room, sample_room
from oasis_warp.synthetic.sensor import Sensor, sample_sensor
from oasis_warp.synthetic.view_and_light import (
    Light,
    Look,
    View,
    clear_of_arm,
    rotation_about,
    sample_light,
    sample_view,
    turn_light,
)
from oasis_warp.synthetic.wardrobe import Clothes, sample_clothes

PICTURES_EACH = 8
"""Consecutive indices that show one person: a texture is baked once for so many."""
PICTURE_STREAM = 2
"""Tells the random numbers of pictures from those of identities with the same seed."""
CAMERA_STREAM = 4
"""And those of a camera that moves between pictures of one capture."""
CAMERA_YAW, CAMERA_PITCH = 0.9, 0.3
"""How far it moves round the hand at most [rad]; the rest of a new view is the hand's turning."""
HAND_REACH = 0.11
"""Of a hand beyond its middle, roughly: rooms begin behind it [m]."""
EVERYBODY = Population()


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """What pictures show, besides what the seed decides."""

    look: Look = "photo"
    population: Population = EVERYBODY
    people: int | None = None
    """How many people there are: then the first comes again, in other pictures. No end when None."""
    backgrounds: tuple[Path, ...] = ()
    """Pictures to stand behind the hands (see `backgrounds.list_backgrounds`); rooms when empty."""


PHOTOS = SceneConfig()


class Shot(NamedTuple):
    """All that is drawn for one picture, before anything is rendered."""

    index: int
    person: int
    side: Side
    gesture: str
    angles: np.ndarray
    """Of all joints about the pose axes, 0 at rest, [16, 3] [rad]."""
    bend: np.ndarray
    view: View
    light: Light
    clothes: Clothes
    room: Room | None
    """As the sensor, none in even light."""
    sensor: Sensor | None
    seed: int
    """Of whatever is drawn a pixel at a time."""


def sample_shot(seed: int, index: int, scenery: SceneConfig = PHOTOS) -> Shot:
    """Draw picture `index` of the world `seed`; fingers may still sink in."""
    look, even = scenery.look, scenery.look == "even"
    rng = np.random.default_rng([seed, PICTURE_STREAM, index, even])
    name, angles = sample_gesture(rng, bundled_body().hand)
    bend = np.array([0.0, rng.normal(0, 0.15), rng.normal(0, 0.30)])
    number = index // PICTURES_EACH
    if scenery.people is not None:
        number %= scenery.people
    view = clear_of_arm(sample_view(rng, look, closed=bool((angles[[1, 4, 7, 10], 0] > 0.9).sum() >= 3)), bend)
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
def identity_of(seed: int, number: int, population: Population) -> Identity:
    """Person `number` of the world `seed`, remembered."""
    return sample_identity(bundled_body().hand, seed, number, population)


def sample_shots(seed: int, indices: Sequence[int], scenery: SceneConfig = PHOTOS) -> list[Shot]:
    """Pictures `indices` of the world `seed`, their fingers kept apart: each as if it were alone."""
    hand = bundled_body().hand
    shots = [sample_shot(seed, int(index), scenery) for index in indices]
    shapes = np.stack([identity_of(seed, shot.person, scenery.population).shape for shot in shots])
    joints, basis = hand.joints.double().numpy(), hand.joint_basis.double().numpy()
    at_rest = joints + (basis * shapes[:, None, None]).sum(-1)
    angles, _ = separate(np.stack([shot.angles for shot in shots]), at_rest * 1e3)
    return [shot._replace(angles=a) for shot, a in zip(shots, angles, strict=True)]


def camera_turn(seed: int, index: int) -> np.ndarray:
    """How the camera has moved round the hand in picture `index` of a capture, from the photo's frame to its own."""
    random = np.random.default_rng([seed, CAMERA_STREAM, index])
    yaw, pitch = random.uniform(-1, 1, 2) * (CAMERA_YAW, CAMERA_PITCH)
    return rotation_about([1, 0, 0], pitch) @ rotation_about([0, 1, 0], yaw)


def capture_shots(seed: int, photo: Shot, others: Sequence[Shot]) -> list[Shot]:
    """`others`, drawn in even light, as pictures of the capture that `photo` is of: in its light, with its sensor.

    Lamps and walls stay; the hand turns before them, and the camera moves round it.
    """
    shots = []
    for shot in others:
        light = turn_light(photo.light, camera_turn(seed, shot.index))
        shots.append(shot._replace(light=light, sensor=photo.sensor))
    return shots
