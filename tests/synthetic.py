"""A hand with known colours, seen by a known camera: crop whose truth the tests know."""

import torch

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.mirror import mirror_camera, mirror_pose
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand_avatar import Avatar
from oasis_warp.render import render

PALM_TO_CAMERA = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # fingers up, thumb to the right
BACK_TO_CAMERA = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])


def posed_hand(hand, pose_name="open", orientation=PALM_TO_CAMERA):
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))
    pose = HandPose(named_pose(hand, pose_name), orientation, torch.tensor([0.0, 0.0, 0.5]))
    return rest, pose, skin(hand, rest, pose)


def crop_of(hand, vertex_colors, size=96, **pose) -> tuple[HandCrop, CanonicalGaussians, HandPose]:
    """What a camera sees of a hand with the given colours, the true Gaussians and the pose."""
    rest, hand_pose, posed = posed_hand(hand, **pose)
    anchors = place_anchors(hand, rest)
    truth = anchors.with_colors(vertex_to_gaussians(vertex_colors, hand.faces, anchors))
    camera = orbit_camera(posed.vertices, 0.0, size=size)
    drawn = render(pose_gaussians(truth, hand.faces, rest.vertices, posed.vertices), camera)
    return HandCrop(drawn.image, drawn.alpha, torch.ones_like(drawn.alpha), camera, rest, posed), truth, hand_pose


def avatar_of(hand, gaussians, pose, camera, light=None):
    """A right hand of mean shape, on the device of the camera."""
    device = camera.K.device
    return Avatar(
        side="right", shape=torch.zeros(len(hand.shape_names), device=device),
        surface_offsets=torch.zeros_like(hand.template, device=device),
        gaussians=gaussians, source_pose=pose, source_camera=camera, light=light,
        hand=hand,
    )  # fmt: skip


def with_invented(avatar, share):
    """The same hand of which a `share` of each vertex is invented."""
    return Avatar(
        side=avatar.side, shape=avatar.shape, surface_offsets=avatar.surface_offsets, gaussians=avatar.gaussians,
        source_pose=avatar.source_pose, source_camera=avatar.source_camera, light=avatar.light, invented=share,
        hand=avatar.hand,
    )  # fmt: skip


def as_left_hand(right):
    """The left hand that is the mirror image of a right one."""
    return Avatar(
        side="left", shape=right.shape, surface_offsets=right.surface_offsets, gaussians=right.gaussians,
        source_pose=mirror_pose(right.source_pose), source_camera=mirror_camera(right.source_camera),
        light=right.light, hand=right.hand,
    )  # fmt: skip
