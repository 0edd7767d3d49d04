"""The frames of a film: once around a hand, or through poses."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import UInt8
from torch import Tensor

from oasis_warp.core.config import Color
from oasis_warp.core.logging import Progress
from oasis_warp.core.types import HandPose
from oasis_warp.data.pictures import to_uint8
from oasis_warp.hand.poses import pose_sequence
from oasis_warp.hand_avatar import Avatar
from oasis_warp.render.cameras import orbit_camera
from oasis_warp.render.render import render


@torch.no_grad()
def turntable(
    avatar: Avatar, pose: HandPose, n_frames: int, size: int, *, elevation: float, background: Color, progress: Progress
) -> Iterator[UInt8[Tensor, "size size 3"]]:
    """`n_frames` views all around the hand in `pose`, the photo's own first, from `elevation` [rad] above."""
    gaussians, vertices = avatar.pose(pose), avatar.mesh(pose).vertices
    for frame in range(n_frames):
        camera = orbit_camera(vertices, 2 * math.pi * frame / n_frames, elevation, size)
        yield to_uint8(render(gaussians, camera, background=background).image)
        progress("turntable", frame + 1, n_frames)


@torch.no_grad()
def pose_film(
    avatar: Avatar,
    names: Sequence[str],
    n_frames: int,
    size: int,
    *,
    elevation: float,
    background: Color,
    progress: Progress,
) -> Iterator[UInt8[Tensor, "size size 3"]]:
    """About `n_frames` frames through the named poses and back to the first, from where the photo was taken.

    The camera stands still where it sees all of the poses whole.
    """
    steps = max(1, round(n_frames / len(names)))
    poses = [avatar.source_pose._replace(angles=angles) for angles in pose_sequence(avatar.hand, names, steps)]
    reach = torch.cat([avatar.mesh(pose).vertices for pose in poses[:: max(1, steps // 2)]])
    camera = orbit_camera(reach, 0.0, elevation, size)
    for frame, pose in enumerate(poses):
        yield to_uint8(avatar.render(camera, pose, background).image)
        progress("poses", frame + 1, len(poses))
