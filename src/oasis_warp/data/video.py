"""Write videos: MP4 (VP9, which browsers play) and looping GIF."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.atomic import output_file, write_file
from oasis_warp.data.pictures import check_suffix

VIDEO_SUFFIXES = (".mp4", ".gif")
_CODECS = ("vp09", "mp4v")
"""Tried in turn. OpenCV's wheel has no H.264 encoder. The second, MPEG-4 part 2, plays in players but in no browser."""
_GIF_PALETTE = (cv2.IMWRITE_GIF_DITHER, 3)
"""256 colours chosen by octree: 41 dB on a photo. OpenCV's default is one fixed palette: 17 dB."""


def write_video(path: Path | str, frames: Iterable[UInt8[Tensor, "H W 3"]], fps: float) -> int:
    """Write RGB frames of one size as MP4 or GIF, by the suffix of `path`; all or nothing. The number of frames.

    An odd width or height of an MP4 is padded by one pixel, since its colours come in pairs. A GIF holds every frame
    for whole hundredths of a second: 24 frames a second come out as 25.

    Raises:
        InputError: another suffix, or `path` cannot be written.
        ValueError: no frames.
    """
    path = Path(path)
    check_suffix(path, VIDEO_SUFFIXES)
    pixels = (cv2.cvtColor(frame.numpy(), cv2.COLOR_RGB2BGR) for frame in frames)
    n_frames = _write_gif(path, pixels, fps) if path.suffix.lower() == ".gif" else _write_mp4(path, pixels, fps)
    if n_frames == 0:
        raise ValueError("frames: expected at least one, got none.")
    return n_frames


def _write_gif(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    animation = cv2.Animation()
    animation.frames = list(frames)
    if not animation.frames:
        return 0
    animation.durations = [max(2, round(100 / fps)) * 10] * len(animation.frames)
    animation.loop_count = 0  # for ever
    _, data = cv2.imencodeanimation(".gif", animation, _GIF_PALETTE)
    write_file(path, data.tobytes())
    return len(animation.frames)


def _write_mp4(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    first = next(frames, None)
    if first is None:
        return 0
    height, width = first.shape[:2]
    with output_file(path) as part:
        writer = _open_writer(path, part, fps, (width + width % 2, height + height % 2))
        n_frames = 0
        try:
            while first is not None:
                writer.write(cv2.copyMakeBorder(first, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE))
                n_frames += 1
                first = next(frames, None)
        finally:
            writer.release()
        # The writer keeps every error to itself, so look at what came out.
        if _count_frames(part) != n_frames:
            raise InputError(f"{path}: the video could not be written whole; free some space or choose another disk.")
    return n_frames


def _open_writer(path: Path, part: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    for codec in _CODECS:
        writer = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, size)
        if writer.isOpened():
            return writer
    raise InputError(f"{path}: this build of OpenCV writes no MP4; give a name that ends in .gif instead.")


def _count_frames(path: Path) -> int:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    count = 0
    while capture.grab():
        count += 1
    capture.release()
    return count
