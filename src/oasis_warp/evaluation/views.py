"""The pictures by which looks are judged: the photo's view, eight sides and eight poses, and what each pixel shows."""

import math
from typing import Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.observation import facing, inner_mask, observe
from oasis_warp.avatar.wrist import ARM_GROWTH, ARM_LENGTH, rim_axis
from oasis_warp.core.camera import camera_center, crop_camera, project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.surface import face_normals
from oasis_warp.core.types import Camera, HandCrop, HandPose, Render
from oasis_warp.core.windows import largest_around
from oasis_warp.estimation.hand_crop import CROP_MARGIN
from oasis_warp.evaluation.band_energy import SIZE
from oasis_warp.hand.poses import POSE_NAMES
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map

FINE = 2
"""Pictures are drawn so many times as large as they are measured."""
DRAWN_SIZE = FINE * SIZE
"""Side of the pictures that are looked at [px]."""
GROUND = (0.93, 0.93, 0.92)
"""Colour behind the hand."""
AZIMUTHS = tuple(range(0, 360, 45))
"""Azimuths of the sides [degrees]: 0 is the side of the photo."""
POSES = POSE_NAMES[1:]
"""All named ones but rest, which is nearly that of relaxed."""
RIM = 4
"""Pixels at outlines that are not judged: the mask of a photo is some two pixels off, and the fit as much."""
JUMP = 0.005
"""Difference of the depth of neighbouring pixels that makes an outline inside the hand [m]: half a finger."""

BESIDE = 2
"""Pixels around the mesh that belong to the hand and not to its arm."""
WRIST_REACH = 0.015
"""Distance from the wrist's opening within which a hand ends [m]: opacity fades over 8 mm before it, and the skin
is rounded over 8 mm past it."""

Kind = Literal["input", "side", "pose", "back"]


class View(NamedTuple):
    """A picture to be drawn."""

    kind: Kind
    name: str
    """Azimuth in degrees, or a pose."""
    camera: Camera
    pose: HandPose


class Surface(NamedTuple):
    """What the pixels of a picture of `SIZE` show of the posed mesh."""

    silhouette: Bool[Tensor, "S S"]
    interior: Bool[Tensor, "S S"]
    """The skin's outside, farther than `RIM` from all outlines, those of fingers before the hand included."""
    visibility: Float[Tensor, "S S"]
    """1 where the avatar's photo shows this skin well, 0 where it does not."""
    palm: Float[Tensor, "S S"]
    """1 on the palm's side, 0 on the back."""


def views_of(avatar: Avatar) -> list[View]:
    """The photo's view, the source pose from eight sides, eight poses from the photo's side, the open hand from behind.

    All but the first are framed as crops of photos are: squares around the hand with the same margin.
    """
    pose, source = avatar.source_pose, avatar.source_camera
    views = [View("input", "photo", crop_camera(source, 0.0, 0.0, float(source.width), DRAWN_SIZE), pose)]
    views += [View("side", str(degrees), frame(avatar, pose, float(degrees)), pose) for degrees in AZIMUTHS]
    held = {name: avatar.held(name) for name in POSES}
    views += [View("pose", name, frame(avatar, each, 0.0), each) for name, each in held.items()]
    return [*views, View("back", "open", frame(avatar, held["open"], 180.0), held["open"])]


def frame(avatar: Avatar, pose: HandPose, degrees: float) -> Camera:
    """A camera from the side `degrees` that frames the posed hand as `crop_hand` frames a photo's."""
    camera = avatar.orbit_camera(pose, math.radians(degrees), size=DRAWN_SIZE)
    xy, _ = project(camera, avatar.mesh(pose).vertices)
    low, high = xy.amin(0), xy.amax(0)
    side = CROP_MARGIN * float((high - low).max())
    left, top = ((low + high - side) / 2).tolist()
    return crop_camera(camera, left, top, side, DRAWN_SIZE)


def shrink(planes: Float[Tensor, "H W *C"]) -> Float[Tensor, "h w *C"]:
    """A drawn picture at the size in which it is measured: means of blocks."""
    flat = planes.reshape(*planes.shape[:2], -1).permute(2, 0, 1)
    return avg_pool2d(flat, FINE).permute(1, 2, 0).reshape(SIZE, SIZE, *planes.shape[2:])


@torch.no_grad()
def draw(avatar: Avatar, view: View) -> Render:
    """The picture of `DRAWN_SIZE` over `GROUND`."""
    return avatar.render(view.camera, view.pose, GROUND)


@torch.no_grad()
def read_surface(
    hand: HandModel, vertices: Float[Tensor, "V 3"], camera: Camera, visibility: Float[Tensor, "V"],
    palm: Float[Tensor, "V"], *, left: bool = False,
) -> Surface:  # fmt: skip
    """What `camera`, whatever its size, sees of the posed mesh in a picture of `SIZE`; faces of a left hand wind back.

    The inside of the open wrist is no skin.
    """
    small, faces = crop_camera(camera, 0.0, 0.0, float(camera.width), SIZE), hand.faces.to(vertices.device)
    seen = depth_map(vertices, faces, small.viewmat.to(vertices), small.K.to(vertices), SIZE, SIZE)
    silhouette, ids = seen.face_ids >= 0, seen.face_ids.clamp_min(0).long()
    values = torch.stack([visibility.to(vertices), palm.to(vertices)], -1)[faces[ids]]
    shown, side = (values * seen.barycentrics[..., None]).sum(-2).unbind(-1)
    normals, _ = face_normals(vertices, faces)
    outside = facing(vertices[faces].mean(1), -normals if left else normals, small.viewmat.to(vertices))[ids] > 0
    return Surface(silhouette, silhouette & outside & clear_of_outlines(seen.depth), shown, side)


def read_crop(crop: HandCrop) -> Surface:
    """What a photo's crop of `SIZE` shows, its interior that of mesh and mask together."""
    hand = bundled_hand()
    seen = observe(hand, crop).confidence
    surface = read_surface(hand, crop.posed.vertices, crop.camera, seen, label_regions(hand).palm)
    mask = (inner_mask(crop.mask, RIM) > 0.5) & (crop.above_wrist > 0.5)
    return surface._replace(interior=surface.interior & mask)


def silhouette(faces: Int[Tensor, "F 3"], vertices: Float[Tensor, "V 3"], camera: Camera) -> Bool[Tensor, "H W"]:
    """Whether `camera` sees the mesh in each pixel."""
    size = camera.width, camera.height
    return depth_map(vertices, faces, camera.viewmat.to(vertices), camera.K.to(vertices), *size,
                     outputs=("face_ids",)).face_ids >= 0  # fmt: skip


def wrist_end(hand: HandModel, vertices: Float[Tensor, "V 3"], camera: Camera) -> Bool[Tensor, "H W"]:
    """Pixels within `WRIST_REACH` of the opening of the wrist and of the arm that fades from there."""
    index = hand.rim.to(vertices.device)
    edge, arm = vertices[index], ARM_LENGTH * rim_axis(vertices, index)
    rim = torch.cat([edge, edge + arm + ARM_GROWTH * (edge - edge.mean(0))])
    viewed = Camera(camera.viewmat.to(rim), camera.K.to(rim), camera.width, camera.height)
    xy, depth = project(viewed, rim)
    plane = np.zeros((camera.height, camera.width), np.uint8)
    hull = cv2.convexHull(xy.cpu().numpy().astype(np.float32)).round().astype(np.int32)
    cv2.fillConvexPoly(plane, hull, 1)
    reach = math.ceil(WRIST_REACH * float(viewed.K[0, 0] / depth.mean()))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return torch.from_numpy(cv2.dilate(plane, disc) > 0)


def without_arm(hand: HandModel, drawn: Render, vertices: Float[Tensor, "V 3"], camera: Camera) -> Render:
    """A picture over `GROUND` without the arm, which photos of hands are cut out without, too."""
    on_hand = silhouette(hand.faces, vertices, camera).float()
    kept = largest_around(on_hand, BESIDE) > 0
    arm = (wrist_end(hand, vertices, camera) & ~kept)[..., None]
    ground = drawn.image.new_tensor(GROUND)
    return Render(torch.where(arm, ground, drawn.image), drawn.alpha.masked_fill(arm[..., 0], 0))


def clear_of_arm(hand: HandModel, surface: Surface, vertices: Float[Tensor, "V 3"], camera: Camera) -> Surface:
    """`surface` without the interior that lies behind the arm, where that comes towards the camera."""
    rim = hand.rim.to(vertices.device)
    toward = camera_center(camera.viewmat.to(vertices)) - vertices[rim].mean(0)
    if float(toward @ rim_axis(vertices, rim)) <= 0:
        return surface
    small = crop_camera(camera, 0.0, 0.0, float(camera.width), SIZE)
    return surface._replace(interior=surface.interior & ~wrist_end(hand, vertices, small))


def clear_of_outlines(depth: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels with no jump of the depth within `RIM`; `depth` is infinite beside the surface."""
    plane = depth.clamp_max(1e3)[None, None]
    jumps = max_pool2d(plane, 3, 1, 1) + max_pool2d(-plane, 3, 1, 1) > JUMP
    return inner_mask((~jumps[0, 0]).to(depth), RIM - 1) > 0.5
