"""`oasis animate`: a film of an avatar, or of two in one scene."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import UInt8
from torch import Tensor

from oasis_warp.avatar.wrist import hand_up
from oasis_warp.cli.options import Animate
from oasis_warp.cli.progress import Terminal, show_progress
from oasis_warp.cli.record import written
from oasis_warp.cli.render import check_numbers, choose_pose, load_avatar, read_color, straight_alpha
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK
from oasis_warp.core.errors import InputError, did_you_mean
from oasis_warp.core.logging import Progress
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.core.types import Camera, Color, Gaussians, HandPose
from oasis_warp.data.json_text import read_cameras
from oasis_warp.data.pictures import check_video, to_uint8, write_video
from oasis_warp.hand.poses import POSE_NAMES, pose_sequence
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion import read_motion, resample
from oasis_warp.render import render

MAX_FRAMES = 10_000
MOTIONS = ("turntable", "poses")
MAX_LOOPS = 65_535
"""What a GIF can count to."""
MAX_FRAMED = 60
"""About so many poses of a film decide what its camera sees."""
GAP = 0.03
"""Between two hands that stand side by side [m]: a finger's breadth and a half."""


@torch.no_grad()
def draw_frames(
    hands: Sequence[tuple[Avatar, Sequence[HandPose]]],
    cameras: Sequence[Camera],
    *,
    background: Color | None,
    progress: Progress,
    stage: str,
) -> Iterator[UInt8[Tensor, "H W C"]]:
    """A frame for each of the `cameras` and of the poses of every hand; transparent without a `background`.

    A hand is not posed again while it keeps its pose and no other share of the photo's shade is seen.
    """
    color = BLACK if background is None else background
    shown = [_pose(avatar, poses[0], cameras[0]) for avatar, poses in hands]
    gaussians = _joined(shown)
    for frame, camera in enumerate(cameras):
        last = shown
        shown = [_pose(avatar, poses[frame], camera, own) for (avatar, poses), own in zip(hands, last, strict=True)]
        if any(one.gaussians is not other.gaussians for one, other in zip(last, shown, strict=True)):
            gaussians = _joined(shown)
        drawn = render(gaussians, camera, background=color)
        yield to_uint8(drawn.image if background is not None else straight_alpha(drawn))
        progress(stage, frame + 1, len(cameras))


class _Posed(NamedTuple):
    pose: HandPose
    camera: Camera
    gaussians: Gaussians
    vertices: Tensor | None = None
    """Posed mesh; None until a second camera sees the same pose."""


def _pose(avatar: Avatar, pose: HandPose, camera: Camera, last: _Posed | None = None) -> _Posed:
    """The hand as `camera` sees it, with the Gaussians of `last` where they are the same."""
    if last is None or last.pose is not pose:
        return _Posed(pose, camera, avatar.pose(pose, camera=camera))
    if last.camera is camera:
        return last
    vertices = avatar.mesh(pose).vertices if last.vertices is None else last.vertices
    same = avatar.shade_shares(vertices, camera) == avatar.shade_shares(vertices, last.camera)
    return _Posed(pose, camera, last.gaussians if same else avatar.pose(pose, camera=camera), vertices)


def _joined(shown: Sequence[_Posed]) -> Gaussians:
    return Gaussians(*map(torch.cat, zip(*(one.gaussians for one in shown), strict=True)))


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
    hands = [(avatar, [pose] * n_frames)]
    cameras = around(hands, n_frames, size, elevation)
    return draw_frames(hands, cameras, background=background, progress=progress, stage="turntable")


@torch.no_grad()
def around(
    hands: Sequence[tuple[Avatar, Sequence[HandPose]]], n_frames: int, size: int, elevation: float
) -> list[Camera]:
    """Cameras on a circle around hands that stand still: around the arm of one, around the vertical for two."""
    meshes = [avatar.mesh(poses[0]).vertices for avatar, poses in hands]
    up = hand_up(hands[0][0].hand, meshes[0]) if len(hands) == 1 else None
    azimuths = (2 * math.pi * frame / n_frames for frame in range(n_frames))
    return [orbit_camera(torch.cat(meshes), azimuth, elevation, size, up=up) for azimuth in azimuths]


@torch.no_grad()
def still_camera(hands: Sequence[tuple[Avatar, Sequence[HandPose]]], size: int, elevation: float) -> Camera:
    """A camera that sees the hands completely in every frame."""
    seen = [avatar.mesh(pose).vertices for avatar, poses in hands for pose in few(poses)]
    return orbit_camera(torch.cat(seen), 0.0, elevation, size)


def few(poses: Sequence[HandPose]) -> Sequence[HandPose]:
    """About `MAX_FRAMED` of them."""
    return poses[:: max(1, len(poses) // MAX_FRAMED)]


@single_threaded_math()
def run(options: Animate) -> int:
    """Write the film.

    Raises:
        InputError: a wrong avatar file, motion, camera, option or output.
    """
    check_numbers(options)
    transparent = options.background == "transparent"
    check_video(options.out, transparent=transparent)
    background = None if transparent else read_color(options.background)
    if not 0 <= options.loop <= MAX_LOOPS:
        raise InputError(f"--loop {options.loop}: expected 0 (forever) to {MAX_LOOPS}; choose another number.")
    if not 1 <= len(options.avatars) <= 2:
        raise InputError(f"avatars: expected one or two, got {len(options.avatars)}; name them after `oasis animate`.")
    n_frames = count_frames(options.seconds, options.fps)
    names = read_names(options.poses)
    path = None if options.camera is None else read_cameras(options.camera)
    if path is not None and options.motion == "turntable":
        raise InputError("--camera: does not work with --motion turntable; choose another motion.")
    avatars = [load_avatar(options, file) for file in options.avatars]
    with show_progress(Terminal()) as progress:
        hands = [(avatar, _poses(avatar, options, n_frames, names, progress)) for avatar in avatars]
        hands = _together(hands, options)
        n_frames = len(hands[0][1])
        if options.motion == "turntable":
            cameras = around(hands, n_frames, options.size, math.radians(options.elevation))
        elif path is None:
            cameras = [still_camera(hands, options.size, math.radians(options.elevation))] * n_frames
        else:
            cameras = [path[min(frame, len(path) - 1)] for frame in range(n_frames)]
        stage = "turntable" if options.motion == "turntable" else "poses"
        frames = draw_frames(hands, cameras, background=background, progress=progress, stage=stage)
        write_video(options.out, frames, options.fps, loops=options.loop)
    written(options.out)
    return 0


def _poses(avatar: Avatar, options: Animate, n_frames: int, names: list[str], progress: Progress) -> list[HandPose]:
    """The poses of one hand in all frames."""
    if options.motion == "turntable":
        return [choose_pose(avatar, options.pose)] * n_frames
    if not isinstance(options.motion, Path):
        angles = pose_sequence(avatar.hand, names, max(1, round(n_frames / len(names))), avatar.rest)
        return [avatar.source_pose._replace(angles=each) for each in angles]
    if not options.motion.suffix:
        hint = did_you_mean(str(options.motion), MOTIONS) or "Choose one."
        raise InputError(f"--motion {options.motion}: expected {', '.join(MOTIONS)} or a motion file. {hint}")
    motion = resample(read_motion(options.motion, avatar, progress=progress), options.fps)
    count_frames(len(motion.angles) / options.fps, options.fps)
    if options.wrist == "still":
        return motion.poses(avatar.source_pose)
    if motion.orientations is None or motion.translations is None:
        raise InputError(f"{options.motion}: contains no wrist positions; leave out --wrist moves.")
    return [HandPose(*(part.to(avatar.shape) for part in each)) for each in
            zip(motion.angles, motion.orientations, motion.translations, strict=True)]  # fmt: skip


@torch.no_grad()
def _together(hands: list[tuple[Avatar, list[HandPose]]], options: Animate) -> list[tuple[Avatar, list[HandPose]]]:
    """Hands that keep their place stand side by side, in the order given; the shorter motion waits at its end."""
    longest = max(len(poses) for _, poses in hands)
    hands = [(avatar, [*poses, *[poses[-1]] * (longest - len(poses))]) for avatar, poses in hands]
    if len(hands) == 1 or (options.wrist == "moves" and isinstance(options.motion, Path)):
        return hands
    placed, left = [], 0.0
    for avatar, poses in hands:
        seen = torch.cat([avatar.mesh(pose).vertices for pose in few(poses)])
        wrist = avatar.mesh(poses[0]).joints[0]
        shift = torch.stack([left - seen[:, 0].amin(), -wrist[1], -wrist[2]])
        left += float(seen[:, 0].amax() - seen[:, 0].amin()) + GAP
        moved = {id(pose): pose._replace(translation=pose.translation + shift) for pose in poses}
        placed.append((avatar, [moved[id(pose)] for pose in poses]))
    return placed


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
        raise InputError(f"--poses {text}: expected names from {', '.join(POSE_NAMES)}, got {got}; choose others.")
    return names
