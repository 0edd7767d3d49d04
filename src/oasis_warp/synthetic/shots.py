"""Sample shots: all random choices of a picture, before it is rendered. On the CPU, a few milliseconds each."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from oasis_warp.core.types import Side
from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.contact import sample_gesture, separate
from oasis_warp.synthetic.identity import Identity, Population, sample_identity
from oasis_warp.synthetic.rooms import Room, sample_room
from oasis_warp.synthetic.sensor import Sensor, sample_sensor
from oasis_warp.synthetic.view_and_light import (
    Light,
    PictureStyle,
    View,
    avoid_forearm,
    rotate_light,
    rotation_about,
    sample_light,
    sample_view,
)
from oasis_warp.synthetic.wardrobe import Clothes, sample_clothes

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
    """Of all joints about the pose axes [rad], 0 at rest, [16, 3]."""
    bend: np.ndarray
    """Of the forearm at the wrist: an axis with the angle as its length [rad], [3]."""
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
