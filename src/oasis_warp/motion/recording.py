"""The hand of a recorded video as a motion: every frame is fitted alone, gaps are bridged, and noise is filtered."""

from itertools import groupby
from pathlib import Path

import cv2
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, logger, silent
from oasis_warp.core.types import HandPose, Photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion.motion import Motion, at_frames, jitter, smooth

MAX_FRAMES = 10_000
MAX_SIDE = 1280
"""Larger frames are scaled down to it: the networks see the hand in 224 to 256 pixels [px]."""
MIN_SEEN = 0.5
"""Share of the frames that must show the hand: with fewer the motion would be mostly made up."""


def follow_video(path: Path, avatar: Avatar, *, progress: Progress = silent) -> Motion:
    """The motion of the avatar's side of hand in a video, with the avatar's shape, in the frame of the video's camera.

    Says how many frames were bridged, and how much the fingers shook before and after the filter.

    Raises:
        InputError: no video, or too few frames show the hand.
    """
    poses, fps = fit_frames(path, avatar, progress)
    seen = [k for k, pose in enumerate(poses) if pose is not None]
    if len(seen) < max(1, MIN_SEEN * len(poses)):
        raise InputError(
            f"{path}: {len(seen)} of {len(poses)} frames show a {avatar.side} hand, at least half are needed; give a "
            "video of the whole hand in good light, or an avatar of the other side."
        )
    if len(seen) < len(poses):
        logger.warning("%s: no %s hand in frames %s of %d; interpolated", path, avatar.side, _listed(poses), len(poses))
    shaken = bridged(poses, fps)
    motion = smooth(shaken)
    before, after = (_jitter(avatar, each) for each in (shaken, motion))
    logger.info("%s: the joints' mean acceleration is %.1f m/s², %.1f before the filter", path, after, before)
    return motion


def fit_frames(path: Path, avatar: Avatar, progress: Progress) -> tuple[list[HandPose | None], float]:
    """The pose in every frame, None where no hand is found or fitted; and frames a second."""
    if not path.is_file():
        raise InputError(f"{path}: cannot be read (no such file); check the path.")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        fps, count = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not capture.isOpened() or not 1 <= fps <= 1000 or count > MAX_FRAMES:
            raise InputError(f"{path}: expected a video of up to {MAX_FRAMES} frames; convert it to MP4, or cut it.")
        estimator, focal, poses = HandEstimator(avatar.hand.to("cpu")), None, []
        while len(poses) < MAX_FRAMES and (read := capture.read())[0]:
            photo = _as_photo(read[1], f"{path.name}, frame {len(poses) + 1}")
            pose, focal = _fit_frame(estimator, photo, avatar, focal)
            poses.append(pose)
            progress("video", len(poses), max(count, len(poses)))
    finally:
        capture.release()
    if not poses:
        raise InputError(f"{path}: expected a video, got a file without frames; convert it to MP4.")
    return poses, fps


def _as_photo(pixels: cv2.typing.MatLike, name: str) -> Photo:
    share = min(1.0, MAX_SIDE / max(pixels.shape[:2]))
    if share < 1:
        pixels = cv2.resize(pixels, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return Photo(torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)), None, None, name, 1.0)


def _fit_frame(
    estimator: HandEstimator, photo: Photo, avatar: Avatar, focal: float | None
) -> tuple[HandPose | None, float | None]:
    """The pose in one frame, and the focal length: that of the first frame holds for all."""
    found = [hand for hand in estimator.find(photo) if hand.side == avatar.side]
    if not found:
        return None, focal
    try:
        fit = estimator.fit(photo, found[0], focal=focal, shape=avatar.shape.cpu())
    except InputError:  # it is too small, or the model does not explain it
        return None, focal
    return fit.pose, float(fit.camera.K[0, 0])


def bridged(poses: list[HandPose | None], fps: float) -> Motion:
    """The motion with what lies between seen frames blended from them; before and after them it stands still."""
    seen = [k for k, pose in enumerate(poses) if pose is not None]
    parts = [torch.stack(list(part)) for part in zip(*(poses[k] for k in seen), strict=True)]
    known, at = torch.tensor(seen, dtype=torch.float64), torch.arange(len(poses), dtype=torch.float64)
    after = torch.searchsorted(known, at).clamp(1, max(len(seen) - 1, 1)).clamp_max(len(seen) - 1)
    before = (after - 1).clamp_min(0)
    share = ((at - known[before]) / (known[after] - known[before]).clamp_min(1)).clamp(0, 1)
    return at_frames(Motion(parts[0], fps, parts[1], parts[2]), before + share)


def _listed(poses: list[HandPose | None]) -> str:
    """Ranges of the frames without a pose, counted from 1."""
    runs = [list(run) for lost, run in groupby(range(len(poses)), lambda k: poses[k] is None) if lost]
    return ", ".join(f"{run[0] + 1}" if len(run) == 1 else f"{run[0] + 1} to {run[-1] + 1}" for run in runs)


@torch.no_grad()
def _jitter(avatar: Avatar, motion: Motion) -> float:
    poses = HandPose(motion.angles, motion.orientations, motion.translations)
    posed = avatar.mesh(poses)
    return jitter(torch.cat([posed.joints, posed.tips], 1), motion.fps)
