"""Pictures of synthetic hands. Any one is a function of (seed, index), whatever the batch it is made in."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.types import Side
from oasis_warp.ops import depth_map
from oasis_warp.ops.room_tracing import trace_rooms
from oasis_warp.ops.skin_shading import Texture, Worn, shade_skin, smooth_over_faces, surface_state
from oasis_warp.synthetic.atlas import HEIGHT, WIDTH
from oasis_warp.synthetic.backgrounds import cut_background
from oasis_warp.synthetic.body import RING, Body, bundled_body
from oasis_warp.synthetic.contact import separate
from oasis_warp.synthetic.gestures import sample_gesture
from oasis_warp.synthetic.identity import Population
from oasis_warp.synthetic.illumination import light_lamps, see_sky
from oasis_warp.synthetic.people import Person, person
from oasis_warp.synthetic.posing import pose_people
from oasis_warp.synthetic.rooms import Room, sample_room
from oasis_warp.synthetic.sensor import Sensor, expose, sample_sensor, srgb
from oasis_warp.synthetic.stage import Light, Look, View, sample_light, sample_view
from oasis_warp.synthetic.wardrobe import SKIN_LOOK, Clothes, sample_clothes

PICTURES_EACH = 8
"""Consecutive indices that show one person: a texture is baked once for so many."""
PICTURE_STREAM = 2
SAMPLES = 2
"""Sub-pixels along a pixel's side."""
TEXEL = 0.34e-3
"""Size of a texel on the hand [m]."""
STRETCH_PASSES = 2
HAND_REACH = 0.11
"""Of a hand beyond its middle, roughly: rooms begin behind it [m]."""


@dataclass(frozen=True, kw_only=True)
class Scenery:
    """What pictures show, besides what the seed decides."""

    look: Look = "photo"
    population: Population = Population()
    backgrounds: tuple[Path, ...] = ()
    """Pictures to stand behind the hands (see `backgrounds.list_backgrounds`); rooms when empty."""


PHOTOS = Scenery()


class Shot(NamedTuple):
    """All that is drawn for one picture, before anything is rendered."""

    index: int
    person: int
    side: Side
    gesture: str
    angles: np.ndarray
    """Before fingers are kept apart, [16, 3] [rad]."""
    bend: np.ndarray
    view: View
    light: Light
    clothes: Clothes
    room: Room
    sensor: Sensor
    seed: int
    """Of whatever is drawn a pixel at a time."""


class SyntheticBatch(NamedTuple):
    """Pictures and the truth about them. A left hand's pose describes the mirrored model (x -> -x)."""

    image: Float[Tensor, "B H W 3"]
    """sRGB in [0, 1]."""
    alpha: Float[Tensor, "B H W"]
    """Share of each pixel that is hand, arm or clothes."""
    mask: Float[Tensor, "B H W"]
    """Share that is hand, with its ring, without arm and clothes."""
    depth: Float[Tensor, "B H W"]
    """Along the camera's axis [m]; +inf off the hand, its arm and clothes."""
    landmarks: Float[Tensor, "B 21 2"]
    """Projections of the 21 joints and tips [px]."""
    landmarks_3d: Float[Tensor, "B 21 3"]
    """In the camera's frame [m]."""
    angles: Float[Tensor, "B 15 3"]
    """As `HandPose.angles`."""
    orientation: Float[Tensor, "B 3 3"]
    """From the hand's frame to the camera's."""
    translation: Float[Tensor, "B 3"]
    shape: Float[Tensor, "B S"]
    K: Float[Tensor, "B 3 3"]
    left: Int[Tensor, "B"]
    """1 for left hands."""
    person: Int[Tensor, "B"]
    index: Int[Tensor, "B"]
    gestures: tuple[str, ...]


def sample_shot(seed: int, index: int, look: Look = "photo") -> Shot:
    """Draw picture `index` of the world `seed`."""
    rng = np.random.default_rng([seed, PICTURE_STREAM, index, look == "even"])
    name, angles = sample_gesture(rng, bundled_body().hand)
    bend = np.array([0.0, rng.normal(0, 0.15), rng.normal(0, 0.30)])
    number = index // PICTURES_EACH
    view = sample_view(rng, look)
    return Shot(
        index=index,
        person=number,
        side="left" if np.random.default_rng([seed, PICTURE_STREAM, number]).random() < 0.5 else "right",
        gesture=name,
        angles=angles,
        bend=bend,
        view=view,
        light=sample_light(rng, look),
        clothes=sample_clothes(rng, bare=look == "even"),
        room=sample_room(rng, view.distance, HAND_REACH),
        sensor=sample_sensor(rng),
        seed=int(rng.integers(1 << 31)),
    )


@functools.cache
def _body(device: str) -> Body:
    body = bundled_body()
    moved = {name: getattr(body, name).to(device) for name in ("faces", "materials", "uv", "uv_faces")}
    return replace(body, hand=body.hand.to(device), **moved)


@torch.no_grad()
def render_batch(
    seed: int,
    indices: Sequence[int],
    size: int = 256,
    device: torch.device | str = "cpu",
    *,
    scenery: Scenery = PHOTOS,
) -> SyntheticBatch:
    """Pictures `indices` of the world `seed`, each `size` pixels wide and high.

    A picture depends on seed, index, size and scenery alone: not on its batch, nor on the device, up to
    rounding. Indices 8 n to 8 n + 7 show person n, whose texture is baked when first met (seconds) and kept.
    """
    look = scenery.look
    body = _body(str(device))
    shots = [sample_shot(seed, int(index), look) for index in indices]
    people = [person(seed, shot.person, scenery.population, str(device)) for shot in shots]
    joints = np.stack([p.joints.double().cpu().numpy() for p in people]) * 1e3
    angles, _ = separate(np.stack([shot.angles for shot in shots]), joints)
    posed = pose_people(
        body, people, angles, np.stack([s.bend for s in shots]), [s.view for s in shots], [s.clothes for s in shots]
    )
    seeds = torch.tensor([s.seed for s in shots], device=device, dtype=torch.int32)
    fine = size * SAMPLES
    K = torch.zeros(len(shots), 3, 3, device=device)
    K[:, 0, 0] = K[:, 1, 1] = posed.focal * fine
    K[:, 0, 2] = K[:, 1, 2] = fine / 2
    K[:, 2, 2] = 1
    still = torch.eye(4, device=device).expand(len(shots), 4, 4)
    seen = depth_map(posed.vertices, body.faces, still, K, fine, fine, validate=False)
    state = surface_state(posed.vertices, body.faces)
    lights = [s.light for s in shots]
    distance = torch.tensor([s.view.distance for s in shots], device=device, dtype=torch.float32)
    sky = torch.from_numpy(np.stack([light.sky for light in lights])).float().to(device)
    lamps = light_lamps(body, posed, lights)
    shaded = shade_skin(
        seen, K[:, 0, 0], SAMPLES, posed.vertices, body.faces, state.normals, see_sky(body, posed, state.normals),
        _stretch(body, people, state.areas), _textures(body, people), _worn(body, shots, people),
        torch.stack([p.tone for p in people]), distance / (posed.focal * fine) / TEXEL, sky, lamps, seeds,
        n_hand_faces=body.n_hand_faces, ring=RING,
    )  # fmt: skip
    if look == "even":
        image = srgb(shaded.color.clamp(0, 1))
    else:
        solids = torch.from_numpy(np.stack([s.room.solids for s in shots])).to(device)
        apertures = torch.tensor([s.room.aperture for s in shots], device=device)
        if scenery.backgrounds:
            behind = torch.stack([_cut(scenery, shot, size) for shot in shots]).to(device)
        else:
            behind = trace_rooms(
                solids, posed.focal * size, sky, lamps, shaded.alpha, seeds, distance, apertures
            )
        light = shaded.color + (1 - shaded.alpha[..., None]) * behind
        incident = torch.from_numpy(np.stack([s.light.incident for s in shots])).float().to(device)
        image = expose(light, shaded.alpha, [s.sensor for s in shots], incident, seeds)
    K = K / torch.tensor([SAMPLES, SAMPLES, 1.0], device=device)[:, None]
    marks = posed.landmarks @ K.transpose(1, 2)
    batch = SyntheticBatch(
        image=image,
        alpha=shaded.alpha,
        mask=shaded.mask,
        depth=shaded.depth,
        landmarks=marks[..., :2] / marks[..., 2:],
        landmarks_3d=posed.landmarks,
        angles=torch.from_numpy(angles[:, 1:]).float().to(device),
        orientation=torch.from_numpy(np.stack([s.view.rotation for s in shots])).float().to(device),
        translation=posed.translation,
        shape=torch.from_numpy(np.stack([p.identity.shape for p in people])).float().to(device),
        K=K,
        left=torch.tensor([int(s.side == "left") for s in shots], device=device),
        person=torch.tensor([s.person for s in shots], device=device),
        index=torch.tensor([s.index for s in shots], device=device),
        gestures=tuple(s.gesture for s in shots),
    )
    return _mirror_left(batch, size)


def _cut(scenery: Scenery, shot: Shot, size: int) -> Tensor:
    """A picture of the folder as bright as the light on the hand."""
    cut = cut_background(scenery.backgrounds, np.random.default_rng([shot.seed]), size, shot.room.aperture * size)
    return cut * float(shot.light.incident.mean())


def _mirror_left(batch: SyntheticBatch, size: int) -> SyntheticBatch:
    """Everything is made with right hands; the mirror image of one is a left hand in a mirrored world."""
    left = batch.left.bool()

    def flip(images: Tensor) -> Tensor:
        return torch.where(left.view(-1, *[1] * (images.dim() - 1)), images.flip(2), images)

    mirror = torch.tensor([-1.0, 1.0, 1.0], device=batch.image.device)
    sign = torch.where(left[:, None], mirror, torch.ones_like(mirror))
    u, v = batch.landmarks.unbind(-1)
    return batch._replace(
        image=flip(batch.image),
        alpha=flip(batch.alpha),
        mask=flip(batch.mask),
        depth=flip(batch.depth),
        landmarks=torch.stack([torch.where(left[:, None], size - u, u), v], -1),
        landmarks_3d=batch.landmarks_3d * sign[:, None],
        orientation=batch.orientation * sign[:, :, None] * sign[:, None],
        translation=batch.translation * sign,
    )


def _stretch(body: Body, people: list[Person], areas: Tensor) -> Tensor:
    """Area of the posed over that of the resting skin round each vertex; 1 for clothes."""
    rest = torch.stack([p.areas for p in people])
    stretch = torch.ones_like(areas)
    n = rest.shape[1]
    stretch[:, :n] = areas[:, :n] / rest.clamp_min(1e-12)
    stretch = stretch[..., None]
    for _ in range(STRETCH_PASSES):
        stretch = smooth_over_faces(stretch, body.faces)
    return stretch


def _textures(body: Body, people: list[Person]) -> Texture:
    """The textures of a batch, each once."""
    slots: dict[int, int] = {}
    numbers = [slots.setdefault(id(p), len(slots)) for p in people]
    pages = {slots[id(p)]: p.texture for p in people}
    device = people[0].texture.device
    return Texture(
        torch.stack([pages[k] for k in range(len(pages))]),
        torch.tensor(numbers, device=device, dtype=torch.int32),
        body.uv * torch.tensor([WIDTH, HEIGHT], device=device),
        body.uv_faces,
    )


def _worn(body: Body, shots: list[Shot], people: list[Person]) -> Worn:
    looks = [[SKIN_LOOK, s.clothes.sleeve_look, s.clothes.band_look, p.ring_look]
             for s, p in zip(shots, people, strict=True)]  # fmt: skip
    return Worn(body.materials, torch.tensor(looks, device=body.faces.device, dtype=torch.float32))
