"""Read a photo in any common format as upright 8-bit RGB, or raise one sentence about what is wrong."""

import contextlib
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Photo
from oasis_warp.data.image_header import (
    READABLE,
    Exif,
    ImageHeader,
    focal_pixels,
    looks_readable,
    pixels_of_png,
    read_exif,
    read_header,
    unsupported_format,
)
from oasis_warp.data.limited_decoding import decode_limited

MAX_PIXELS = 24_000_000
"""Largest photo kept in memory; larger ones are scaled down and still show a hand in enough pixels."""
MAX_FILE_PIXELS = 250_000_000
"""Largest photo that is opened at all."""
MAX_DECODED_BYTES = 1 << 30
"""Largest decoded picture; only JPEG can be decoded at a fraction of its size."""
MAX_FILE_BYTES = 1 << 29
MAX_WORK = 4_000_000_000
"""Most pixels that are gone through, counted again for each scan of a progressive JPEG: it has about ten."""
MIN_SIDE = 32
"""Fewer pixels than this cannot show a hand with fingers."""
OPAQUE = 0.99
"""An alpha channel that is nowhere below this is ignored."""

_JPEG_PARTS = {
    1: cv2.IMREAD_UNCHANGED,
    2: cv2.IMREAD_REDUCED_COLOR_2 | cv2.IMREAD_IGNORE_ORIENTATION,
    4: cv2.IMREAD_REDUCED_COLOR_4 | cv2.IMREAD_IGNORE_ORIENTATION,
    8: cv2.IMREAD_REDUCED_COLOR_8 | cv2.IMREAD_IGNORE_ORIENTATION,
}
_stderr_lock = threading.Lock()


def read_photo(path: Path | str, *, max_pixels: int = MAX_PIXELS, content: bytes | None = None) -> Photo:
    """Read a JPEG, PNG, WebP, AVIF, BMP or TIFF file as an upright 8-bit sRGB photo.

    EXIF orientation is applied; 16-bit values are rounded to 8; grey, palette and CMYK become RGB; alpha is kept where
    some pixel is transparent. `Photo.focal` comes from EXIF (see `exif.focal_pixels`). Colour profiles are ignored.

    A photo of more than `max_pixels` is averaged down by an integer factor. Peak memory is the file plus, for JPEG, up
    to four times `max_pixels`, or for other formats the whole picture, up to `MAX_DECODED_BYTES`. (The decoder of
    progressive JPEG needs 3 more bytes per pixel of the file.)

    Args:
        path: The file.
        max_pixels: See above.
        content: Its bytes, where they lie elsewhere; `path` is for messages then.

    Raises:
        InputError: the file is missing, unreadable, no image, truncated, damaged, too small or too large.
    """
    path = Path(path)
    data = read_bytes(path) if content is None else content
    header = read_header(data)
    if header is None:
        raise _not_an_image(path, data)
    _check_size(path, header)
    if header.format == "PNG":
        data = pixels_of_png(data)
    factor = 1
    while header.width * header.height > max_pixels * factor**2:
        factor += 1
    # A JPEG can be decoded directly at a half, a quarter or an eighth of its size.
    part = max(n for n in _JPEG_PARTS if n <= factor) if header.format == "JPEG" else 1
    pixels, exif = _decode(path, data, header.format, _JPEG_PARTS[part])
    del data
    if part < factor:
        pixels = cv2.resize(pixels, None, fx=part / factor, fy=part / factor, interpolation=cv2.INTER_AREA)
    pixels = _to_uint8(path, _turn_upright(pixels, exif.orientation))
    height, width = pixels.shape[:2]
    alpha = None
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        alpha = torch.from_numpy(np.ascontiguousarray(pixels[..., 3])).float() / 255
        if bool(alpha.min() >= OPAQUE) or bool(alpha.max() < 1 - OPAQUE):  # all opaque, or all transparent
            alpha = None
    codes = {2: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    rgb = cv2.cvtColor(pixels, codes[2 if pixels.ndim == 2 else pixels.shape[2]])
    return Photo(
        rgb=torch.from_numpy(rgb),
        alpha=alpha,
        focal=None if exif.focal_35mm is None else focal_pixels(exif.focal_35mm, width, height),
        name=path.name,
        shrink=max(width, height) / max(header.width, header.height),
    )


def as_photo(given: Photo | Path | str, name: str = "photo") -> Photo:
    """The photo itself, or that of a file; `name` is the argument's, for messages.

    Raises:
        InputError: see `read_photo`.
        TypeError: it is neither.
    """
    if isinstance(given, Path | str):
        return read_photo(given)
    if not isinstance(given, Photo):
        raise TypeError(
            f"{name}: expected a Photo or its file, got {type(given).__name__}; save the picture and give its file."
        )
    return given


def read_bytes(path: Path, content: str = "a photo") -> bytes:
    """The bytes of a file of bounded size.

    Raises:
        InputError: no such file, or none that ends; too large, empty or not readable.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path}: expected {content}, got a folder; give the files in it instead.")
        if not path.exists():
            raise InputError(f"{path}: expected {content}, found no such file; check the name and the folder.")
        if not path.is_file():
            raise InputError(f"{path}: expected {content}, got a device or pipe; save it to a file first.")
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            most = MAX_FILE_BYTES >> 20
            raise InputError(f"{path}: expected {content} of at most {most} MB, got {size >> 20} MB; save it as JPEG.")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the file's permissions and the disk."
        ) from error
    if not data:
        raise InputError(f"{path}: expected {content}, got an empty file (0 bytes); copy or download it again.")
    return data


def _not_an_image(path: Path, data: bytes) -> InputError:
    if looks_readable(data):
        return _cut_short(path, len(data))
    if name := unsupported_format(data):
        return InputError(f"{path}: expected {READABLE}, got {name}; save the photo as JPEG or PNG first.")
    return InputError(f"{path}: expected {READABLE}, got a file that is not an image; give the photo itself.")


def _cut_short(path: Path, n_bytes: int) -> InputError:
    return InputError(f"{path}: the image is damaged or cut short ({n_bytes} bytes); copy or download it again.")


def _check_size(path: Path, header: ImageHeader) -> None:
    width, height = header.width, header.height
    if min(width, height) < MIN_SIDE:
        raise InputError(
            f"{path}: expected at least {MIN_SIDE} x {MIN_SIDE} pixels, got {width} x {height}; give a larger photo."
        )
    decoded = 0 if header.format == "JPEG" else width * height * header.pixel_bytes
    if width * height > MAX_FILE_PIXELS or decoded > MAX_DECODED_BYTES or header.passes * width * height > MAX_WORK:
        raise InputError(
            f"{path}: {width} x {height} pixels of {header.format} are too many to decode; scale the photo down first."
        )


def _decode(path: Path, data: bytes, format: str, flags: int) -> tuple[np.ndarray, Exif]:
    """The pixels as stored in the file (BGR, not yet upright) and the EXIF tags."""
    if format == "AVIF":  # its video frame may be larger than its header says
        decoded = decode_limited(data, flags)
        if decoded is None:
            raise _cut_short(path, len(data))
        return decoded[0], read_exif(decoded[1].removeprefix(b"Exif\0\0"))
    with _captured_stderr() as captured:
        try:
            pixels, kinds, chunks = cv2.imdecodeWithMetadata(np.frombuffer(data, np.uint8), flags)
        except cv2.error:
            pixels, kinds, chunks = None, (), ()
        captured.seek(0)
        messages = captured.read()
    # libjpeg fills the missing part of a truncated file with grey and only prints a warning.
    if pixels is None or b"premature end" in messages:
        raise _cut_short(path, len(data))
    if format == "TIFF":  # OpenCV always rotates a TIFF upright
        return pixels, read_exif(data)._replace(orientation=1)
    blobs = [bytes(chunk) for kind, chunk in zip(kinds, chunks, strict=True) if kind == cv2.IMAGE_METADATA_EXIF]
    return pixels, read_exif(blobs[0].removeprefix(b"Exif\0\0")) if blobs else Exif(1, None)


def _turn_upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    if orientation >= 5:  # rows and columns are swapped
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _to_uint8(path: Path, pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == np.uint16:
        return cv2.convertScaleAbs(pixels, alpha=1 / 257)
    raise InputError(f"{path}: expected 8 or 16 bits a channel, got {pixels.dtype}; save the photo as JPEG or PNG.")


@contextlib.contextmanager
def _captured_stderr() -> Iterator[IO[bytes]]:
    """Capture what image libraries write to the process's stderr, which tells about damage."""
    with _stderr_lock, tempfile.TemporaryFile() as caught:
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            original = os.dup(2)
        except OSError:  # a closed stream
            original = None
        os.dup2(caught.fileno(), 2)
        try:
            yield caught
        finally:
            if original is None:
                os.close(2)
            else:
                os.dup2(original, 2)
                os.close(original)
            cv2.utils.logging.setLogLevel(level)
