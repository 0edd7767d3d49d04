"""Draw summary.png and quality.png, which show at a glance whether a reconstruction is good; with OpenCV."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.quality import SEEN, SurfaceQuality
from oasis_warp.core.camera import crop_camera, orbit_camera
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.surface import vertex_normals
from oasis_warp.core.types import Camera, HandFit, HandPose, Photo, PosedHand
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.estimation.hand_crop import CROP_MARGIN
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import FusedReconstruction, Reconstruction

Pixels = np.ndarray
"""RGB, uint8, shape [H, W, 3]."""

PAPER, INK, FAINT = (246, 246, 244), (34, 36, 40), (120, 122, 128)
OUTLINE = (255, 255, 255)
FINGER_COLORS = ((236, 112, 99), (244, 176, 66), (98, 186, 112), (82, 152, 222), (166, 118, 214))
"""Thumb to little finger."""
MARGIN, GAP, CAPTION, TITLE = 24, 12, 26, 44
"""Spacing of a sheet [px]."""
WIDTH = 1600
"""Width of a summary [px]."""
GROUND = (0.93, 0.93, 0.92)
"""Colour behind the avatar."""
VIEWS = 6
POSES = ("open", "fist", "victory", "point", "ok")
SEEN_COLOR, GRAZED_COLOR, UNSEEN_COLOR = (0.30, 0.66, 0.42), (0.95, 0.76, 0.27), (0.62, 0.64, 0.68)


class Panel(NamedTuple):
    """A square picture with a few words under it."""

    pixels: Pixels
    caption: str


def write_text(sheet: Pixels, text: str, x: int, y: int, size: int, color: tuple[int, int, int], weight: int) -> None:
    """Write `text` with its baseline at `y`, in the font that OpenCV carries."""
    cv2.putText(sheet, text, (x, y), color, cv2.FontFace("sans"), size, weight)


def draw_landmarks(pixels: Pixels, points: np.ndarray) -> Pixels:
    """Draw the 21 landmarks and lines between them, with one colour per finger."""
    drawn = pixels.copy()
    width = max(1, round(pixels.shape[0] / 180))

    def place(point: np.ndarray) -> tuple[int, int]:
        return round(float(point[0]) * 16), round(float(point[1]) * 16)  # OpenCV's fixed point: 4 bits

    for finger, color in enumerate(FINGER_COLORS):
        chain = points[[0, *range(4 * finger + 1, 4 * finger + 5)]]
        for a, b in itertools.pairwise(chain):
            cv2.line(drawn, place(a - 0.5), place(b - 0.5), color, width, cv2.LINE_AA, 4)
        for point in chain[1:]:
            cv2.circle(drawn, place(point - 0.5), 24 * width, color, -1, cv2.LINE_AA, 4)
    cv2.circle(drawn, place(points[0] - 0.5), 24 * width, OUTLINE, -1, cv2.LINE_AA, 4)
    return drawn


def draw_mesh(pixels: Pixels, shade: np.ndarray, inside: np.ndarray, opacity: float = 0.55) -> Pixels:
    """Blend a shaded surface (`shade` in [0, 1] where `inside`) over a picture, with its outline."""
    grey = (np.array((150, 178, 210)) * shade[..., None]).clip(0, 255)
    blend = np.where(inside[..., None], opacity * grey + (1 - opacity) * pixels, pixels).round().astype(np.uint8)
    edges, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(blend, edges, -1, OUTLINE, max(1, pixels.shape[0] // 260), cv2.LINE_AA)


def panel_side(n_panels: int, width: int) -> int:
    """Side of each of `n_panels` panels in a row of a sheet that is `width` pixels wide."""
    return (width - 2 * MARGIN - GAP * (n_panels - 1)) // n_panels


def make_sheet(title: str, subtitle: str, rows: Sequence[Sequence[Panel]], width: int) -> Pixels:
    """Arrange rows of square panels on a sheet; see `panel_side` for their sizes."""
    sides = [panel_side(len(row), width) for row in rows]
    height = 2 * MARGIN + TITLE + sum(side + CAPTION + GAP for side in sides) - GAP
    sheet = np.full((height, width, 3), PAPER, np.uint8)
    place = (MARGIN, MARGIN + 22)
    write_text(sheet, title, *place, 24, INK, 600)
    left, _, length, _ = cv2.getTextSize((width, height), title, place, cv2.FontFace("sans"), 24, 600)
    write_text(sheet, subtitle, left + length + 20, place[1], 17, FAINT, 400)
    top = MARGIN + TITLE
    for row, side in zip(rows, sides, strict=True):
        for column, panel in enumerate(row):
            left = MARGIN + round(column * (width - 2 * MARGIN + GAP) / len(row))
            sheet[top : top + side, left : left + side] = panel.pixels
            write_text(sheet, panel.caption, left + 1, top + side + 19, 15, FAINT, 400)
        top += side + CAPTION + GAP
    return sheet


@torch.no_grad()
def draw_summary(
    photos: Sequence[Photo], made: Reconstruction | FusedReconstruction, *, progress: Progress = silent
) -> UInt8[Tensor, "H W 3"]:
    """A row for every photo with fit, mask and avatar, then views around the avatar, then other poses."""
    avatar = made.avatar
    if isinstance(made, Reconstruction):
        fits, fit = [made.fit], made.fit
        measures = [f"reprojection error {fit.reprojection:.1f} %", f"mask IoU {fit.mask_iou:.2f}"]
        if "input_psnr_db" in made.errors:
            measures.append(f"PSNR {made.errors['input_psnr_db']:.1f} dB")
    else:
        fits = [photo.fit for photo in made.photos]
        measures = [f"{made.errors['seen_percent']:.0f} % of the surface seen"]
    drawn, total = itertools.count(1), len(photos) + VIEWS + len(POSES)

    def draw(camera: Camera, pose: HandPose) -> Pixels:
        picture = to_uint8(avatar.render(camera, pose, GROUND).image).numpy()
        progress("summary", next(drawn), total)
        return picture

    first = fits[0]
    side = panel_side(VIEWS, WIDTH)
    cameras = [avatar.orbit_camera(first.pose, 2 * math.pi * k / VIEWS, size=side) for k in range(VIEWS)]
    views = [Panel(draw(camera, first.pose), f"{360 * k // VIEWS}°") for k, camera in enumerate(cameras)]
    held = {name: avatar.held(name) for name in POSES}
    # All poses share one camera, so that they can be compared.
    reach = torch.cat([avatar.mesh(pose).vertices for pose in held.values()])
    camera = orbit_camera(reach, 0.0, 0.0, panel_side(len(POSES), WIDTH))
    poses = [Panel(draw(camera, pose), name) for name, pose in held.items()]
    side = panel_side(4, WIDTH)
    rows = [photo_row(photo, avatar, fit, draw, side) for photo, fit in zip(photos, fits, strict=True)]
    if made.warnings:
        measures = [*measures, "warnings: see report.json"]
    title = f"{', '.join(photo.name for photo in photos)}, {first.side} hand"
    return torch.from_numpy(make_sheet(title, ", ".join(measures), [*rows, views, poses], WIDTH))


def photo_row(
    photo: Photo, avatar: Avatar, fit: HandFit, draw: Callable[[Camera, HandPose], Pixels], size: int
) -> list[Panel]:
    """Panels in the photo's view: the crop, the fit over it, the mask and the avatar."""
    left, top, side = square_around(fit.mask, CROP_MARGIN)
    camera = crop_camera(fit.camera, left, top, side, size)
    rgb = photo.rgb.float() / 255
    beyond = 1 - resample_square(torch.ones(rgb.shape[:2]), left, top, side, size)[..., None]
    crop = to_uint8(resample_square(rgb, left, top, side, size) + beyond * torch.tensor(GROUND)).numpy()
    mask = resample_square(fit.mask.contiguous(), left, top, side, size).clamp(0, 1)
    shade, inside = shade_mesh(avatar.mesh(fit.pose), avatar.hand.faces, camera)
    fitted = draw_mesh(crop, shade.numpy(), inside.numpy())
    points = (fit.landmarks.xy - torch.tensor([left, top])) * (size / side)
    return [
        Panel(crop, "photo"),
        Panel(draw_landmarks(fitted, points.cpu().numpy()), "landmarks and fitted hand"),
        Panel(to_uint8(mask[..., None].expand(-1, -1, 3)).numpy(), "mask"),
        Panel(draw(camera, fit.pose), "avatar, view of the photo"),
    ]


def shade_mesh(posed: PosedHand, faces: Tensor, camera: Camera) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Brightness of the posed surface under a light at the camera, and its mask (1 inside, 0 outside)."""
    vertices = posed.vertices.cpu()
    faces = faces.cpu()
    seen = depth_map(vertices, faces, camera.viewmat.to(vertices), camera.K.to(vertices), camera.width, camera.height)
    inside = seen.face_ids >= 0
    normals = vertex_normals(vertices, faces) @ camera.viewmat[:3, :3].to(vertices).T
    corners = normals[faces[seen.face_ids.clamp_min(0).long()]]
    facing = normalize((corners * seen.barycentrics[..., None]).sum(-2), dim=-1)[..., 2].abs()
    return torch.where(inside, 0.35 + 0.65 * facing, 0.0), inside.to(vertices)


@torch.no_grad()
def draw_quality(title: str, avatar: Avatar, quality: SurfaceQuality) -> UInt8[Tensor, "H W 3"]:
    """Draw visibility and uncertainty on the hand in the first photo's pose, from its side and from behind."""
    side = panel_side(4, WIDTH)
    posed = PosedHand(*(part.cpu() for part in avatar.mesh(avatar.source_pose)))
    faces, visibility = avatar.hand.faces.cpu(), quality.visibility.cpu()
    shown = torch.tensor(UNSEEN_COLOR).repeat(len(visibility), 1)
    shown[visibility > 0] = torch.tensor(GRAZED_COLOR)
    shown[visibility >= SEEN] = torch.tensor(SEEN_COLOR)
    panels = [
        Panel(_paint(posed, faces, colors, orbit_camera(posed.vertices, azimuth, size=side)), f"{what}, {where}")
        for what, colors in (("visibility", shown), ("uncertainty", _heat(quality.uncertainty)))
        for where, azimuth in (("from the photo's side", 0.0), ("from behind", math.pi))
    ]  # fmt: skip
    unseen = "unseen" if quality.invented is None else "inpainted"
    subtitle = (
        f"visibility: green is seen, yellow at grazing angles, grey {unseen}; "
        "uncertainty: blue is as in the photo, yellow is guessed"
    )
    return torch.from_numpy(make_sheet(title, subtitle, [panels], WIDTH))


def _heat(values: Float[Tensor, "V"]) -> Float[Tensor, "V 3"]:
    bytes_ = (values.cpu().clamp(0, 1) * 255).round().byte().numpy()[:, None]
    return torch.from_numpy(cv2.applyColorMap(bytes_, cv2.COLORMAP_CIVIDIS)[:, 0, ::-1].astype(np.float32) / 255)


def _paint(posed: PosedHand, faces: Tensor, colors: Float[Tensor, "V 3"], camera: Camera) -> Pixels:
    """Render the surface with vertex colours and weak shading that shows its shape."""
    seen = depth_map(posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    shade, inside = shade_mesh(posed, faces, camera)
    own = (colors[faces[seen.face_ids.clamp_min(0).long()]] * seen.barycentrics[..., None]).sum(-2)
    picture = torch.where(inside[..., None] > 0, own * (0.4 + 0.6 * shade)[..., None], torch.tensor(GROUND))
    return (picture.clamp(0, 1) * 255).round().byte().numpy()
