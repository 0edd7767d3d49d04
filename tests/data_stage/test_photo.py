"""Photos of all kinds are read upright; pictures made to take memory or time are refused, or read, at once."""

import math
import os
import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from image_files import as_stored, cmyk_jpeg, encode, exif, picture, png, png_chunk, quarters, tiff

from oasis_warp.core.errors import InputError
from oasis_warp.data import limited_decoding
from oasis_warp.data.environment_map import read_environment
from oasis_warp.data.photo import read_photo

LOSSY_SLACK = 6
"""Levels that a plain colour may move through a lossy format's colour conversion and quantisation."""


@pytest.fixture
def read(tmp_path):
    def read(data, suffix=".jpg", **options):
        path = tmp_path / f"photo{suffix}"
        path.write_bytes(data)
        return read_photo(path, **options)

    return read


def assert_shows_the_quarters(photo, slack=LOSSY_SLACK):
    got, expected = quarters(photo.rgb.numpy()).astype(int), quarters(picture()).astype(int)
    assert np.abs(got - expected).max() <= slack


@pytest.mark.parametrize(
    ("suffix", "slack"),
    [(".jpg", LOSSY_SLACK), (".png", 0), (".webp", 0), (".bmp", 0), (".tiff", 0), (".avif", LOSSY_SLACK)],
)
def test_every_common_format_shows_the_same_picture(read, suffix, slack):
    photo = read(encode(suffix, picture()), suffix)
    assert_shows_the_quarters(photo, slack)
    assert photo.rgb.shape == (48, 64, 3)
    assert (photo.alpha, photo.focal, photo.shrink, photo.name) == (None, None, 1, f"photo{suffix}")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".avif"])
def test_every_exif_orientation_comes_out_upright(read, suffix, orientation):
    photo = read(encode(suffix, as_stored(picture(), orientation), exif(orientation)), suffix)
    assert photo.rgb.shape == (48, 64, 3)
    assert_shows_the_quarters(photo)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_tiff_orientation_comes_out_upright(read, orientation):
    photo = read(tiff(as_stored(picture(), orientation), orientation), ".tif")
    assert photo.rgb.shape == (48, 64, 3)
    assert_shows_the_quarters(photo, slack=0)


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_photo_that_is_scaled_down_is_turned_upright_too(read, suffix, orientation):
    stored = as_stored(picture(480, 640), orientation)
    photo = read(encode(suffix, stored, exif(orientation, 26)), suffix, max_pixels=640 * 480 // 10)
    assert photo.rgb.shape == (120, 160, 3)
    assert photo.shrink == 0.25
    assert photo.focal == pytest.approx(26 * 200 / 43.2666)
    assert_shows_the_quarters(photo)


def test_a_turned_tiff_is_scaled_down_too(read):
    photo = read(tiff(as_stored(picture(480, 640), 6), 6), ".tif", max_pixels=640 * 480 // 10)
    assert photo.rgb.shape == (120, 160, 3)
    assert_shows_the_quarters(photo)


def test_a_factor_that_jpeg_decoding_lacks_is_reached_by_averaging(read):
    photo = read(encode(".jpg", picture(480, 640)), max_pixels=640 * 480 // 6)
    assert photo.rgb.shape == (160, 213, 3)
    assert_shows_the_quarters(photo)


def test_scaling_down_averages_instead_of_skipping_pixels(read):
    checkers = np.indices((400, 400)).sum(0).astype(np.uint8) % 2 * 255
    photo = read(encode(".png", checkers), ".png", max_pixels=200 * 200)
    assert photo.rgb.shape == (200, 200, 3)
    assert photo.rgb.unique().tolist() in ([127], [128])


def test_sixteen_bits_are_rounded_to_eight(read):
    wide = picture().astype(np.uint16) * 257
    wide[0, 0] = (128, 129, 65535 - 128)  # just below half a level, just above it, just below half a level from white
    for data, suffix in ((encode(".png", wide), ".png"), (tiff(wide), ".tif")):
        photo = read(data, suffix)
        assert_shows_the_quarters(photo, slack=0)
        assert photo.rgb[0, 0].tolist() == [0, 1, 255]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_grey_becomes_three_equal_channels(read, suffix):
    grey = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (64, 1))
    photo = read(encode(suffix, grey), suffix)
    assert (photo.rgb == photo.rgb[..., :1]).all()
    assert np.abs(photo.rgb[..., 0].numpy().astype(int) - grey).max() <= LOSSY_SLACK


def test_one_bit_pictures_are_black_and_white(read):
    photo = read(png(40, 40, 1, 0, b"\0\xff\xff\0\0\0" * 40), ".png")
    assert photo.rgb[0, 0].tolist() == [255] * 3
    assert photo.rgb[0, 39].tolist() == [0] * 3


def test_a_palette_is_looked_up_and_its_transparency_kept(read):
    rows = (b"\0" + bytes([0] * 20 + [1] * 20)) * 40
    palette = png_chunk(b"PLTE", bytes([250, 10, 20, 30, 240, 50]))
    plain = read(png(40, 40, 8, 3, rows, palette), ".png")
    assert plain.rgb[0, 0].tolist() == [250, 10, 20]
    assert plain.rgb[0, 39].tolist() == [30, 240, 50]
    assert plain.alpha is None
    clear = read(png(40, 40, 8, 3, rows, palette, png_chunk(b"tRNS", bytes([255, 51]))), ".png")
    assert clear.alpha[0, 0] == 1
    assert clear.alpha[0, 39] == pytest.approx(0.2)


@pytest.mark.parametrize("suffix", [".png", ".webp", ".tiff"])
def test_alpha_is_kept_only_where_it_says_something(read, suffix):
    alpha = np.full((48, 64, 1), 255, np.uint8)
    cut = alpha.copy()
    cut[:24] = 0
    assert read(encode(suffix, np.dstack([picture(), alpha])), suffix).alpha is None
    assert read(encode(suffix, np.dstack([picture(), 0 * alpha])), suffix).alpha is None
    photo = read(encode(suffix, np.dstack([picture(), cut])), suffix)
    assert photo.alpha.shape == (48, 64)
    assert (photo.alpha[:24] == 0).all()
    assert (photo.alpha[24:] == 1).all()


def test_alpha_is_turned_with_its_picture(read):
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:24, :32] = 0
    stored = as_stored(np.dstack([picture(), alpha]), 6)
    photo = read(encode(".png", stored, exif(6)), ".png")
    assert (photo.alpha[:24, :32] == 0).all()
    assert photo.alpha.sum() == 48 * 64 * 3 / 4


def test_cmyk_becomes_rgb(read):
    cmyk = np.dstack([255 - picture(), np.zeros((48, 64), np.uint8)])
    assert_shows_the_quarters(read(cmyk_jpeg(cmyk)))


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_focal_length_follows_the_diagonal(read, order):
    photo = read(encode(".jpg", picture(480, 640), exif(1, 28, order)))
    field_of_view = 2 * math.atan(math.hypot(480, 640) / 2 / photo.focal)
    assert field_of_view == pytest.approx(2 * math.atan(math.hypot(36, 24) / 2 / 28), rel=1e-5)


@pytest.mark.parametrize("focal", [0, 3, 60000])
def test_a_focal_length_that_no_lens_has_is_ignored(read, focal):
    assert read(encode(".jpg", picture(), exif(1, focal))).focal is None


def test_broken_exif_does_not_stop_a_good_photo(read):
    whole = exif(6, 28)
    for blob in (whole[:9], whole[:20], whole[:-4], b"II*\0\xff\xff\xff\xff" + whole[8:], b"garbage" * 4):
        assert read(encode(".jpg", picture(), blob)).rgb.shape[2] == 3
    assert read(encode(".jpg", picture(), exif(9))).rgb.shape == (48, 64, 3)


def test_junk_after_the_picture_is_ignored(read):
    assert_shows_the_quarters(read(encode(".jpg", picture()) + b"a film after the still" * 100))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".bmp", ".tiff", ".avif"])
@pytest.mark.parametrize("share", [0.0001, 0.5, 0.97])
def test_a_file_cut_short_is_refused(read, suffix, share):
    data = encode(suffix, np.random.default_rng(7).integers(0, 255, (300, 300, 3), np.uint8))
    with pytest.raises(InputError, match="damaged or cut short"):
        read(data[: max(int(len(data) * share), 24)], suffix)


def test_a_jpeg_cut_short_and_closed_again_is_refused(read):
    data = encode(".jpg", np.random.default_rng(8).integers(0, 255, (300, 300, 3), np.uint8))
    with pytest.raises(InputError, match="damaged or cut short"):
        read(data[: len(data) // 2] + b"\xff\xd9")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "empty file"),
        (b"These are words.", "got a file that is not an image"),
        (b"\0\0\0\x18ftypheic\0\0\0\0" + b"\0" * 100, "got HEIC; save the photo as JPEG"),
        (b"\0\0\0\x18ftypisom\0\0\0\0" + b"\0" * 100, "got video"),
        (b"GIF89a" + b"\0" * 100, "got GIF"),
        (b"%PDF-1.7" + b"\0" * 100, "got PDF"),
        (encode(".png", np.zeros((1, 1, 3), np.uint8)), "at least 32 x 32 pixels, got 1 x 1"),
        (encode(".jpg", np.zeros((31, 400, 3), np.uint8)), "at least 32 x 32 pixels, got 400 x 31"),
        (tiff(np.zeros((40, 40, 3), np.float32)), "8 or 16 bits a channel, got float32"),
        (png(60000, 60000, 8, 2, b""), "60000 x 60000 pixels of PNG are too many"),
        (png(16000, 12000, 16, 6, b""), "16000 x 12000 pixels of PNG are too many"),
    ],
)
def test_what_is_no_photo_is_refused_in_one_sentence(read, data, expected):
    with pytest.raises(InputError, match=expected) as caught:
        read(data)
    message = str(caught.value)
    assert "photo.jpg: " in message
    assert message.endswith(".")
    assert "\n" not in message


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".avif", ".bmp", ".tiff"])
def test_random_damage_gives_a_photo_or_one_sentence(read, suffix):
    rng = np.random.default_rng(5)
    whole = encode(suffix, picture(), exif(6, 28) if suffix in (".jpg", ".png", ".webp") else None)
    for _ in range(4 if suffix == ".avif" else 40):  # each in a process of its own
        data = bytearray(whole)
        for place in rng.integers(0, min(len(data), 400), rng.integers(1, 5)):  # most of what can go wrong is in front
            data[place] = rng.integers(256)
        try:
            photo = read(bytes(data), suffix)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert photo.rgb.ndim == 3


def test_places_that_hold_no_photo_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_photo(tmp_path / "none.jpg")
    with pytest.raises(InputError, match="got a folder"):
        read_photo(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="device or pipe"):
        read_photo(tmp_path / "pipe")


def test_a_photo_without_permission_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "closed.jpg"
    path.write_bytes(encode(".jpg", picture()))
    path.chmod(0)
    if os.access(path, os.R_OK):  # root may read anything

        def refuse(self):
            raise PermissionError(13, "Permission denied", str(self))

        monkeypatch.setattr(type(path), "read_bytes", refuse)
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\)"):
        read_photo(path)


def test_image_libraries_write_nothing_on_stderr(read, capfd):
    data = encode(".png", picture(200, 200))
    with pytest.raises(InputError):
        read(data[: len(data) // 2], ".png")
    with pytest.raises(InputError):
        read(encode(".jpg", picture(200, 200))[:700] + b"\xff\xd9")
    assert capfd.readouterr().err == ""


MEASURE = """
import resource, sys
from oasis_warp.data.photo import read_photo
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = peak()
photo = read_photo(sys.argv[1])
print(*photo.rgb.shape, photo.shrink, peak() - before)
"""


@pytest.mark.parametrize(("suffix", "limit"), [(".jpg", 250e6), pytest.param(".png", 450e6, marks=pytest.mark.slow)])
def test_a_hundred_megapixels_are_scaled_down_in_bounded_memory(tmp_path, suffix, limit):
    # A JPEG is decoded at half its size (75 MB), then averaged; of a PNG the whole 300 MB are in memory once.
    if suffix == ".jpg":
        data = encode(".jpg", np.full((10000, 10000), 127, np.uint8))
    else:
        data = png(10000, 10000, 8, 2, (b"\0" + b"\x7f" * 30000) * 10000)
    (tmp_path / f"huge{suffix}").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, tmp_path / f"huge{suffix}"], capture_output=True, text=True, check=True
    )
    *shape, shrink, grown = map(float, done.stdout.split())
    assert shape == [3333, 3333, 3]
    assert shrink == pytest.approx(1 / 3, rel=1e-3)
    assert grown < limit


MAX_GROWTH = 300 << 20
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
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 < len(data) + MAX_GROWTH


@pytest.mark.timeout(20)
def test_texts_in_a_png_take_no_time(tmp_path):
    (tmp_path / "photo.png").write_bytes(with_texts(500))
    assert np.array_equal(read_photo(tmp_path / "photo.png").rgb, picture())


def test_an_avif_that_takes_more_memory_than_its_header_says_is_refused(tmp_path, monkeypatch):
    (tmp_path / "photo.avif").write_bytes(encode(".avif", picture()))
    assert read_photo(tmp_path / "photo.avif").rgb.shape == (48, 64, 3)
    child = tmp_path / "child.py"
    source = Path(limited_decoding.__file__).read_text()
    child.write_text(source.replace("MAX_BYTES, MAX_SECONDS = 4 << 30", "MAX_BYTES, MAX_SECONDS = 1 << 20"))
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
