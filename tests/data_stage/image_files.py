"""Image files that OpenCV cannot write, built byte by byte."""

import struct
import zlib

import cv2
import numpy as np

QUARTERS = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (200, 150, 120)]], np.uint8)
"""Colours of the test picture: red, green over blue, skin."""


def picture(height: int = 48, width: int = 64) -> np.ndarray:
    """Four quarters of plain colour, RGB."""
    return np.repeat(np.repeat(QUARTERS, height // 2, 0), width // 2, 1)


def quarters(rgb: np.ndarray) -> np.ndarray:
    """The colours in the middles of the four quarters."""
    height, width = rgb.shape[:2]
    return rgb[height // 4 :: height // 2, width // 4 :: width // 2][:2, :2]


def exif(orientation: int, focal_35mm: int | None = None, order: str = "<") -> bytes:
    """A TIFF structure with one directory, and an EXIF directory where there is a focal length."""
    entries = [struct.pack(order + "HHIHH", 0x0112, 3, 1, orientation, 0)]
    after = 8 + 2 + 12 * (1 if focal_35mm is None else 2) + 4
    sub = b""
    if focal_35mm is not None:
        entries.append(struct.pack(order + "HHII", 0x8769, 4, 1, after))
        sub = struct.pack(order + "HHHIHHI", 1, 0xA405, 3, 1, focal_35mm, 0, 0)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return head + struct.pack(order + "H", len(entries)) + b"".join(entries) + struct.pack(order + "I", 0) + sub


def encode(suffix: str, rgb: np.ndarray, exif_blob: bytes | None = None) -> bytes:
    """`rgb` (or RGBA, or grey) as a file of the kind `suffix`; WebP and AVIF at their best quality."""
    bgr = rgb if rgb.ndim == 2 else rgb[..., [2, 1, 0, 3][: rgb.shape[2]]]
    bgr = np.ascontiguousarray(bgr)
    if exif_blob is None:
        return cv2.imencode(suffix, bgr)[1].tobytes()
    chunk = [np.frombuffer(exif_blob, np.uint8)]
    return cv2.imencodeWithMetadata(suffix, bgr, [cv2.IMAGE_METADATA_EXIF], chunk)[1].tobytes()


def as_stored(rgb: np.ndarray, orientation: int) -> np.ndarray:
    """The rows a camera stores so that a reader who heeds `orientation` sees `rgb` (TIFF 6.0, Orientation)."""
    store = {
        1: lambda p: p, 2: np.fliplr, 3: lambda p: np.rot90(p, 2), 4: np.flipud, 5: lambda p: p.swapaxes(0, 1),
        6: np.rot90, 7: lambda p: np.rot90(p, 2).swapaxes(0, 1), 8: lambda p: np.rot90(p, -1),
    }  # fmt: skip
    return np.ascontiguousarray(store[orientation](rgb))


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, depth: int, colour: int, rows: bytes, *chunks: bytes) -> bytes:
    """A PNG of any depth and colour type; each row of `rows` begins with its filter byte."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    body = png_chunk(b"IDAT", zlib.compress(rows, 1))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + body + png_chunk(b"IEND", b"")


def _jpeg_segments(jpeg: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    place, segments = 2, []
    while True:
        marker, length = jpeg[place + 1], struct.unpack_from(">H", jpeg, place + 2)[0]
        segments.append((marker, jpeg[place + 4 : place + 2 + length]))
        place += 2 + length
        if marker == 0xDA:
            return segments, jpeg[place:-2]


def cmyk_jpeg(cmyk: np.ndarray) -> bytes:
    """A CMYK JPEG as Photoshop writes it: inks inverted, an Adobe marker, here with one scan an ink.

    A grey JPEG's scan is also a valid scan of one component, so four grey JPEGs are joined.
    """

    def segment(marker: int, body: bytes) -> bytes:
        return bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body

    inks = [255 - np.ascontiguousarray(cmyk[..., k]) for k in range(4)]
    parts = [_jpeg_segments(cv2.imencode(".jpg", ink, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()) for ink in inks]
    height, width = cmyk.shape[:2]
    components = b"".join(bytes([k + 1, 0x11, 0]) for k in range(4))
    out = b"\xff\xd8" + segment(0xEE, b"Adobe" + struct.pack(">HHHB", 100, 0, 0, 0))
    out += b"".join(segment(marker, body) for marker, body in parts[0][0] if marker in (0xDB, 0xC4))
    out += segment(0xC0, struct.pack(">BHHB", 8, height, width, 4) + components)
    for k, (_, scan) in enumerate(parts):
        out += segment(0xDA, bytes([1, k + 1, 0, 0, 63, 0])) + scan
    return out + b"\xff\xd9"


def tiff(pixels: np.ndarray, orientation: int = 1) -> bytes:
    """An uncompressed little-endian RGB TIFF of 8-bit, 16-bit or float samples."""
    height, width, samples = pixels.shape
    short, long, n = 3, 4, 11
    bits_at = 8 + 2 + 12 * n + 4
    kinds_at, data_at = bits_at + 2 * samples, bits_at + 4 * samples
    entries = [
        (256, long, 1, width), (257, long, 1, height), (258, short, samples, bits_at), (259, short, 1, 1),
        (262, short, 1, 2), (273, long, 1, data_at), (274, short, 1, orientation), (277, short, 1, samples),
        (278, long, 1, height), (279, long, 1, pixels.nbytes), (339, short, samples, kinds_at),
    ]  # fmt: skip
    out = b"II*\0" + struct.pack("<IH", 8, n)
    for tag, kind, count, value in entries:
        # A single SHORT stands in the first half of the field.
        field = struct.pack("<HH", value, 0) if kind == short and count == 1 else struct.pack("<I", value)
        out += struct.pack("<HHI", tag, kind, count) + field
    out += struct.pack("<I", 0) + struct.pack("<H", 8 * pixels.itemsize) * samples
    return out + struct.pack("<H", 3 if pixels.dtype.kind == "f" else 1) * samples + pixels.tobytes()
