"""The picture that tells at a glance whether a reconstruction is good."""

import itertools
import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.cli.drawing import Panel, Pixels, draw_landmarks, draw_mesh, make_sheet, panel_side
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.surface import vertex_normals
from oasis_warp.core.types import Camera, HandFit, HandPose, Photo, PosedHand
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.fusion import FusedReconstruction
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import CROP_MARGIN, Reconstruction
from oasis_warp.render.cameras import crop_camera, orbit_camera

WIDTH = 1600
GROUND = (0.93, 0.93, 0.92)
"""Behind the avatar."""
VIEWS = 6
POSES = ("open", "fist", "victory", "point", "ok")


def draw_summary(photo: Photo, made: Reconstruction, *, progress: Progress = silent) -> UInt8[Tensor, "H W 3"]:
    """Photo, fit, mask and avatar in the photo's view; six views around; other poses. `WIDTH` pixels wide."""
    fit = made.fit
    measures = [f"landmarks {fit.reprojection:.1f} % off", f"mask overlap {fit.mask_iou:.2f}"]
    if "input_psnr_db" in made.errors:
        measures.append(f"{made.errors['input_psnr_db']:.1f} dB to the photo")
    return _draw(made.avatar, [(photo, fit)], measures, bool(made.warnings), progress)


def draw_fused_summary(
    photos: Sequence[Photo], made: FusedReconstruction, *, progress: Progress = silent
) -> UInt8[Tensor, "H W 3"]:
    """The same with a row for every photo; the avatar is in the light of the first."""
    fits = [photo.fit for photo in made.photos]
    measures = [f"{made.errors['seen_percent']:.0f} % of the surface seen"]
    return _draw(made.avatar, list(zip(photos, fits, strict=True)), measures, bool(made.warnings), progress)


@torch.no_grad()
def _draw(
    avatar: Avatar, photos: Sequence[tuple[Photo, HandFit]], measures: list[str], doubtful: bool, progress: Progress
) -> UInt8[Tensor, "H W 3"]:
    drawn, total = itertools.count(1), len(photos) + VIEWS + len(POSES)

    def draw(camera: Camera, pose: HandPose) -> Pixels:
        picture = to_uint8(avatar.render(camera, pose, GROUND).image).numpy()
        progress("summary", next(drawn), total)
        return picture

    first = photos[0][1]
    side, around = panel_side(VIEWS, WIDTH), avatar.mesh(first.pose).vertices
    views = [
        Panel(draw(orbit_camera(around, 2 * math.pi * k / VIEWS, 0.0, side), first.pose), f"{360 * k // VIEWS}°")
        for k in range(VIEWS)
    ]
    held = {name: avatar.source_pose._replace(angles=named_pose(avatar.hand, name)) for name in POSES}
    reach = torch.cat([avatar.mesh(pose).vertices for pose in held.values()])  # one camera: the poses compare
    camera = orbit_camera(reach, 0.0, 0.0, panel_side(len(POSES), WIDTH))
    poses = [Panel(draw(camera, pose), name) for name, pose in held.items()]
    rows = [photo_row(photo, avatar, fit, draw, panel_side(4, WIDTH)) for photo, fit in photos]
    if doubtful:
        measures = [*measures, "doubtful: see the warnings in report.json"]
    names = ", ".join(photo.name for photo, _ in photos)
    title = f"{names}, {first.side} hand"
    return torch.from_numpy(make_sheet(title, ", ".join(measures), [*rows, views, poses], WIDTH))


def photo_row(
    photo: Photo, avatar: Avatar, fit: HandFit, draw: Callable[[Camera, HandPose], Pixels], size: int
) -> list[Panel]:
    """Crop, fit over it, mask and avatar, all in the photo's view."""
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
        Panel(draw(camera, fit.pose), "avatar, the photo's view"),
    ]


def shade_mesh(
    posed: PosedHand, faces: Tensor, camera: Camera
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Brightness of the posed surface under a light at the camera, and where it is (1 inside, 0 outside)."""
    vertices = posed.vertices.cpu()
    faces = faces.cpu()
    seen = depth_map(vertices, faces, camera.viewmat.to(vertices), camera.K.to(vertices), camera.width, camera.height)
    inside = seen.face_ids >= 0
    normals = vertex_normals(vertices, faces) @ camera.viewmat[:3, :3].to(vertices).T
    corners = normals[faces[seen.face_ids.clamp_min(0).long()]]
    facing = normalize((corners * seen.barycentrics[..., None]).sum(-2), dim=-1)[..., 2].abs()
    return torch.where(inside, 0.35 + 0.65 * facing, 0.0), inside.to(vertices)
