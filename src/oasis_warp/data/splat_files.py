"""Read Gaussians that other programs wrote: .ply, .compressed.ply, .splat and .spz, in numpy.

Each reader gives means, quats (wxyz), scales, opacities and colours with y down and z forward, as trained scenes have
them. Spherical harmonics beyond the constant one are left out.
"""

import importlib
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.logging import logger
from oasis_warp.core.types import Gaussians

MAX_BYTES, MAX_SPLATS = 1 << 30, 4_000_000
"""Largest file that is read, also unzipped, and most Gaussians: beyond it no browser turns them."""
SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 f_dc (Kerbl et al. 2023)."""
SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
"""Row of a .splat file (github.com/antimatter15/splat)."""
SPZ_MAGIC, SPZ_COLOR_SCALE = 0x5053474E, 0.15
"""Constants of .spz (github.com/nianticlabs/spz); a byte of colour holds 0.5 + SPZ_COLOR_SCALE f_dc."""
SPZ4_HEADER = 32
"""Length of a version 4's header [bytes]."""
PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
CHUNK = 256
"""Gaussians of a .compressed.ply that share a box."""

Parts = tuple[np.ndarray, ...]
"""Means, quats, scales, opacities and colours."""


def read_splats(path: Path | str) -> Gaussians:
    """The Gaussians of a file; those with values that are not finite are left out, and said.

    Raises:
        InputError: no such file, too large, another format, damaged, or without Gaussians.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: expected Gaussians in {', '.join(READERS)}; convert the file.")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: cannot be read (a folder, a device or a pipe); give a file.")
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise InputError(f"{path}: expected at most {MAX_BYTES >> 20} MB, got {size >> 20} MB; thin it out.")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return _finite(path, reader(path.read_bytes()))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    except (ValueError, KeyError, struct.error, zlib.error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: no Gaussians can be read ({shortened(str(error))}); give another file.") from error


def _finite(path: Path, parts: Parts) -> Gaussians:
    means, quats, scales, opacities, colors = (np.ascontiguousarray(part, dtype="<f4") for part in parts)
    lengths = np.linalg.norm(quats, axis=1)
    good = np.isfinite(np.concatenate([means, scales, opacities[:, None], colors, lengths[:, None]], 1)).all(1)
    good &= (lengths > 0) & (scales > 0).all(1)
    if len(means) > MAX_SPLATS or not good.any():
        got = f"{good.sum()} of {len(means)}"
        raise InputError(f"{path}: expected 1 to {MAX_SPLATS} finite Gaussians, got {got}; give another file.")
    if bad := int((~good).sum()):
        logger.warning("%s: %d of %d Gaussians are not finite and left out", path, bad, len(good))
    quats = quats[good] / lengths[good, None]
    parts = means[good], quats, scales[good], opacities[good].clip(0, 1), colors[good].clip(0, 1)
    return Gaussians(*map(torch.from_numpy, parts))


def _ply_elements(data: bytes) -> dict[str, np.ndarray]:
    """The elements of a binary PLY, each with its columns by name."""
    head, found, body = data.partition(b"end_header\n")
    lines = head.decode("latin-1").splitlines()
    if lines[:1] != ["ply"] or not found:
        raise ValueError("it does not begin as a PLY")
    layout: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[1:]:
        match line.split():
            case ["format", kind, _] if kind != "binary_little_endian":
                raise ValueError(f"binary_little_endian is read, not {kind}")
            case ["element", name, count]:
                if int(count) < 0:
                    raise ValueError(f"a count is negative: {line}")
                layout.append((name, int(count), []))
            case ["property", kind, name] if layout and kind in PLY_KINDS:
                layout[-1][2].append((name, PLY_KINDS[kind]))
            case ["property", *_]:
                raise ValueError(f"a column is unknown: {line}")
    elements = {}
    for name, count, columns in layout:
        if count > len(body):
            raise ValueError(f"{count} of {shortened(name)} do not fit into the file")
        elements[name] = np.frombuffer(body, np.dtype(columns), count) if count else np.zeros(0, np.dtype(columns))
        body = body[elements[name].nbytes :]
    return elements


def _columns(table: np.ndarray, *names: str) -> np.ndarray:
    if missing := [name for name in names if name not in (table.dtype.names or ())]:
        raise ValueError(f"a point cloud without {missing[0]}")
    return np.stack([table[name].astype(np.float64) for name in names], 1)


def _read_ply(data: bytes) -> Parts:
    """As 3D Gaussian splatting writes it, or compressed (PlayCanvas)."""
    elements = _ply_elements(data)
    table = elements["vertex"]
    if "packed_position" in (table.dtype.names or ()):
        return _read_compressed(table, elements["chunk"])
    quats, scales = (_columns(table, *(f"{kind}_{k}" for k in range(n))) for kind, n in (("rot", 4), ("scale", 3)))
    colors = 0.5 + SH_C0 * _columns(table, *(f"f_dc_{k}" for k in range(3)))
    return _columns(table, *"xyz"), quats, np.exp(scales), 1 / (1 + np.exp(-_columns(table, "opacity")[:, 0])), colors


def _read_compressed(packed: np.ndarray, chunks: np.ndarray) -> Parts:
    if len(chunks) * CHUNK < len(packed):
        raise ValueError("boxes are missing")
    chunk = chunks[np.arange(len(packed)) // CHUNK]

    def placed(shares: np.ndarray, *names: str) -> np.ndarray:
        least, most = (_columns(chunk, *(f"{end}_{name}" for name in names)) for end in ("min", "max"))
        return least + shares * (most - least)

    rotations = _unpack(packed["packed_rotation"], 2, 10, 10, 10)
    quats = _fill_in(np.round(3 * rotations[:, 0]).astype(int), (rotations[:, 1:] - 0.5) * np.sqrt(2))
    means = placed(_unpack(packed["packed_position"], 11, 10, 11), *"xyz")
    scales = placed(_unpack(packed["packed_scale"], 11, 10, 11), "scale_x", "scale_y", "scale_z")
    rgba = _unpack(packed["packed_color"], 8, 8, 8, 8)
    colors = placed(rgba[:, :3], *"rgb") if "min_r" in (chunk.dtype.names or ()) else rgba[:, :3]  # older files
    return means, quats, np.exp(scales), rgba[:, 3], colors


def _unpack(words: np.ndarray, *bits: int) -> np.ndarray:
    parts, shift = [], sum(bits)
    for n in bits:
        shift -= n
        parts.append((words >> np.uint32(shift) & np.uint32((1 << n) - 1)) / ((1 << n) - 1))
    return np.stack(parts, 1)


def _fill_in(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Unit quaternions from the index of their largest component and the other three."""
    quats = np.zeros((len(others), 4))
    quats[np.arange(4) != largest[:, None]] = others.ravel()
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    return quats


def _read_splat(data: bytes) -> Parts:
    if len(data) % SPLAT_ROW.itemsize:
        raise ValueError("it does not consist of rows of 32 bytes")
    rows = np.frombuffer(data, SPLAT_ROW)
    rgba = rows["rgba"] / 255
    return rows["mean"], (rows["quat"].astype(float) - 128) / 128, rows["scales"], rgba[:, 3], rgba[:, :3]


def zstandard(path: Path | str) -> Any:
    """The package zstandard: Python before 3.14 has no zstd.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module("zstandard")
    except ImportError as error:
        raise InputError(
            f"{path}: version 4 of .spz needs the package zstandard; install it: pip install 'oasis-warp[spz]'."
        ) from error


def _spz4_streams(data: bytes, widths: Sequence[int]) -> bytes:
    """The attributes of a file of version 4, one after the other."""
    count, n_streams, start = *struct.unpack_from("<I3xB", data, 8), struct.unpack_from("<I", data, 16)[0]
    if n_streams < len(widths):
        raise ValueError(f"{len(widths)} streams are expected, not {n_streams}")
    zstd = zstandard("this file")
    at, streams = start + 16 * n_streams, []
    for k, width in enumerate(widths):
        packed, _ = struct.unpack_from("<QQ", data, start + 16 * k)
        try:  # not more than is due, whatever the stream says of itself
            with zstd.ZstdDecompressor().stream_reader(data[at : at + packed]) as reader:
                streams.append(reader.read(count * width))
        except zstd.ZstdError as error:
            raise ValueError(str(error)) from error
        if len(streams[-1]) != count * width:
            raise ValueError("a stream is too short")
        at += packed
    return b"".join(streams)


def _read_spz(data: bytes) -> Parts:
    """Versions 2 to 4, whose y points up."""
    if data[:4] != SPZ_MAGIC.to_bytes(4, "little"):  # version 4 is not zipped as a whole
        data = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, MAX_BYTES)
    magic, version, count, _, bits = struct.unpack("<IIIBB", data[:14])
    if magic != SPZ_MAGIC or version not in (2, 3, 4):
        raise ValueError(f"versions 2 to 4 are read, not {version}" if magic == SPZ_MAGIC else "it is no .spz")
    if count > MAX_SPLATS:
        raise ValueError(f"at most {MAX_SPLATS} Gaussians are read, not {count}")
    widths, parts, start = (9, 1, 3, 3, 3 if version == 2 else 4), [], 16
    if version == 4:
        data, start = _spz4_streams(data, widths), 0
    for width in widths:
        part = np.frombuffer(data, np.uint8, count * width, start) if count else np.zeros(0, np.uint8)
        parts.append(part.reshape(-1, width).astype(np.int64))
        start += count * width
    places, opacities, colors, scales, rotations = parts
    means = places.reshape(-1, 3, 3) @ [1, 1 << 8, 1 << 16]
    means = np.where(means >= 1 << 23, means - (1 << 24), means) / float(1 << min(bits, 62))
    if version > 2:
        words = rotations @ [1, 1 << 8, 1 << 16, 1 << 24]
        others = np.stack([words >> shift & 0x3FF for shift in (20, 10, 0)], 1)
        others = np.where(others & 0x200, -1, 1) * (others & 0x1FF) / 511 / np.sqrt(2)
        quats = _fill_in(words >> 30, others)
    else:
        quats = _fill_in(np.full(count, 3), rotations / 127.5 - 1)
    x, y, z, w = quats.T
    colors = 0.5 + SH_C0 * (colors / 255 - 0.5) / SPZ_COLOR_SCALE
    # Half a turn about x, from y up: (0, 1, 0, 0) times each quaternion.
    return means * [1, -1, -1], np.stack([-x, w, -z, y], 1), np.exp(scales / 16 - 10), opacities[:, 0] / 255, colors


READERS = {".ply": _read_ply, ".splat": _read_splat, ".spz": _read_spz}
"""By the ending of the file's name."""
