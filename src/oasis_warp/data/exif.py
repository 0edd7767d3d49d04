"""The few EXIF tags that matter here, read from a TIFF structure: which way is up and how wide the lens sees."""

import struct
from typing import NamedTuple

WIDTH, HEIGHT, BITS, SAMPLES = 0x0100, 0x0101, 0x0102, 0x0115
ORIENTATION, EXIF_IFD, FOCAL_35MM = 0x0112, 0x8769, 0xA405
_LAYOUTS = {1: "B", 3: "H", 4: "I"}
"""TIFF field types read here: BYTE, SHORT, LONG."""

FILM_DIAGONAL = 43.2666
"""Of a 36 x 24 mm frame [mm]."""


class Exif(NamedTuple):
    """What a camera says about its picture."""

    orientation: int
    """1 to 8 as in TIFF 6.0: where row 0 and column 0 belong; 1 is upright."""
    focal_35mm: int | None
    """Focal length of the 35 mm film camera with the same angle of view [mm]."""


def read_tags(tiff: bytes) -> dict[int, int]:
    """First value of every whole-number tag of the first directory and of the EXIF directory it points to.

    Cameras and editors write broken EXIF often, and a photo is worth reading without it: what cannot be read is left
    out, so this never raises.
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
            if n_values * struct.calcsize(layout) > 4:  # too long for the entry itself: it holds the place instead
                (place,) = struct.unpack_from(order + "I", tiff, place)
            (tags[tag],) = struct.unpack_from(layout, tiff, place)
    except struct.error:
        pass  # the directory runs past the end: keep what came before
    return tags


def read_exif(tiff: bytes) -> Exif:
    """Orientation and focal length; upright and unknown where the data do not say or say nonsense."""
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
