"""Pictures of synthetic hands. Any one is a function of (seed, index), whatever the batch it is made in."""

import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.ops import depth_map
from oasis_warp.ops.room_tracing import trace_rooms
from oasis_warp.ops.skin_shading import Texture, Worn, shade_skin, smooth_over_faces, surface_state
from oasis_warp.synthetic.atlas import HEIGHT, WIDTH
from oasis_warp.synthetic.backgrounds import cut_background
from oasis_warp.synthetic.body import RING, Body, bundled_body
from oasis_warp.synthetic.illumination import light_lamps, see_sky
from oasis_warp.synthetic.people import Person, person
from oasis_warp.synthetic.plan import PHOTOS, Scenery, Shot, plan_ahead, plan_shots
from oasis_warp.synthetic.posing import pose_people
from oasis_warp.synthetic.sensor import expose, srgb
from oasis_warp.synthetic.wardrobe import SKIN_LOOK

SAMPLES = 2
"""Sub-pixels along a pixel's side."""
TEXEL = 0.34e-3
"""Size of a texel on the hand [m]."""
STRETCH_PASSES = 2


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


@functools.cache
def _body(device: str) -> Body:
    body = bundled_body()
    moved = {
        name: getattr(body, name).to(device)
        for name in (
            "faces",
            "materials",
            "uv",
            "uv_faces",
            "normals",
            "knuckle_rise",
            "coarse_vertices",
            "coarse_faces",
        )
    }
    return replace(body, hand=body.hand.to(device), **moved)


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
    rounding. Indices 8 n to 8 n + 7 show one person, whose texture is baked when first met (seconds) and kept.
    """
    return render_shots(seed, plan_shots(seed, indices, scenery), size, device, scenery=scenery)


@torch.no_grad()
def render_shots(
    seed: int, shots: Sequence[Shot], size: int, device: torch.device | str, *, scenery: Scenery
) -> SyntheticBatch:
    """The second half of `render_batch`: pictures of what `plan_shots` has drawn for the same seed and scenery."""
    device, look = str(device), scenery.look
    body = _body(device)
    people = [person(seed, shot.person, scenery.population, device) for shot in shots]
    angles = np.stack([shot.angles for shot in shots])
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
        share = shaded.alpha[..., None]
        image = share * srgb((shaded.color / share.clamp_min(1e-3)).clamp(0, 1))  # over black, as splats are drawn
    else:
        solids = torch.from_numpy(np.stack([s.room.solids for s in shots])).to(device)
        apertures = torch.tensor([s.room.aperture for s in shots], device=device)
        if scenery.backgrounds:
            behind = torch.stack([_cut(scenery, shot, size) for shot in shots]).to(device)
        else:
            behind = trace_rooms(solids, posed.focal * size, sky, lamps, shaded.alpha, distance, apertures)
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


def stream(
    seed: int, batch: int, size: int = 256, device: torch.device | str = "cpu", *, start: int = 0,
    scenery: Scenery = PHOTOS, workers: int = 0,
) -> Iterator[SyntheticBatch]:  # fmt: skip
    """Pictures from `start` on in batches, without end: `render_batch`, for training on the fly.

    Drawing a shot takes a CPU some milliseconds; with `workers`, so many processes draw ahead while a GPU renders.
    """
    blocks = (range(first, first + batch) for first in itertools.count(start, batch))
    for shots in plan_ahead(seed, blocks, scenery, workers):
        yield render_shots(seed, shots, size, device, scenery=scenery)


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
        pages[0][None] if len(pages) == 1 else torch.stack([pages[k] for k in range(len(pages))]),
        torch.tensor(numbers, device=device, dtype=torch.int32),
        body.uv * torch.tensor([WIDTH, HEIGHT], device=device),
        body.uv_faces,
    )


def _worn(body: Body, shots: list[Shot], people: list[Person]) -> Worn:
    looks = [[SKIN_LOOK, s.clothes.sleeve_look, s.clothes.band_look, p.ring_look]
             for s, p in zip(shots, people, strict=True)]  # fmt: skip
    return Worn(body.materials, torch.tensor(looks, device=body.faces.device, dtype=torch.float32))
