"""Render pictures of synthetic hands. Each is a function of seed and index, whatever its batch."""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.mirror import MIRROR, mirror_images
from oasis_warp.ops import depth_map
from oasis_warp.ops.depth_map import DepthMap
from oasis_warp.ops.smoothing import smooth_over_faces
from oasis_warp.synthetic.atlas import HEIGHT, WIDTH
from oasis_warp.synthetic.body import RING, Body, body_on, device_name
from oasis_warp.synthetic.identity import Population
from oasis_warp.synthetic.illumination import light_lamps, no_lamps, pinhole, see_sky
from oasis_warp.synthetic.ops.room_tracing import trace_rooms
from oasis_warp.synthetic.ops.skin_shading import Shaded, Texture, Worn, shade_skin, surface_state
from oasis_warp.synthetic.ops.views import Lamps
from oasis_warp.synthetic.people import Person, person
from oasis_warp.synthetic.posing import PosedPeople, pose_people
from oasis_warp.synthetic.rooms import cut_background
from oasis_warp.synthetic.sensor import develop, expose, meter, srgb
from oasis_warp.synthetic.shots import (
    PHOTOS,
    SceneConfig,
    ShotTable,
    ShotTensors,
    copy_to,
    sample_table,
    sample_tables_ahead,
    shot_tensors,
)

SAMPLES = 2
"""Sub-pixels along a pixel's side."""
TEXEL = 0.34e-3
"""Size of a texel on the hand [m]."""
STRETCH_PASSES = 2


class SyntheticBatch(NamedTuple):
    """Pictures with ground truth. A left hand's pose describes the mirrored model (x -> -x)."""

    image: Float[Tensor, "B H W 3"]
    """sRGB in [0, 1]."""
    alpha: Float[Tensor, "B H W"]
    """Share of each pixel that is hand, arm or clothes."""
    mask: Float[Tensor, "B H W"]
    """Share that is hand or ring, without arm and clothes."""
    depth: Float[Tensor, "B H W"]
    """Depth along the camera's axis [m]; +inf on the background."""
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


@functools.cache
def _texels(device: torch.device) -> tuple[Tensor, Tensor]:
    """Texture coordinates in texels, and their faces."""
    body = body_on(str(device))
    return body.uv * torch.tensor([WIDTH, HEIGHT], device=device), body.uv_faces.to(torch.int32)


@functools.cache
def _mirror(device: torch.device) -> Tensor:
    return torch.tensor(MIRROR, device=device)


def render_batch(
    seed: int,
    indices: Sequence[int],
    size: int = 256,
    device: torch.device | str = "cpu",
    *,
    scene: SceneConfig = PHOTOS,
) -> SyntheticBatch:
    """Render pictures `indices` of the world `seed`, each `size` pixels wide and high.

    A picture depends on seed, index, size and scene only: not on its batch nor, up to rounding, on the device.
    Indices 8 n to 8 n + 7 show one person, whose texture is baked at first use (seconds) and cached.
    """
    return render_table(seed, sample_table(seed, indices, scene), size, device, scene=scene)


@torch.no_grad()
def render_table(
    seed: int, table: ShotTable, size: int, device: torch.device | str, *, scene: SceneConfig
) -> SyntheticBatch:
    """Render the shots that `sample_table` has drawn for the same seed and scene, without waiting for the device."""
    even = scene.look == "even"
    batch = shade_batch(seed, table, size, torch.device(device), scene.population, lamps=not even)
    if even:
        image = _over_black(batch.shaded, lambda linear: srgb(linear.clamp(max=1)))
    else:
        image = take_photo(batch, scene_light(batch, table, size, scene))
    return _with_ground_truth(batch, image, table, size)


@torch.no_grad()
def render_capture(
    seed: int, photo: ShotTable, others: ShotTable, size: int, device: torch.device | str, *, scene: SceneConfig
) -> tuple[SyntheticBatch, SyntheticBatch]:
    """Render one photo, and pictures of the bare hand over black in its light and exposure, by an ideal camera.

    Args:
        seed: Seed of the world.
        photo: One shot with background and sensor.
        others: Shots of `shots.capture_shots` with this photo.
        size: Side of all pictures [px].
        device: Where to render.
        scene: Scene of the photo.
    """
    device = torch.device(device)
    batch = shade_batch(seed, photo, size, device, scene.population, lamps=True)
    light = scene_light(batch, photo, size, scene)
    again = shade_batch(seed, others, size, device, scene.population, lamps=True)
    count = len(others.numbers)
    gains = meter(light, batch.shaded.alpha, batch.numbers.sensor, batch.numbers.incident).expand(count, -1)
    sensors = batch.numbers.sensor.expand(count, -1)
    image = _over_black(again.shaded, lambda linear: develop(linear, gains, sensors))
    return _with_ground_truth(batch, take_photo(batch, light), photo, size), _with_ground_truth(
        again, image, others, size
    )


class ShadedBatch(NamedTuple):
    """A batch of posed, lit and shaded hands, in linear light and without background."""

    numbers: ShotTensors
    whole: Int[Tensor, "B 4"]
    """As `ShotTable.whole`."""
    posed: PosedPeople
    seen: DepthMap
    """The body's mesh at `SAMPLES` times the size."""
    normals: Float[Tensor, "B V 3"]
    """Normals of the posed vertices, in the camera's frame."""
    lamps: Lamps
    shaded: Shaded


def shade_batch(
    seed: int, table: ShotTable, size: int, device: torch.device, population: Population, *, lamps: bool
) -> ShadedBatch:
    """Pose, light and shade the hands of a table, with its lamps or under an even sky alone."""
    name = device_name(device)
    device, body = torch.device(name), body_on(name)
    people = [person(seed, number, population, name) for number in table.whole[:, 1].tolist()]
    numbers = shot_tensors(table, device)
    whole = copy_to(torch.from_numpy(table.whole), device)
    posed = pose_people(body, people, numbers)
    fine = size * SAMPLES
    K = pinhole(posed.focal * fine, fine)
    eye = torch.eye(4, device=device).expand(len(people), 4, 4)
    seen = depth_map(posed.vertices, body.faces, eye, K, fine, fine, validate=False)
    state = surface_state(posed.vertices, body.faces)
    lit = light_lamps(body, posed, numbers) if lamps else no_lamps(posed.vertices)
    shaded = shade_skin(
        seen, K[:, 0, 0], SAMPLES, posed.vertices, body.faces, state.normals, see_sky(body, posed, state.normals),
        _stretch(body, people, state.areas), Texture([p.texture for p in people], *_texels(device)),
        Worn(body.materials, numbers.materials), torch.stack([p.tone for p in people]),
        numbers.view_distance / (posed.focal * fine) / TEXEL, numbers.sky, lit, whole[:, 3],
        n_hand_faces=body.n_hand_faces, ring=RING,
    )  # fmt: skip
    return ShadedBatch(numbers, whole, posed, seen, state.normals, lit, shaded)


def _over_black(shaded: Shaded, camera: Callable[[Tensor], Tensor]) -> Float[Tensor, "B H W 3"]:
    """Apply the camera to the light of hand and arm and composite over black, as splats are rendered."""
    share = shaded.alpha[..., None]
    return share * camera((shaded.color / share.clamp_min(1e-3)).clamp_min(0))


def scene_light(batch: ShadedBatch, table: ShotTable, size: int, scene: SceneConfig) -> Float[Tensor, "B H W 3"]:
    """The linear light of hand, arm and background."""
    numbers, shaded = batch.numbers, batch.shaded
    if scene.backgrounds:
        behind = copy_to(_cut_backgrounds(scene, table, size), shaded.color.device)
    else:
        behind = trace_rooms(
            numbers.solids, batch.posed.focal * size, numbers.sky, batch.lamps, shaded.alpha, numbers.view_distance,
            numbers.aperture,
        )  # fmt: skip
    return shaded.color + (1 - shaded.alpha[..., None]) * behind


def take_photo(batch: ShadedBatch, light: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W 3"]:
    """The photo that the sensors take of the light."""
    numbers = batch.numbers
    return expose(light, batch.shaded.alpha, numbers.sensor, numbers.incident, batch.whole[:, 3])


def _with_ground_truth(
    batch: ShadedBatch, image: Float[Tensor, "B H W 3"], table: ShotTable, size: int
) -> SyntheticBatch:
    """The pictures with their ground truth; left hands are mirrored."""
    numbers, posed, shaded = batch.numbers, batch.posed, batch.shaded
    index, number, left, _ = batch.whole.unbind(1)
    K = pinhole(posed.focal * size, size)
    marks = posed.landmarks @ K.transpose(1, 2)
    pictures = SyntheticBatch(
        image=image,
        alpha=shaded.alpha,
        mask=shaded.mask,
        depth=shaded.depth,
        landmarks=marks[..., :2] / marks[..., 2:],
        landmarks_3d=posed.landmarks,
        angles=numbers.angles,
        orientation=numbers.view_rotation,
        translation=posed.translation,
        shape=numbers.shape,
        K=K,
        left=left,
        person=number,
        index=index,
        gestures=table.gestures,
    )
    return _mirror_left(pictures, size)


def slice_batch(batch: SyntheticBatch, rows: slice) -> SyntheticBatch:
    """Rows of a batch."""
    return SyntheticBatch(*(field[rows] for field in batch))


def stream(
    seed: int, batch: int, size: int = 256, device: torch.device | str = "cpu", *, start: int = 0,
    scene: SceneConfig = PHOTOS, workers: int = 0,
) -> Iterator[SyntheticBatch]:  # fmt: skip
    """Endless batches of `render_batch` from picture `start` on, for training on the fly.

    Sampling a shot takes some milliseconds of CPU time; `workers` processes sample ahead while a GPU renders.
    """
    blocks = ((range(first, first + batch), scene) for first in itertools.count(start, batch))
    for table in sample_tables_ahead(seed, blocks, workers):
        yield render_table(seed, table, size, device, scene=scene)


def _cut_backgrounds(scene: SceneConfig, table: ShotTable, size: int) -> Tensor:
    """A background for each shot, as bright as the light on the hand; on the CPU."""
    numbers, cuts = shot_tensors(table, torch.device("cpu")), []
    for aperture, light, seed in zip(numbers.aperture, numbers.incident, table.whole[:, 3], strict=True):
        random = np.random.default_rng([int(seed)])
        cuts.append(cut_background(scene.backgrounds, random, size, float(aperture) * size) * light.mean())
    return torch.stack(cuts)


def _mirror_left(batch: SyntheticBatch, size: int) -> SyntheticBatch:
    """Mirror the pictures of left hands: everything is rendered with right hands."""
    left = batch.left.bool()
    mirror = _mirror(batch.image.device)
    sign = torch.where(left[:, None], mirror, torch.ones_like(mirror))
    u, v = batch.landmarks.unbind(-1)
    return batch._replace(
        **{name: mirror_images(getattr(batch, name), left) for name in ("image", "alpha", "mask", "depth")},
        landmarks=torch.stack([torch.where(left[:, None], size - u, u), v], -1),
        landmarks_3d=batch.landmarks_3d * sign[:, None],
        orientation=batch.orientation * sign[:, :, None] * sign[:, None],
        translation=batch.translation * sign,
    )


def _stretch(body: Body, people: list[Person], areas: Tensor) -> Tensor:
    """Ratio of the posed to the rest area of the skin around each vertex; 1 for clothes."""
    rest = torch.stack([p.areas for p in people])
    stretch = torch.ones_like(areas)
    n = rest.shape[1]
    stretch[:, :n] = areas[:, :n] / rest.clamp_min(1e-12)
    stretch = stretch[..., None]
    for _ in range(STRETCH_PASSES):
        stretch = smooth_over_faces(stretch, body.faces)
    return stretch
