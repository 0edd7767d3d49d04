"""Synthetic photos of right hands with the truth of every pixel: class, surface point, normal, albedo, finger."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, grid_sample

from oasis_warp.core.color import linear_light
from oasis_warp.synthetic.body import FINGERS, body_on, device_name
from oasis_warp.synthetic.disturbances import disturb
from oasis_warp.synthetic.picture import SAMPLES, ShadedBatch, scene_light, shade_batch, take_photo
from oasis_warp.synthetic.sensor import srgb
from oasis_warp.synthetic.shots import SceneConfig, ShotTable

UNIT = 0.1
"""Length that a surface coordinate of 1 stands for [m]."""
FINGER_ORDER = tuple(FINGERS.index(name) for name in ("thumb", "index", "middle", "ring", "little"))
EXPOSURE_JITTER = 0.35
"""Standard deviation of the logarithm of each photo's exposure, beside the sensor's own."""
GLOSSY, DIM = 0.3, 0.3
"""Shares of moved photos whose skin shines, and that are darker and greyer."""
GLOSS, GLOSS_POWERS = (0.03, 0.4), (3.0, 30.0)
"""Ranges of the gloss, in linear light, and of the exponent of its lobe."""
ALIKE, ALIKE_GAIN = 0.3, 0.4
"""Share of moved photos in which one side of the hand has the tone of what is around it, and the standard deviation of
the logarithm by which that side is brighter or darker than it was."""
DIM_POWER, DIM_GREY = 0.8, 0.6
"""Largest rise of the logarithm of a dim photo's exponent, and share of its saturation that goes."""
MIN_SKIN = 0.6
"""Share of a pixel that must be visible bare skin for its surface point to count."""


class DenseBatch(NamedTuple):
    """Photos and the truth of their pixels."""

    image: Float[Tensor, "B 3 H W"]
    """sRGB in [0, 1]."""
    classes: Float[Tensor, "B 4 H W"]
    """Shares of background, hand, arm or clothes, and what hides the hand; they sum to 1."""
    skin: Bool[Tensor, "B H W"]
    """Where the fields below hold."""
    surface: Float[Tensor, "B 3 H W"]
    """Point on the mean hand at rest [`UNIT`]."""
    normal: Float[Tensor, "B 3 H W"]
    """Unit normal in the camera's frame."""
    albedo: Float[Tensor, "B 3 H W"]
    """Diffuse reflectance, linear RGB."""
    finger: Int[Tensor, "B H W"]
    """0 for palm and back, 1 to 5 from thumb to little finger."""
    landmarks: Float[Tensor, "B 21 2"]
    """[px]."""


@torch.no_grad()
def render_dense(
    seed: int, table: ShotTable, size: int, device: torch.device | str, *, scene: SceneConfig, random: torch.Generator
) -> DenseBatch:
    """Render the shots of `table` (see `picture.render_table`) with disturbances.

    Args:
        seed: Seed of the world.
        table: What to render; all hands are shown as right hands.
        size: Width and height [px].
        device: Where to render.
        scene: Options of the table.
        random: Generator of the disturbances, on the device.
    """
    batch = shade_batch(seed, table, size, torch.device(device), scene.population, lamps=True)
    shaded, numbers = batch.shaded, batch.numbers
    light = scene_light(batch, table, size, scene)
    light, front = disturb(light, shaded.color, shaded.alpha, shaded.depth, numbers.incident, random)
    exposure = torch.randn(len(light), generator=random, device=light.device).mul(EXPOSURE_JITTER).exp()
    sensor = numbers.sensor.clone()
    sensor[:, 0] *= exposure
    image = take_photo(batch._replace(numbers=numbers._replace(sensor=sensor)), light)
    return _with_ground_truth(batch, image.permute(0, 3, 1, 2), front)


def _with_ground_truth(batch: ShadedBatch, image: Tensor, front: Tensor) -> DenseBatch:
    body = body_on(device_name(image.device))
    ids, shaded, posed = batch.seen.face_ids, batch.shaded, batch.posed
    on_hand = (ids >= 0) & (ids < body.n_hand_faces)
    covered = avg_pool2d(on_hand[:, None].float(), SAMPLES)

    def pooled(values: Float[Tensor, "B Y X C"]) -> Float[Tensor, "B C H W"]:
        """Mean of the sub-pixels on the hand."""
        return avg_pool2d((values * on_hand[..., None]).permute(0, 3, 1, 2), SAMPLES) / covered.clamp_min(1e-6)

    corners = body.faces[ids.clamp(0, body.n_hand_faces - 1).long()].long()
    weights = batch.seen.barycentrics[..., None]
    rows = torch.arange(len(ids), device=ids.device).view(-1, 1, 1, 1)
    fingers = body.finger_weights[:, list(FINGER_ORDER)]
    fixed = torch.cat([body.rest * (1e-3 / UNIT), 1 - fingers.sum(1, keepdim=True), fingers], 1)
    surface, finger = pooled((fixed[corners] * weights).sum(-2)).split([3, 6], 1)
    normal = pooled((batch.normals[rows, corners] * weights).sum(-2))
    rest = 1 - front
    classes = torch.stack(
        [(1 - shaded.alpha) * rest, shaded.mask * rest, (shaded.alpha - shaded.mask).clamp_min(0) * rest, front], 1
    )
    classes = classes / classes.sum(1, keepdim=True)
    size = image.shape[-1]
    marks = posed.landmarks[..., :2] / posed.landmarks[..., 2:] * (posed.focal * size)[:, None, None] + size / 2
    return DenseBatch(
        image=image,
        classes=classes,
        skin=(covered[:, 0] > MIN_SKIN) & (classes[:, 1] > MIN_SKIN),
        surface=surface,
        normal=torch.nn.functional.normalize(normal, dim=1),
        albedo=pooled(shaded.albedo).clamp(0, 1),
        finger=finger.argmax(1),
        landmarks=marks,
    )


def _disguised(batch: DenseBatch, random: torch.Generator) -> Float[Tensor, "B 3 H W"]:
    """The photos; in some, one side of the hand has the tone of its surroundings; some have a broad highlight.

    The back of a dark hand beside a window is grey and shines; before stone nothing but its form tells it from that.
    """
    count, device = len(batch.image), batch.image.device

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, 1, generator=random, device=device)

    def normal(channels: int) -> Tensor:
        return torch.randn(count, channels, 1, 1, generator=random, device=device)

    def facing() -> Tensor:
        """Cosine between the skin and a direction, within 90 degrees of the camera's."""
        toward = normal(3)
        toward = torch.nn.functional.normalize(torch.cat([toward[:, :2], -toward[:, 2:].abs()], 1), dim=1)
        return (facets * toward).sum(1, keepdim=True).clamp_min(0)

    skin = batch.skin[:, None].float()  # its outermost pixels have no normals
    near = avg_pool2d(torch.cat([batch.normal * skin, skin], 1), 5, 1, 2)
    facets = torch.nn.functional.normalize(near[:, :3], dim=1)
    share = batch.classes[:, 1:2] * (near[:, 3:] > 0)
    light = linear_light(batch.image.movedim(1, -1)).movedim(-1, 1)
    around = batch.classes[:, :1]
    tone = (light * around).sum((2, 3), keepdim=True) / around.sum((2, 3), keepdim=True).clamp_min(1)
    grey = light.mean(1, keepdim=True)
    alike = grey * tone / tone.mean(1, keepdim=True).clamp_min(1e-3) * (ALIKE_GAIN * normal(1)).exp()
    side = share * (4 * facing() - between(0.5, 2.5)).clamp(0, 1) * (between(0.0, 1.0) < ALIKE) * between(0.4, 1.0)
    light = torch.lerp(light, alike, side)
    lobe = facing() ** between(*map(math.log, GLOSS_POWERS)).exp()
    strength = between(*map(math.log, GLOSS)).exp() * (between(0.0, 1.0) < GLOSSY)
    return srgb((light + share * strength * (1 + 0.1 * normal(3)).clamp_min(0) * lobe).clamp(0, 1))


def moved(batch: DenseBatch, random: torch.Generator) -> DenseBatch:
    """The same photos rotated, scaled, shifted, and in other colours; what comes in is black or of one colour.

    A photo takes long to render, so training shows each one again like this. Some of them shine, some are dim, and in
    some a side of the hand looks like what is around it.
    """
    count, size = len(batch.image), batch.image.shape[-1]

    def normal(*shape: int, sigma: float) -> Tensor:
        return sigma * torch.randn(*shape, generator=random, device=random.device)

    def uniform(*shape: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=random, device=random.device)

    angle = uniform(count, low=-math.pi, high=math.pi)
    scale, shift = uniform(count, low=-0.35, high=0.3).exp(), normal(count, 2, sigma=0.18)
    cos, sin = angle.cos(), angle.sin()
    rotation = torch.stack([cos, -sin, sin, cos], 1).view(-1, 2, 2)
    rows = torch.cat([scale[:, None, None] * rotation, shift[..., None]], 2)
    grid = affine_grid(rows, [count, 1, size, size], align_corners=False)

    def sample(values: Tensor, mode: str = "bilinear") -> Tensor:
        return grid_sample(values, grid, mode=mode, align_corners=False)

    border = uniform(count, 3, 1, 1, low=0.0, high=1.0) * (uniform(count, 1, 1, 1, low=-1.0, high=1.0) > 0)
    power, gain = normal(count, 1, 1, 1, sigma=0.2).exp(), normal(count, 3, 1, 1, sigma=0.12).exp()
    image = ((sample(_disguised(batch, random) - border) + border).clamp(0, 1) ** power * gain).clamp(0, 1)
    dim = (uniform(count, 1, 1, 1, low=0.0, high=1.0) < DIM) * uniform(2, count, 1, 1, 1, low=0.0, high=1.0)
    image = torch.lerp(image, image.mean(1, keepdim=True), DIM_GREY * dim[0]) ** (DIM_POWER * dim[1]).exp()
    classes, albedo, inside = sample(
        torch.cat([batch.classes, batch.albedo, torch.ones_like(batch.albedo[:, :1])], 1)
    ).split([4, 3, 1], 1)
    classes = torch.cat([classes[:, :1] + 1 - classes.sum(1, keepdim=True), classes[:, 1:]], 1).clamp_min(0)
    exact = torch.cat([batch.surface, batch.normal, batch.finger[:, None], batch.skin[:, None]], 1)
    surface, normals, finger, skin = sample(exact, "nearest").split([3, 3, 1, 1], 1)
    in_plane = torch.einsum("bji,bjhw->bihw", rotation, normals[:, :2])
    centred = batch.landmarks / size * 2 - 1 - shift[:, None]
    landmarks = torch.einsum("bji,bnj->bni", rotation, centred) / scale[:, None, None]
    return DenseBatch(
        image=image,
        classes=classes,
        skin=(skin[:, 0] > 0.5) & (inside[:, 0] > 0.99),
        surface=surface,
        normal=torch.cat([in_plane, normals[:, 2:]], 1),
        albedo=albedo,
        finger=finger[:, 0].long(),
        landmarks=(landmarks + 1) * size / 2,
    )
