"""Pictures made to take memory or time: refused, or read, at once."""

import resource
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from image_files import encode, picture, png_chunk, tiff

from oasis_warp.core.errors import InputError
from oasis_warp.data import limited_decoding
from oasis_warp.data.environment_map import read_environment
from oasis_warp.data.photo import read_photo

MOST_GROWTH = 300 << 20
"""Of the process's peak memory while one picture is refused [bytes]."""


def with_idat_length(length: int) -> bytes:
    base = encode(".png", picture())
    place = base.index(b"IDAT") - 4
    return base[:place] + struct.pack(">I", length) + base[place + 4 :]


def with_texts(count: int) -> bytes:
    base = encode(".png", picture())
    place = base.index(b"IDAT") - 4
    text = png_chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(7_000_000), 9))
    return base[:place] + count * text + base[place:]


def with_first_tags(**tags: int) -> bytes:
    """A TIFF whose directory begins with tags that stand in it again."""
    base, shift = tiff(picture()), 12 * len(tags)
    (count,) = struct.unpack_from("<H", base, 8)
    first = b"".join(struct.pack("<HHII", int(tag[1:]), 4, 1, value) for tag, value in tags.items())
    entries = b""
    for k in range(count):
        tag, kind, n, value = struct.unpack_from("<HHII", base, 10 + 12 * k)
        entries += struct.pack("<HHII", tag, kind, n, value + shift if tag in (258, 273, 339) else value)
    return base[:8] + struct.pack("<H", count + len(tags)) + first + entries + base[10 + 12 * count :]


def progressive(width: int, height: int, scans: int) -> bytes:
    frame = struct.pack(">BHHB", 8, height, width, 1) + bytes([1, 0x11, 0])
    return b"\xff\xd8\xff\xc2" + struct.pack(">H", len(frame) + 2) + frame + scans * b"\xff\xda\0\2" + b"\xff\xd9"


HOSTILE = {
    "a PNG's chunk of 4 GB": (with_idat_length(0xFFFF0000), "damaged or cut short"),
    "a PNG of tiny chunks": (encode(".png", picture())[:33] + 210_000 * png_chunk(b"tEXt", b""), "damaged or cut"),
    "a JPEG of zeros": (b"\xff\xd8\xff" + bytes(64 << 20), "damaged or cut short"),
    "a JPEG of fill bytes": (b"\xff\xd8" + b"\xff" * (64 << 20), "damaged or cut short"),
    "a JPEG of empty segments": (b"\xff\xd8" + b"\xff\xe0\0\2" * (4 << 20), "damaged or cut short"),
    "a progressive JPEG of many scans": (progressive(16_000, 15_000, 1000), "too many to decode"),
    "an AVIF of repeated sizes": (encode(".avif", picture())[:12] + b"ispe" * (4 << 20), "damaged or cut short"),
    "a TIFF that says its size twice": (with_first_tags(t256=30_000, t257=30_000), "too many to decode"),
    "a TIFF of one huge tile": (with_first_tags(t322=1 << 15, t323=1 << 15), "damaged or cut short"),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_picture_is_refused_at_once_and_without_memory(tmp_path, name):
    data, words = HOSTILE[name]
    (tmp_path / "photo").write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=words):
        read_photo(tmp_path / "photo")
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 < len(data) + MOST_GROWTH


@pytest.mark.timeout(20)
def test_texts_in_a_png_take_no_time(tmp_path):
    (tmp_path / "photo.png").write_bytes(with_texts(500))
    assert np.array_equal(read_photo(tmp_path / "photo.png").rgb, picture())


def test_an_avif_that_takes_more_memory_than_its_header_says_is_refused(tmp_path, monkeypatch):
    (tmp_path / "photo.avif").write_bytes(encode(".avif", picture()))
    assert read_photo(tmp_path / "photo.avif").rgb.shape == (48, 64, 3)
    child = tmp_path / "child.py"
    source = Path(limited_decoding.__file__).read_text()
    child.write_text(source.replace("MOST_BYTES, MOST_SECONDS = 4 << 30", "MOST_BYTES, MOST_SECONDS = 1 << 20"))
    monkeypatch.setattr(limited_decoding, "__file__", str(child))
    with pytest.raises(InputError, match="damaged or cut short"):
        read_photo(tmp_path / "photo.avif")


@pytest.mark.timeout(20)
def test_a_huge_environment_map_is_refused_before_it_is_decoded(tmp_path):
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 60000\n" + bytes(100))
    with pytest.raises(InputError, match="60000 x 30000 pixels are too many"):
        read_environment(tmp_path / "a.hdr")
    for path, words in ((tmp_path / "b.hdr", "no such file"), ("/dev/zero", "no such file")):
        with pytest.raises(InputError, match=words):
            read_environment(path)
