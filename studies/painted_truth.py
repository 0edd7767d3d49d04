"""Hands that are known exactly, with paint on their skin: what an edit should look like, in any pose and view.

The skin is a high-resolution function of the surface, the paint a high-resolution picture in the photo's view that is
carried by the surface; both are drawn through the depth buffer of the mesh, without Gaussians.
"""

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.config import ReconstructConfig, adapt_config
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.hand_crop import crop_hand
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import reconstruct

KINDS = ("tattoo", "writing", "ring", "nail polish")
JPEG_QUALITY = 92
SAMPLES = 4
"""Sub-pixels along a pixel's side, of every true picture."""
MELANIN = 0.03
GROUND = (0.32, 0.42, 0.38)
WAVES, WAVE_LENGTHS, WAVE_SIZE = 24, (0.002, 0.02), 0.006
"""Waves of the skin's own detail: how many, how long [m] and how strong [sRGB]."""
RING_FINGER, RING_PLACE, RING_WIDTH = 10, 0.55, 0.006
"""Joint, share of the bone and width [m]."""
GOLD, DARK_GOLD, POLISH = (0.86, 0.66, 0.2), (0.45, 0.3, 0.06), (0.75, 0.05, 0.2)
INK, RED = (0.1, 0.12, 0.28), (0.8, 0.15, 0.1)


class Surface(NamedTuple):
    """Where points of a picture lie on the hand; face -1 where they do not."""

    face_ids: Int[Tensor, "*P"]
    barycentrics: Float[Tensor, "*P 3"]


class KnownHand(NamedTuple):
    """A hand, how its photo was taken, and what is painted on it."""

    hand: HandModel
    pose: HandPose
    camera: Camera
    avatar: Avatar
    """LitGaussians from the photo without paint, on the true surface."""
    photo: Photo
    waves: tuple[Tensor, Tensor, Tensor] | None
    """Waves of the skin's detail; None where it is not known."""


class Drawn(NamedTuple):
    """A true picture."""

    image: Float[Tensor, "H W 3"]
    """Over black."""
    alpha: Float[Tensor, "H W"]
    paint: Float[Tensor, "H W"]
    """Share of each pixel that is paint."""


def _fine(camera: Camera) -> Camera:
    K = camera.K.clone()
    K[:2] *= SAMPLES
    return Camera(camera.viewmat, K, camera.width * SAMPLES, camera.height * SAMPLES)


def _averaged(fine: Float[Tensor, "H W C"]) -> Float[Tensor, "h w C"]:
    height, width = fine.shape[0] // SAMPLES, fine.shape[1] // SAMPLES
    return fine.view(height, SAMPLES, width, SAMPLES, -1).mean((1, 3))


def _at(values: Float[Tensor, "V C"], faces: Tensor, on: Surface) -> Float[Tensor, "*P C"]:
    return (values[faces[on.face_ids.clamp_min(0).long()]] * on.barycentrics[..., None]).sum(-2)


def _look(vertices: Tensor, faces: Tensor, camera: Camera) -> Surface:
    seen = depth_map(vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    return Surface(seen.face_ids, seen.barycentrics)


def make_truth(hand: HandModel, prior: Prior, *, back: bool, size: int, steps: int | None = None) -> KnownHand:
    """An open hand seen from its palm or back on a photo of `size` pixels, and the avatar made from that photo."""
    shape = torch.zeros(hand.shape_basis.shape[-1])
    # Fingers up; the hand's -x is the picture's -y, its -y or +y looks to the camera.
    sign = 1.0 if back else -1.0
    orientation = torch.tensor([[0.0, 0.0, -sign], [1.0, 0.0, 0.0], [0.0, -sign, 0.0]])
    pose = HandPose(named_pose(hand, "open"), orientation, torch.tensor([0.0, 0.09, 0.6]))
    rest = rest_hand(hand, shape)
    posed = skin(hand, rest, pose)
    focal = 2.6 * size
    center = (posed.vertices.amin(0) + posed.vertices.amax(0)) / 2
    principal = size / 2 - focal * center[:2] / center[2]
    K = torch.tensor([[focal, 0, principal[0]], [0, focal, principal[1]], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, size, size)
    random = torch.Generator().manual_seed(0)
    lengths = torch.exp(torch.empty(WAVES).uniform_(*map(math.log, WAVE_LENGTHS), generator=random))
    directions = torch.nn.functional.normalize(torch.randn(3, WAVES, generator=random), dim=0)
    waves = (2 * math.pi * directions / lengths, 2 * math.pi * torch.rand(WAVES, generator=random),
             WAVE_SIZE * torch.randn(WAVES, 3, generator=random))  # fmt: skip
    drawn = _draw(hand, waves, None, posed.vertices, camera)
    pixels = drawn.image + (1 - drawn.alpha)[..., None] * torch.tensor(GROUND)
    photo = Photo((pixels.clamp(0, 1) * 255).round().to(torch.uint8), None, None, "truth.png", 1.0)
    xy, _ = project(camera, hand21(posed, hand))
    landmarks = Landmarks(xy, None, "right", 1.0, 1.0, "truth")
    fit = HandFit("right", shape, pose, camera, landmarks, drawn.alpha, 0.0, 0.0, 1.0, 0.0, ())
    still = torch.zeros_like(hand.template)
    crop = crop_hand(photo, fit, still, ReconstructConfig())
    adapted = adapt(hand, [prior(crop)], [crop], adapt_config(ReconstructConfig(steps=steps)))
    avatar = Avatar(
        side="right", shape=shape, surface_offsets=still, gaussians=adapted.gaussians, source_pose=pose,
        source_camera=crop.camera, light=adapted.light,
    )  # fmt: skip
    return KnownHand(hand, pose, camera, avatar, photo, waves)


def photographed(path: Path) -> KnownHand:
    """A real photo's hand as it was estimated, to paint on; its skin is not known."""
    photo = read_photo(path)
    made = reconstruct(photo)
    return KnownHand(made.avatar.hand, made.fit.pose, made.fit.camera, made.avatar, photo, None)


def _skin(hand: HandModel, waves: tuple[Tensor, Tensor, Tensor], on: Surface) -> Float[Tensor, "H W 3"]:
    shown = on.face_ids >= 0
    fields = torch.cat([region_colors(label_regions(hand), MELANIN), hand.template], 1)
    colors, points = _at(fields, hand.faces, Surface(on.face_ids[shown], on.barycentrics[shown])).split(3, -1)
    picture = torch.zeros(*shown.shape, 3)
    for direction, phase, size in zip(waves[0].T, waves[1], waves[2], strict=True):  # one by one: the picture is large
        colors = colors + torch.sin(points @ direction + phase)[:, None] * size
    picture[shown] = colors
    return picture


class Chart:
    """Paint as a picture in the photo's view, `SAMPLES` times as fine, that the surface carries elsewhere."""

    def __init__(self, known: KnownHand, kind: str):
        self.posed = known.avatar.mesh(known.pose).vertices
        self.camera, self.faces = known.camera, known.hand.faces
        fine = _fine(known.camera)
        seen = depth_map(self.posed, self.faces, fine.viewmat, fine.K, fine.width, fine.height)
        self.front = seen.depth.clamp_max(1e3)
        self.on = Surface(seen.face_ids, seen.barycentrics)
        self.rgba = _paint(known, kind, self)
        """Not multiplied by its alpha, shape [H, W, 4]."""

    def at(self, on: Surface) -> Float[Tensor, "H W 4"]:
        """Paint at points of the surface: what the photo shows there, nothing where it does not show them."""
        points = _at(self.posed, self.faces, on).view(-1, 3)
        shown = (on.face_ids >= 0).view(-1)
        points = torch.where(shown[:, None], points, self.posed.mean(0))
        uv, depth = project(self.camera, points)
        grid = (uv / uv.new_tensor([self.camera.width, self.camera.height]) * 2 - 1)[None, None]
        front = grid_sample(self.front[None, None], grid, mode="nearest", align_corners=False)[0, 0, 0]
        found = grid_sample(self.rgba.permute(2, 0, 1)[None], grid, align_corners=False)[0, :, 0].T
        return torch.where((shown & (depth - front < 0.002))[:, None], found, 0.0).view(*on.face_ids.shape, 4)


def _paint(known: KnownHand, kind: str, chart: Chart) -> Float[Tensor, "H W 4"]:
    hand = known.hand
    if kind == "ring":
        rest = known.avatar.rest
        start, end = rest.joints[RING_FINGER], rest.joints[RING_FINGER + 1]
        along = (rest.vertices - start) @ (end - start) / (end - start).norm()
        on_finger = hand.weights[:, RING_FINGER : RING_FINGER + 3].sum(1)
        position, finger = _at(torch.stack([along, on_finger], 1), hand.faces, chart.on).unbind(-1)
        off = (position - RING_PLACE * (end - start).norm()).abs() / (RING_WIDTH / 2)
        edge = (off > 0.7)[..., None]
        color = torch.where(edge, torch.tensor(DARK_GOLD), torch.tensor(GOLD))
        inside = (off < 1) & (finger > 0.5) & (chart.on.face_ids >= 0)
        return torch.cat([color, inside[..., None].float()], -1)
    if kind == "nail polish":
        inside = (_at(hand.nail[:, None], hand.faces, chart.on)[..., 0] > 0.5) & (chart.on.face_ids >= 0)
        return torch.cat([torch.tensor(POLISH).expand(*inside.shape, 3), inside[..., None].float()], -1)
    uv, depth = project(known.camera, chart.posed[hand.segment == 0].mean(0, keepdim=True))
    millimetre = SAMPLES * float(known.camera.K[0, 0] / depth[0]) * 1e-3
    x, y = (SAMPLES * uv[0]).tolist()
    size = chart.on.face_ids.shape
    drawing = _draw_tattoo if kind == "tattoo" else _draw_writing
    return torch.from_numpy(drawing(size, x, y, millimetre))


def _draw_tattoo(size: tuple[int, int], x: float, y: float, mm: float) -> np.ndarray:
    """A star of 30 mm with a red heart, in a circle of 1 mm."""
    color, star = np.full((*size, 3), INK, np.float32), np.zeros(size, np.uint8)
    tips = [
        (x + (15 if k % 2 == 0 else 6) * mm * math.sin(k * math.pi / 5),
         y - (15 if k % 2 == 0 else 6) * mm * math.cos(k * math.pi / 5)) for k in range(10)
    ]  # fmt: skip
    cv2.fillPoly(star, [np.round(tips).astype(np.int32)], 255, cv2.LINE_AA)
    cv2.circle(star, (round(x), round(y)), round(19 * mm), 255, max(1, round(mm)), cv2.LINE_AA)
    heart = np.zeros(size, np.uint8)
    cv2.circle(heart, (round(x), round(y)), round(4 * mm), 255, -1, cv2.LINE_AA)
    color = color + (heart[..., None] / np.float32(255)) * (np.array(RED, np.float32) - color)
    return np.dstack([color, star / np.float32(255)])


def _draw_writing(size: tuple[int, int], x: float, y: float, mm: float) -> np.ndarray:
    """A word of 36 mm in strokes of 1 mm."""
    lines, text, font = np.zeros(size, np.uint8), "oasis", cv2.FONT_HERSHEY_SIMPLEX
    (width, height), _ = cv2.getTextSize(text, font, 10.0, 1)
    scale = 36 * mm / width
    origin = round(x - 18 * mm), round(y + scale * height / 2)
    cv2.putText(lines, text, origin, font, 10.0 * scale, 255, max(1, round(mm)), cv2.LINE_AA)
    return np.dstack([np.full((*size, 3), INK, np.float32), lines / np.float32(255)])


def _draw(
    hand: HandModel, waves: tuple[Tensor, Tensor, Tensor], chart: Chart | None, vertices: Tensor, camera: Camera
) -> Drawn:
    on = _look(vertices, hand.faces, _fine(camera))
    alpha = (on.face_ids >= 0).float()[..., None]
    color, paint = _skin(hand, waves, on), torch.zeros_like(alpha)
    if chart is not None:
        rgba = chart.at(on)
        paint = rgba[..., 3:]
        color = torch.lerp(color, rgba[..., :3], paint)
    image = _averaged(torch.cat([color.clamp(0, 1) * alpha, alpha, paint], -1))
    return Drawn(image[..., :3], image[..., 3], image[..., 4])


def draw_truth(known: KnownHand, chart: Chart | None, pose: HandPose, camera: Camera) -> Drawn:
    """What the hand with the paint of `chart` looks like."""
    assert known.waves is not None
    return _draw(known.hand, known.waves, chart, known.avatar.mesh(pose).vertices, camera)


def paint_photo(known: KnownHand, chart: Chart) -> Photo:
    """The photo with the paint on it, as an editor would save it."""
    drawn = _averaged(torch.cat([chart.rgba[..., :3] * chart.rgba[..., 3:], chart.rgba[..., 3:]], -1))
    pixels = known.photo.rgb.float() / 255 * (1 - drawn[..., 3:]) + drawn[..., :3]
    return known.photo._replace(rgb=(pixels.clamp(0, 1) * 255).round().to(torch.uint8), name="painted.png")


def encoded(photo: Photo) -> Photo:
    """The photo as a JPEG encoder leaves it."""
    _, data = cv2.imencode(".jpg", photo.rgb.numpy()[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))
    pixels = cv2.cvtColor(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
    return photo._replace(rgb=torch.from_numpy(pixels), name="painted.jpg")


def edited_area(known: KnownHand, paint: Float[Tensor, "H W"], camera: Camera, reach: float) -> Float[Tensor, "H W"]:
    """1 where there is paint, and up to `reach` [m] around it, in a true picture."""
    depth = float((camera.viewmat[:3, :3] @ known.pose.translation + camera.viewmat[:3, 3])[2])
    radius = max(1, round(reach * float(camera.K[0, 0]) / depth))
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return torch.from_numpy(cv2.dilate((paint.numpy() > 0).astype(np.uint8), around)).float()


def other_views(known: KnownHand, size: int) -> dict[str, tuple[HandPose, Camera]]:
    """Poses and views that the photo does not show, but the paint can be seen in."""
    angles = {
        "turned left": ("open", 0.5, 0.0), "turned right": ("open", -0.4, 0.3), "fist": ("fist", 0.2, 0.0),
        "point": ("point", -0.25, -0.2), "rest": ("rest", 0.0, 0.35), "victory": ("victory", 0.3, 0.2),
    }  # fmt: skip
    views = {}
    for name, (gesture, azimuth, elevation) in angles.items():
        pose = known.pose._replace(angles=named_pose(known.hand, gesture))
        views[name] = pose, orbit_camera(known.avatar.mesh(pose).vertices, azimuth, elevation, size)
    return views
