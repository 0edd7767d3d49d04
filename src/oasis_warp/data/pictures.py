"""Write pictures, contact sheets and videos (MP4 with VP9, which browsers play, and looping GIF)."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import output_file, write_file

_ENCODINGS = {
    ".png": (),
    ".webp": (cv2.IMWRITE_WEBP_QUALITY, 101),  # above 100: lossless
    ".jpg": (cv2.IMWRITE_JPEG_QUALITY, 95),
    ".jpeg": (cv2.IMWRITE_JPEG_QUALITY, 95),
}
PICTURE_SUFFIXES = tuple(_ENCODINGS)


def to_uint8(image: Float[Tensor, "H W C"]) -> UInt8[Tensor, "H W C"]:
    """Colours in [0, 1] as bytes on the CPU, clipped and rounded."""
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)


def check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    """Check that `path` ends in one of `suffixes`, before any work is spent on it.

    Raises:
        InputError: another suffix.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}; rename the output.")


def write_picture(path: Path | str, image: UInt8[Tensor, "H W C"]) -> None:
    """Write RGB or RGBA pixels as PNG, WebP (both exact) or JPEG, by the suffix of `path`, atomically.

    Raises:
        InputError: another suffix, transparency in a JPEG, or `path` cannot be written.
    """
    path = Path(path)
    check_suffix(path, PICTURE_SUFFIXES)
    pixels = image.numpy()
    if pixels.shape[2] == 4 and path.suffix.lower() in (".jpg", ".jpeg"):
        raise InputError(f"{path}: JPEG has no transparency; write PNG or choose a background.")
    order = cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR
    pixels = cv2.cvtColor(np.ascontiguousarray(pixels), order)
    _, data = cv2.imencode(path.suffix.lower(), pixels, _ENCODINGS[path.suffix.lower()])
    write_file(path, data.tobytes())


VIDEO_SUFFIXES = (".mp4", ".gif")
_CODECS = ("vp09", "mp4v")
"""In order of preference. OpenCV's wheel has no H.264 encoder. Browsers do not play the second, MPEG-4 part 2."""
_GIF_PALETTE = (cv2.IMWRITE_GIF_DITHER, 3)
"""Choose 256 colours by octree: 41 dB on a photo. OpenCV's default, a fixed palette, has 17 dB."""


def write_video(path: Path | str, frames: Iterable[UInt8[Tensor, "H W 3"]], fps: float) -> int:
    """Write RGB frames of one size as MP4 or GIF, by the suffix of `path`, atomically; the number of frames.

    An odd width or height of an MP4 is padded by one pixel, since its chroma is subsampled. A GIF rounds frame times
    to hundredths of a second: 24 frames per second become 25.

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
    animation.loop_count = 0  # loop forever
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
        # The writer reports no errors, so check the file.
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


def contact_sheet(images: Float[Tensor, "N H W 3"], columns: int, gap: int = 2) -> Float[Tensor, "R C 3"]:
    """Arrange pictures in rows of `columns`, with white gaps."""
    n, height, width = images.shape[:3]
    rows = -(-n // columns)
    sheet = torch.ones(rows * (height + gap) - gap, columns * (width + gap) - gap, 3)
    for k, image in enumerate(images.cpu()):
        y, x = k // columns * (height + gap), k % columns * (width + gap)
        sheet[y : y + height, x : x + width] = image
    return sheet
