"""Write pictures, contact sheets and videos: MP4 (H.264 where `ffmpeg` has it, else VP9), GIF, WebP, folders of PNG."""

import contextlib
import functools
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import output_file, output_folder, write_file

_ENCODINGS = {
    ".png": (),
    ".webp": (cv2.IMWRITE_WEBP_QUALITY, 101),  # above 100: lossless
    ".jpg": (cv2.IMWRITE_JPEG_QUALITY, 95),
    ".jpeg": (cv2.IMWRITE_JPEG_QUALITY, 95),
}
PICTURE_SUFFIXES = tuple(_ENCODINGS)
VIDEO_SUFFIXES = (".mp4", ".gif", ".webp")
TRANSPARENT = (".webp", "")
"""Endings of videos that can be transparent; a name without ending is a folder of PNG pictures."""
_CODECS = ("vp09", "mp4v")
"""Codecs of OpenCV, in order of preference; its wheel has no H.264. Browsers do not play the second, MPEG-4 part 2."""
_GIF_PALETTE = (cv2.IMWRITE_GIF_DITHER, 3)
"""Choose 256 colours by octree: 41 dB on a photo. OpenCV's default, a fixed palette, has 17 dB."""
_WEBP_QUALITY = (cv2.IMWRITE_WEBP_QUALITY, 90)
_H264 = "-c:v libx264 -preset veryfast -crf 16 -pix_fmt yuv420p -threads 1 -movflags +faststart -fflags +bitexact"
"""Arguments of ffmpeg: 4:2:0, which every player knows; one thread, so that the file does not depend on their
number."""


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


def contact_sheet(images: Float[Tensor, "N H W 3"], columns: int, gap: int = 2) -> Float[Tensor, "R C 3"]:
    """Arrange pictures in rows of `columns`, with white gaps."""
    n, height, width = images.shape[:3]
    rows = -(-n // columns)
    sheet = torch.ones(rows * (height + gap) - gap, columns * (width + gap) - gap, 3)
    for k, image in enumerate(images.cpu()):
        y, x = k // columns * (height + gap), k % columns * (width + gap)
        sheet[y : y + height, x : x + width] = image
    return sheet


def check_video(path: Path, *, transparent: bool = False) -> None:
    """Check that `path` names a video that can be written, before any work is spent on it.

    Raises:
        InputError: another ending, or one of videos that cannot be transparent.
    """
    if path.suffix:
        check_suffix(path, VIDEO_SUFFIXES)
    if transparent and path.suffix.lower() not in TRANSPARENT:
        raise InputError(f"{path}: {path.suffix} has no transparency; write .webp, or a folder of pictures.")


def write_video(path: Path | str, frames: Iterable[UInt8[Tensor, "H W C"]], fps: float, *, loops: int = 0) -> int:
    """Write RGB frames of one size as a video, by the ending of `path`, atomically; the number of frames.

    Without an ending `path` is a folder, and frame 7 becomes its file 0007.png; pictures in it keep their alpha, as
    WebP does. An odd width or height of an MP4 is padded by one pixel, since its chroma is subsampled. A GIF rounds
    frame times to hundredths of a second: 24 frames per second become 25.

    Args:
        path: File or folder.
        frames: RGB; RGBA where videos can be transparent.
        fps: Frames a second.
        loops: How often a GIF or WebP is shown; 0 for ever.

    Raises:
        InputError: another ending, transparency where there is none, or `path` cannot be written.
        ValueError: no frames.
    """
    path, rest = Path(path), iter(frames)
    first = next(rest, None)
    check_video(path, transparent=first is not None and first.shape[2] == 4)
    if first is None:
        raise ValueError("frames: expected at least one, got none.")
    every = chain([first], rest)
    if not path.suffix:
        return _write_folder(path, every)
    pixels = (_bgr(frame.numpy()) for frame in every)
    if path.suffix.lower() != ".mp4":
        return _write_animation(path, pixels, fps, loops)
    height, width = first.shape[:2]
    even = (cv2.copyMakeBorder(frame, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE) for frame in pixels)
    size = width + width % 2, height + height % 2
    with output_file(path) as part:
        encoder = h264_encoder()
        count = (
            _write_vp9(path, part, even, fps, size) if encoder is None else _write_h264(encoder, part, even, fps, size)
        )
        # Neither encoder reports all errors, so check the file.
        if _count_frames(part) != count:
            raise InputError(f"{path}: the video could not be written; free some space or choose another disk.")
    return count


def _bgr(pixels: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR)


def _write_folder(path: Path, frames: Iterator[Tensor]) -> int:
    count = 0
    with output_folder(path) as part:
        for frame in frames:
            count += 1
            write_picture(part / f"{count:04d}.png", frame)
    return count


def _write_animation(path: Path, frames: Iterator[np.ndarray], fps: float, loops: int) -> int:
    animation, suffix = cv2.Animation(), path.suffix.lower()
    animation.frames = list(frames)
    unit = 10 if suffix == ".gif" else 1  # ms
    animation.durations = [max(2 * unit, round(1000 / unit / fps) * unit)] * len(animation.frames)
    animation.loop_count = loops
    _, data = cv2.imencodeanimation(suffix, animation, _GIF_PALETTE if suffix == ".gif" else _WEBP_QUALITY)
    write_file(path, data.tobytes())
    return len(animation.frames)


@functools.cache
def h264_encoder() -> str | None:
    """The `ffmpeg` of this machine if it writes H.264, else None."""
    program = shutil.which("ffmpeg")
    if program is None:
        return None
    try:
        found = subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return program if " libx264 " in found.stdout else None


def _write_h264(encoder: str, part: Path, frames: Iterator[np.ndarray], fps: float, size: tuple[int, int]) -> int:
    given = f"-f rawvideo -pix_fmt bgr24 -s {size[0]}x{size[1]} -r {fps} -i -"
    command = [encoder, "-loglevel", "error", "-y", *given.split(), *_H264.split(), f"file:{part}"]
    count = 0
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=silent, stderr=silent)
    assert process.stdin is not None
    try:
        for frame in frames:
            process.stdin.write(np.ascontiguousarray(frame).data)
            count += 1
        process.stdin.close()
        process.wait()
    except BrokenPipeError:  # it ended early; what it wrote is counted
        pass
    finally:
        process.kill()
        process.wait()
        with contextlib.suppress(BrokenPipeError):  # what is left of a frame
            process.stdin.close()
    return count


def _write_vp9(path: Path, part: Path, frames: Iterator[np.ndarray], fps: float, size: tuple[int, int]) -> int:
    writer = _open_writer(path, part, fps, size)
    count = 0
    try:
        with ThreadPoolExecutor(1) as encoder:  # encodes a frame while the next one is drawn
            last = encoder.submit(lambda: None)
            for frame in frames:
                last.result()
                last = encoder.submit(writer.write, frame)
                count += 1
            last.result()
    finally:
        writer.release()
    return count


def _open_writer(path: Path, part: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    for codec in _CODECS:
        writer = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, size)
        if writer.isOpened():
            return writer
    raise InputError(f"{path}: this build of OpenCV cannot write MP4; choose a name that ends in .gif instead.")


def _count_frames(path: Path) -> int:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    count = 0
    while capture.grab():
        count += 1
    capture.release()
    return count
