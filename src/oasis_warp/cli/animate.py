"""`oasis animate`: a video of an avatar."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from rich.console import Console
from torch import Tensor

from oasis_warp.cli.console import show_progress
from oasis_warp.cli.options import Animate
from oasis_warp.cli.render import check_numbers, choose_pose, load_avatar, read_color, straight_alpha
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress
from oasis_warp.core.types import Color, HandPose
from oasis_warp.data.films import check_film, write_video
from oasis_warp.data.motion_file import read_motion, resample
from oasis_warp.data.pictures import to_uint8
from oasis_warp.hand.poses import POSE_NAMES, pose_sequence
from oasis_warp.hand_avatar import Avatar
from oasis_warp.render.render import render

MAX_FRAMES = 10_000
MOST_LOOPS = 65_535
"""What a GIF can count to."""
MOST_FRAMED = 60
"""About so many poses of a film decide what its camera sees."""


@torch.no_grad()
def turntable(
    avatar: Avatar,
    pose: HandPose,
    n_frames: int,
    size: int,
    *,
    elevation: float,
    background: Color | None,
    progress: Progress,
) -> Iterator[UInt8[Tensor, "size size C"]]:
    """`n_frames` views around the hand in `pose`, from the photo's view on, `elevation` [rad] above the hand."""
    gaussians, vertices = avatar.pose(pose), avatar.mesh(pose).vertices
    for frame in range(n_frames):
        camera = orbit_camera(vertices, 2 * math.pi * frame / n_frames, elevation, size)
        drawn = render(gaussians, camera, background=BLACK if background is None else background)
        yield to_uint8(drawn.image if background is not None else straight_alpha(drawn))
        progress("turntable", frame + 1, n_frames)


@torch.no_grad()
def pose_frames(
    avatar: Avatar,
    angles: Sequence[Float[Tensor, "15 3"]],
    size: int,
    *,
    elevation: float,
    background: Color | None,
    progress: Progress,
) -> Iterator[UInt8[Tensor, "size size C"]]:
    """A frame for each of the joint `angles`, from the direction of the photo; transparent without a `background`.

    The camera does not move and sees the hand completely in every frame.
    """
    poses = [avatar.source_pose._replace(angles=each.to(avatar.shape)) for each in angles]
    few = poses[:: max(1, len(poses) // MOST_FRAMED)]
    camera = orbit_camera(torch.cat([avatar.mesh(pose).vertices for pose in few]), 0.0, elevation, size)
    for frame, pose in enumerate(poses):
        drawn = avatar.render(camera, pose, BLACK if background is None else background)
        yield to_uint8(drawn.image if background is not None else straight_alpha(drawn))
        progress("poses", frame + 1, len(poses))


def run(options: Animate) -> int:
    """Write the film.

    Raises:
        InputError: a wrong avatar file, motion, option or output.
    """
    check_numbers(options)
    transparent = options.background == "transparent"
    check_film(options.out, transparent=transparent)
    background = None if transparent else read_color(options.background)
    if not 0 <= options.loop <= MOST_LOOPS:
        raise InputError(f"--loop {options.loop}: expected 0, for ever, to {MOST_LOOPS}; choose another number.")
    n_frames = count_frames(options.seconds, options.fps)
    names = read_names(options.poses)
    motion = read_motion(options.motion) if isinstance(options.motion, Path) else None
    avatar = load_avatar(options)
    with show_progress(Console(stderr=True)) as progress:
        look = {"elevation": math.radians(options.elevation), "background": background, "progress": progress}
        if options.motion == "turntable":
            frames = turntable(avatar, choose_pose(avatar, options.pose), n_frames, options.size, **look)
        elif motion is None:
            angles = pose_sequence(avatar.hand, names, max(1, round(n_frames / len(names))))
            frames = pose_frames(avatar, angles, options.size, **look)
        else:
            angles = resample(motion, options.fps)
            count_frames(len(angles) / options.fps, options.fps)
            frames = pose_frames(avatar, angles, options.size, **look)
        write_video(options.out, frames, options.fps, loops=options.loop)
    print(f"written: {options.out}")
    return 0


def count_frames(seconds: float, fps: float) -> int:
    """Number of frames of a video.

    Raises:
        InputError: a rate or length out of range.
    """
    if not 1 <= fps <= 120:
        raise InputError(f"--fps {fps:g}: expected 1 to 120 frames a second; choose another rate.")
    if not 1 <= seconds * fps <= MAX_FRAMES:
        raise InputError(f"--seconds {seconds:g}: expected 1 to {MAX_FRAMES} frames, got {seconds * fps:g}; change it.")
    return round(seconds * fps)


def read_names(text: str) -> list[str]:
    """Split `text` at commas into pose names.

    Raises:
        InputError: none, or an unknown one.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in POSE_NAMES]
    if unknown or not names:
        got = ", ".join(unknown) or "none"
        raise InputError(f"--poses {text}: expected names out of {', '.join(POSE_NAMES)}, got {got}; choose others.")
    return names
