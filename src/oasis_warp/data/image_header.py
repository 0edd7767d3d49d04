"""Read format, size, orientation and focal length from the first bytes of an image file, before decoding it."""

import re
import struct
from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

WIDTH, HEIGHT, BITS, SAMPLES, TILE_WIDTH, TILE_HEIGHT = 0x0100, 0x0101, 0x0102, 0x0115, 0x0142, 0x0143
MAX_TILE = 1 << 26
"""Largest tile of a TIFF [px]."""
ORIENTATION, EXIF_IFD, FOCAL_35MM = 0x0112, 0x8769, 0xA405
_LAYOUTS = {1: "B", 3: "H", 4: "I"}
"""TIFF field types read here: BYTE, SHORT, LONG."""

FILM_DIAGONAL = 43.2666
"""Diagonal of a 36 x 24 mm frame [mm]."""
READABLE = "JPEG, PNG, WebP, AVIF, BMP or TIFF"
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"eXIf", b"IEND")
"""Chunks of a PNG that say what a photo shows."""
_FILL = re.compile(rb"\xff+")
_WITHOUT_LENGTH = (0x01, *range(0xD0, 0xDA))
"""Markers of a JPEG that stand alone."""
MAX_CHUNKS = 200_000
"""Most chunks of a PNG: three times what the largest has when its pixels come in chunks of 8 KB."""
MAX_SEGMENTS = 10_000
"""Most segments of a file's header: more than any camera writes, few enough to be read at once."""
_AVIF_BRANDS = (b"avif", b"avis")
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")


class Exif(NamedTuple):
    """EXIF tags of a photo."""

    orientation: int
    """1 to 8 as in TIFF 6.0; 1 is upright."""
    focal_35mm: int | None
    """Focal length of the 35 mm film camera with the same angle of view [mm]."""


def read_tags(tiff: bytes) -> dict[int, int]:
    """First value of every integer tag in the first directory and its EXIF directory.

    Never raises: EXIF is often broken, so tags that cannot be read are left out.
    """
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if order is None or len(tiff) < 8:
        return {}
    (first,) = struct.unpack_from(order + "I", tiff, 4)
    tags = _read_directory(tiff, first, order)
    return _read_directory(tiff, tags[EXIF_IFD], order) | tags if EXIF_IFD in tags else tags


def _read_directory(tiff: bytes, start: int, order: str) -> dict[int, int]:
    tags = {}
    try:
        (count,) = struct.unpack_from(order + "H", tiff, start)
        for entry in range(start + 2, start + 2 + 12 * count, 12):
            tag, kind, n_values = struct.unpack_from(order + "HHI", tiff, entry)
            if kind not in _LAYOUTS:
                continue
            layout, place = order + _LAYOUTS[kind], entry + 8
            if n_values * struct.calcsize(layout) > 4:  # the entry holds an offset instead of the values
                (place,) = struct.unpack_from(order + "I", tiff, place)
            (value,) = struct.unpack_from(layout, tiff, place)
            tags.setdefault(tag, value)  # of a repeated tag libtiff takes the first
    except struct.error:
        pass  # the directory is truncated: keep the tags before
    return tags


def read_exif(tiff: bytes) -> Exif:
    """Orientation and focal length; upright and unknown where tags are missing or invalid."""
    tags = read_tags(tiff)
    orientation, focal = tags.get(ORIENTATION, 1), tags.get(FOCAL_35MM, 0)
    return Exif(orientation if 1 <= orientation <= 8 else 1, focal if 5 <= focal <= 2000 else None)


def focal_pixels(focal_35mm: int, width: int, height: int) -> float:
    """Focal length [px] of a `width` x `height` picture, by the diagonal.

    CIPA DCG-001 defines the 35 mm equivalent as the lens with the same angle of view over the diagonal, so it holds
    for any aspect ratio: f_px = f_35 * hypot(width, height) / 43.27 mm. (By the width, a 4:3 phone photo would come
    out 4 % too short.)
    """
    return focal_35mm * (width**2 + height**2) ** 0.5 / FILM_DIAGONAL


class ImageHeader(NamedTuple):
    """Format and size of an image file."""

    format: str
    width: int
    height: int
    pixel_bytes: int
    """Upper bound of the memory of one decoded pixel [bytes]."""
    passes: int = 1
    """How often the decoder goes through all pixels."""


def read_header(data: bytes) -> ImageHeader | None:
    """The header of a JPEG, PNG, WebP, AVIF, BMP or TIFF file; None for other formats and truncated headers."""
    try:
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data)
        if is_png(data):
            return _png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return ImageHeader("WebP", *_webp_size(data), 4)
        if data[4:8] == b"ftyp" and data[8:12] in _AVIF_BRANDS:
            return _avif(data)
        if data.startswith(b"BM"):
            return ImageHeader("BMP", *_bmp_size(data), 4)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data)
    except (struct.error, KeyError, IndexError, ValueError):
        pass  # truncated
    return None


def is_png(data: bytes) -> bool:
    """Whether `data` begins like a PNG."""
    return data.startswith(_PNG_MAGIC)


def looks_readable(data: bytes) -> bool:
    """Whether `data` begins like a file in a supported format."""
    return (
        data.startswith((b"\xff\xd8\xff", b"\x89PNG", b"BM", b"II*\0", b"MM\0*"))
        or (data.startswith(b"RIFF") and data[8:12] == b"WEBP")
        or (data[4:8] == b"ftyp" and data[8:12] in _AVIF_BRANDS)
    )


def unsupported_format(data: bytes) -> str | None:
    """The name of a known but unsupported format, for messages."""
    if data[4:8] == b"ftyp":
        return "HEIC" if data[8:12] in _HEIF_BRANDS else "video"
    magics = {b"GIF8": "GIF", b"%PDF": "PDF", b"\x1aE\xdf\xa3": "video", b"\xff\x0a": "JPEG XL", b"<svg": "SVG"}
    return next((name for magic, name in magics.items() if data.startswith(magic)), None)


def _jpeg(data: bytes) -> ImageHeader | None:
    place = 2
    for _ in range(MAX_SEGMENTS):
        # Garbage before a marker is skipped, as by decoders, and fill bytes are.
        fill = _FILL.match(data, data.index(b"\xff", place))
        place = fill.end() + 1 if fill else place
        marker = data[place - 1]
        if marker == 0:
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            height, width = struct.unpack_from(">HH", data, place + 3)
            progressive = marker in (0xC2, 0xC6, 0xCA, 0xCE)
            return ImageHeader("JPEG", width, height, 3, data.count(b"\xff\xda", place) if progressive else 1)
        if marker not in _WITHOUT_LENGTH:
            place += struct.unpack_from(">H", data, place)[0]
    return None


def _png(data: bytes) -> ImageHeader | None:
    chunks = list(islice(_png_chunks(data), MAX_CHUNKS))
    if len(chunks) == MAX_CHUNKS or any(place + length + 12 > len(data) for _, place, length in chunks):
        return None  # a decoder would take memory for all that a chunk claims to have
    width, height, depth = struct.unpack_from(">IIB", data, 16)
    return ImageHeader("PNG", width, height, 8 if depth == 16 else 4)


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, place and length of every chunk; the last may reach beyond the file."""
    place = len(_PNG_MAGIC)
    while place + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        yield data[place + 4 : place + 8], place, length
        place += length + 12


def pixels_of_png(data: bytes) -> bytes:
    """A PNG without texts, colour profiles and further frames; 8 KB of these can take a decoder seconds."""
    parts = [data[at : at + n + 12] for kind, at, n in _png_chunks(data) if kind in _PNG_CHUNKS]
    return _PNG_MAGIC + b"".join(parts)


def _webp_size(data: bytes) -> tuple[int, int]:
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def _avif(data: bytes) -> ImageHeader | None:
    # A tiled picture has one "ispe" box per tile and one for the whole.
    place, largest = data.find(b"ispe"), (0, 0)
    for _ in range(MAX_SEGMENTS):
        if place < 0:
            return ImageHeader("AVIF", *largest, 8) if largest != (0, 0) else None
        width, height = struct.unpack_from(">II", data, place + 8)
        largest = max(largest, (width, height), key=lambda size: size[0] * size[1])
        place = data.find(b"ispe", place + 4)
    return None


def _bmp_size(data: bytes) -> tuple[int, int]:
    (header_size,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header_size == 12 else "<ii", data, 18)
    return width, abs(height)  # a negative height means rows from the top


def _tiff(data: bytes) -> ImageHeader | None:
    tags = read_tags(data)
    samples, bits = tags.get(SAMPLES, 1), tags.get(BITS, 8)
    tile = tags.get(TILE_WIDTH, 1) * tags.get(TILE_HEIGHT, 1)
    if tile > MAX_TILE or _count_unread(data):
        return None
    return ImageHeader("TIFF", tags[WIDTH], tags[HEIGHT], max(samples, 4) * max(bits, 8) // 8)


def _count_unread(tiff: bytes) -> int:
    """How many tags about sizes have a type that is not read here, though libtiff may."""
    order = "<" if tiff[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", tiff, 4)
    (count,) = struct.unpack_from(order + "H", tiff, start)
    entries = (struct.unpack_from(order + "HH", tiff, start + 2 + 12 * k) for k in range(count))
    sizes = (WIDTH, HEIGHT, BITS, SAMPLES, TILE_WIDTH, TILE_HEIGHT)
    return sum(tag in sizes and kind not in _LAYOUTS for tag, kind in entries)
