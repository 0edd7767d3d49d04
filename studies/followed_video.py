"""How well the hand of a video is followed: videos of an avatar whose motion is known, before and after the filter.

Fills docs/viewing.md (followed). The videos have noise, and the avatar is that of `exports`.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.cli.animate import draw_frames
from oasis_warp.core import rotation
from oasis_warp.core.logging import silent
from oasis_warp.core.types import HandPose
from oasis_warp.data.pictures import write_video
from oasis_warp.hand.poses import pose_sequence
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion import Motion, jitter, recording, smooth
from studies import exports
from studies.harness import Row, measured
from studies.tables import Column, Section, table

CLIPS = {"holds still": ("open",), "moves through four poses and turns": ("open", "relaxed", "victory", "point")}
"""Poses of each film."""
TURN, TURN_SECONDS = 0.25, 2.0
"""How far the moving hand turns to both sides [rad], and how long it takes to be back."""
GROUND, NOISE = (0.35, 0.38, 0.42), 4.0
"""Colour behind the hand, and standard deviation of the noise [levels of 255]."""


@dataclass(frozen=True, kw_only=True)
class Options(exports.Options):
    """Options of this study."""

    frames: int = 60
    fps: float = 30.0


def poses_of(avatar: Avatar, names: tuple[str, ...], options: Options) -> list[HandPose]:
    """The true poses of a film."""
    angles, source = pose_sequence(avatar.hand, names, options.frames // len(names), avatar.rest), avatar.source_pose
    up = torch.tensor([0.0, 1.0, 0.0])
    turns = [
        TURN * math.sin(2 * math.pi * k / options.fps / TURN_SECONDS) * (len(names) > 1) for k in range(len(angles))
    ]
    about = (rotation.from_axis_angle(up, torch.tensor(turn)) @ source.orientation for turn in turns)
    return [source._replace(angles=each, orientation=turn) for each, turn in zip(angles, about, strict=True)]


def write_film(path: Path, avatar: Avatar, poses: list[HandPose], options: Options) -> None:
    """The film of these poses, seen by the photo's camera."""
    generator = torch.Generator().manual_seed(options.seed)
    drawn = draw_frames(
        [(avatar, poses)], [avatar.source_camera] * len(poses), background=GROUND, progress=silent, stage="film"
    )
    noisy = (
        (frame + NOISE * torch.randn(frame.shape, generator=generator)).round().clamp(0, 255).byte() for frame in drawn
    )
    write_video(path, noisy, options.fps)


@torch.no_grad()
def measure_clip(clip: str, options: Options) -> Iterator[Row]:
    """Rows of the truth, of each frame alone, and after the filter."""
    avatar = exports.the_avatar(options)
    poses = poses_of(avatar, CLIPS[clip], options)

    def points(pose: HandPose) -> Float[Tensor, "T 21 3"]:
        posed = avatar.mesh(pose)
        return torch.cat([posed.joints, posed.tips], -2)

    with TemporaryDirectory() as name:
        write_film(Path(name) / "film.mp4", avatar, poses, options)
        start = time.process_time()
        found, fps = recording.fit_frames(Path(name) / "film.mp4", avatar, silent)
        seconds = (time.process_time() - start) / len(poses)
    motion = recording.bridged(found, fps)
    true = points(HandPose(*map(torch.stack, zip(*poses, strict=True))))
    yield {"clip": clip, "what": "the truth", "jitter": jitter(true, fps)}
    for what, each in (("frame by frame", motion), ("filtered", smooth(motion))):
        yield {"clip": clip, "what": what, "seconds": seconds, "lost": found.count(None)} | against(true, each, points)


def against(true: Float[Tensor, "T 21 3"], motion: Motion, points) -> Row:
    """Acceleration of the joints, and how far they are off against the wrist."""
    assert motion.orientations is not None and motion.translations is not None
    at = points(HandPose(motion.angles, motion.orientations, motion.translations))
    off = (at - at[:, :1]) - (true - true[:, :1])
    return {"jitter": jitter(at, motion.fps), "off_mm": 1e3 * float(off.norm(dim=-1).mean())}


def run(options: Options) -> list[Row]:
    """Follow the hand of each film."""
    return measured("followed_video", {clip: (clip, options) for clip in CLIPS}, measure_clip, options)


SECTIONS = (
    Section("viewing.md", "followed", table((
        Column("the hand", "clip"), Column("motion", "what"),
        Column("mean acceleration of joints, m/s²", "jitter", ".2f"),
        Column("joints off against the wrist, mm", "off_mm", ".1f"), Column("frames lost", "lost", "d"),
        Column("CPU s a frame", "seconds", ".2f"),
    ))),
)  # fmt: skip
