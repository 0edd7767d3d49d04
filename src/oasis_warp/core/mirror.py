"""Left hands as right ones: the mirror x -> -x, for every noun that it applies to.

With M = diag(-1, 1, 1), a left hand in the pose (R, t) is the mirrored model M v in that pose. In the mirrored photo it
is the right hand in the pose (M R M, M t): skinning M v by (M R M, M t) gives M times skinning v by (R, t). Joint
angles stay, because they turn about axes that are mirrored with the model. A pixel column x becomes width - x. Every
function here is its own inverse.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import (
    Camera,
    CanonicalGaussians,
    HandFit,
    HandLight,
    HandPose,
    Landmarks,
    SurfaceReading,
)

MIRROR = (-1.0, 1.0, 1.0)
"""Diagonal of M."""
ODD_IN_X = (1, 4, 7)
"""Rows of `HandLight.harmonics` that change sign: x, xy and xz."""


def mirror_points(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Points or directions in the mirrored world."""
    return points * points.new_tensor(MIRROR)


def mirror_images(images: Float[Tensor, "B H W *C"], where: Bool[Tensor, "B"]) -> Float[Tensor, "B H W *C"]:
    """Mirror those images of a batch for which `where` is true."""
    return torch.where(where.view(-1, *[1] * (images.dim() - 1)), images.flip(2), images)


def mirror_pixels(xy: Float[Tensor, "*batch 2"], width: int) -> Float[Tensor, "*batch 2"]:
    """Image points of a photo of `width` pixels in its mirror image [px]."""
    return torch.stack([width - xy[..., 0], xy[..., 1]], -1)


def mirror_pose(pose: HandPose) -> HandPose:
    """The pose whose right hand is the mirror image of this one's left hand, or the other way round."""
    mirror = pose.orientation.new_tensor(MIRROR)
    return HandPose(
        angles=pose.angles,
        orientation=mirror[:, None] * pose.orientation * mirror,
        translation=mirror_points(pose.translation),
    )


def mirror_camera(camera: Camera) -> Camera:
    """The camera that sees the mirrored world as the mirror image of what `camera` sees."""
    K = camera.K.clone()
    K[0, 2] = camera.width - K[0, 2]
    mirror = torch.diag(K.new_tensor((*MIRROR, 1.0)))
    return Camera(mirror @ camera.viewmat @ mirror, K, camera.width, camera.height)


def mirror_landmarks(landmarks: Landmarks, width: int) -> Landmarks:
    """The landmarks of the other hand in the mirror image of a photo of `width` pixels."""
    return landmarks._replace(
        xy=mirror_pixels(landmarks.xy, width),
        world=None if landmarks.world is None else mirror_points(landmarks.world),
        side="right" if landmarks.side == "left" else "left",
    )


def mirror_reading(reading: SurfaceReading, width: int) -> SurfaceReading:
    """The reading of the mirror image of a photo of `width` pixels; places stay, which are on the right hand."""
    left = width - reading.left - reading.side
    planes = (plane.flip(1) for plane in (reading.places, reading.spread, reading.albedo))
    return SurfaceReading(*planes, left, reading.top, reading.side)


def as_right_hand(fit: HandFit) -> HandFit:
    """`fit` itself for a right hand; for a left one the fit of the right hand in the mirrored photo."""
    if fit.side == "right":
        return fit
    return fit._replace(
        side="right",
        pose=mirror_pose(fit.pose),
        camera=mirror_camera(fit.camera),
        landmarks=mirror_landmarks(fit.landmarks, fit.camera.width),
        mask=fit.mask.flip(1),
        reading=None if fit.reading is None else mirror_reading(fit.reading, fit.camera.width),
    )


def mirror_hand(hand: HandModel) -> HandModel:
    """The other hand: posed like `hand` by the same angles, it is the mirror image of `hand` in the mirrored pose.

    Points and displacements are mirrored. The axes of the angles are mirrored and reversed, because a mirror reverses
    rotations. Faces keep their corners, and so wind the other way.
    """

    def mirrored(displacements: Tensor) -> Tensor:
        return mirror_points(displacements.mT).mT.contiguous()

    return dataclasses.replace(
        hand,
        template=mirror_points(hand.template),
        shape_basis=mirrored(hand.shape_basis),
        joints=mirror_points(hand.joints),
        joint_basis=mirrored(hand.joint_basis),
        tips=mirror_points(hand.tips),
        tip_basis=mirrored(hand.tip_basis),
        pose_axes=-mirror_points(hand.pose_axes),
        corrective_basis=mirrored(hand.corrective_basis),
    )


def mirror_canonical(canonical: CanonicalGaussians) -> CanonicalGaussians:
    """The same Gaussians on the mirrored surface: a rotation (w, x, y, z) becomes (w, x, -y, -z)."""
    return canonical._replace(
        offsets=mirror_points(canonical.offsets),
        quats=canonical.quats * canonical.quats.new_tensor([1.0, 1.0, -1.0, -1.0]),
    )


def mirror_light(light: HandLight) -> HandLight:
    """The same light in the mirrored world."""
    flips = torch.ones_like(light.harmonics[:, :1])
    flips[[k for k in ODD_IN_X if k < len(flips)]] = -1
    facing = None if light.facing is None else mirror_points(light.facing)
    return light._replace(harmonics=flips * light.harmonics, facing=facing)
