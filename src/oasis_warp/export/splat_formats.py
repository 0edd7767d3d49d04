"""Writers of Gaussians as splat files, for viewers and engines.

- .ply of 3D Gaussian splatting (Kerbl et al. 2023), which every viewer reads.
- .compressed.ply: 16 bytes a Gaussian and 72 for 256 of them (PlayCanvas, SuperSplat).
- .spz: 20 bytes, packed (github.com/nianticlabs/spz).
- .splat: 32 bytes, most important first (github.com/antimatter15/splat).
- .sog, version 2: lossless pictures in a ZIP, a pixel a Gaussian (developer.playcanvas.com).
- glTF with the ratified extension KHR_gaussian_splatting.
"""

import gzip
import io
import json
import math
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import torch

from oasis_warp import __version__
from oasis_warp.core.color import linear_light
from oasis_warp.data.output_files import write_file
from oasis_warp.data.splat_files import SH_C0, SPLAT_ROW, SPZ4_HEADER, SPZ_COLOR_SCALE, SPZ_MAGIC, zstandard
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.skinned_gltf import VERTICES, GltfBuffer, write_gltf
from oasis_warp.export.splats import largest_component, morton_order, posed_splats, view_harmonics, y_down

MIN_OPACITY = 1e-6
"""Distance of opacities from 0 and 1, where their logits end."""
PLY_COLUMNS = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


def write_ply(request: ExportRequest, path: Path) -> None:
    """One float32 row a Gaussian: log scales, logit opacities, wxyz; y down and z forward, as trained scenes have it.

    Colours are the constant harmonic of sRGB, and 15 more where they depend on the view.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    splats, harmonics = y_down(posed_splats(request)), view_harmonics(request)
    opacities = splats.opacities.clamp(MIN_OPACITY, 1 - MIN_OPACITY).logit()
    if harmonics is None:
        harmonics = (splats.colors[:, None] - 0.5) / SH_C0
    rest = harmonics[:, 1:].mT.flatten(1)  # those of red first
    parts = (
        splats.means, torch.zeros_like(splats.means), harmonics[:, 0], rest, opacities[:, None], splats.scales.log(),
        splats.quats,
    )  # fmt: skip
    columns = (*PLY_COLUMNS[:9], *(f"f_rest_{k}" for k in range(rest.shape[1])), *PLY_COLUMNS[9:])
    rows = torch.cat(parts, 1).numpy().astype("<f4")
    write_file(path, ply_header(("vertex", len(rows), "float", columns)) + np.ascontiguousarray(rows).tobytes())


def ply_header(*elements: tuple[str, int, str, tuple[str, ...]]) -> bytes:
    """Header of a binary PLY; each element is a name, a number of rows, a type and columns.

    Without comments: importers of some engines stumble over them.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, n_rows, kind, columns in elements:
        lines += [f"element {name} {n_rows}", *(f"property {kind} {column}" for column in columns)]
    return "\n".join([*lines, "end_header\n"]).encode()


CHUNK = 256
"""Gaussians that share a box, neighbours in space."""
CHUNK_RANGES = tuple(
    f"{end}_{name}" for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max") for name in names
)  # fmt: skip
PACKED_COLUMNS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def write_compressed_ply(request: ExportRequest, path: Path) -> None:
    """Means, log scales and colours within the range of their chunk, in 11, 10, 11 and 8 bits; y down and z forward.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    means, quats, scales, opacities, colors = (part.double().numpy() for part in y_down(posed_splats(request)))
    order = morton_order(means)
    chunk = np.arange(len(means)) // CHUNK
    starts = np.arange(0, len(means), CHUNK)
    ranges, shares = [], []
    for values in (means[order], np.log(scales[order]), colors[order]):
        # Rounded first, because readers place values between the float32 ends.
        least, most = (f.reduceat(values, starts).astype("<f4") for f in (np.minimum, np.maximum))
        ranges += [least, most]
        width = np.maximum(most.astype(float) - least, np.finfo(np.float32).tiny)
        shares.append(np.clip((values - least[chunk]) / width[chunk], 0, 1))
    rgba = np.concatenate([shares[2], opacities[order, None]], 1)
    columns = (pack(shares[0], 11, 10, 11), _ply_quats(quats[order]), pack(shares[1], 11, 10, 11), pack(rgba, *[8] * 4))
    header = ply_header(("chunk", len(starts), "float", CHUNK_RANGES), ("vertex", len(means), "uint", PACKED_COLUMNS))
    write_file(path, header + np.concatenate(ranges, 1).tobytes() + np.stack(columns, 1).astype("<u4").tobytes())


def pack(shares: np.ndarray, *bits: int) -> np.ndarray:
    """Columns in [0, 1] as numbers of so many bits each, the first in the highest."""
    packed = np.zeros(len(shares), np.uint32)
    for column, n in zip(shares.T, bits, strict=True):
        packed = packed << n | np.round(column * ((1 << n) - 1)).astype(np.uint32)
    return packed


def _ply_quats(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz, [N, 4], as 32 bits: the index of the largest component, then the others."""
    largest, others = largest_component(quats)
    return pack(np.concatenate([largest[:, None] / 3, np.clip(others / np.sqrt(2) + 0.5, 0, 1)], 1), 2, 10, 10, 10)


ZSTD_LEVEL = 19
"""Level of zstd: the highest that needs no more memory to read."""
FRACTION_BITS = 20
"""Fraction bits of means: steps of 0.95 um and a reach of 8 m. The reference encoder's 12 are steps of 0.24 mm, as far
apart as the lines of skin."""
SCALE_STEPS, SCALE_ZERO = 16, -10
"""A byte holds SCALE_STEPS (log scale - SCALE_ZERO): steps of 6 %, from 45 um on."""
QUAT_STEPS = 511
"""Steps of the three smaller components; each has 9 bits and a sign."""


def write_spz(request: ExportRequest, path: Path) -> None:
    """Version 3: means in fixed point, quaternions as their three smaller components, all else as bytes; y up.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    count, streams = _spz_streams(request)
    header = struct.pack("<IIIBBBB", SPZ_MAGIC, 3, count, 0, FRACTION_BITS, 0, 0)
    # No time, so that equal avatars are equal bytes.
    write_file(path, gzip.compress(header + b"".join(streams), 9, mtime=0))


def write_spz4(request: ExportRequest, path: Path) -> None:
    """Version 4: the same in a stream of zstd each, after a header of 32 bytes and the sizes of the streams.

    Raises:
        InputError: zstandard is missing, a value is not finite, or `path` cannot be written.
    """
    packer = zstandard(path).ZstdCompressor(level=ZSTD_LEVEL)
    count, streams = _spz_streams(request)
    packed = [packer.compress(stream) for stream in streams]
    head = SPZ_MAGIC, 4, count, 0, FRACTION_BITS, 0, len(streams), SPZ4_HEADER
    sizes = [struct.pack("<QQ", len(small), len(stream)) for small, stream in zip(packed, streams, strict=True)]
    write_file(path, struct.pack("<IIIBBBBI", *head).ljust(SPZ4_HEADER, b"\0") + b"".join([*sizes, *packed]))


def _spz_streams(request: ExportRequest) -> tuple[int, list[bytes]]:
    """Number of Gaussians; their means, opacities, colours, scales and quaternions."""
    means, quats, scales, opacities, colors = (part.double().numpy() for part in posed_splats(request))
    order = morton_order(means)
    fixed = np.round(means[order] * (1 << FRACTION_BITS)).astype("<i4")
    parts = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        to_bytes(255 * opacities[order]),
        to_bytes(255 * (SPZ_COLOR_SCALE * (colors[order] - 0.5) / SH_C0 + 0.5)),
        to_bytes(SCALE_STEPS * (np.log(scales[order]) - SCALE_ZERO)),
        _spz_quats(quats[order]),
    )
    return len(means), [np.ascontiguousarray(part).tobytes() for part in parts]


def to_bytes(values: np.ndarray) -> np.ndarray:
    """The nearest bytes."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _spz_quats(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz, [N, 4], as 32 bits: the index of the largest of xyzw, then sign and size of the others."""
    largest, others = largest_component(quats[:, [1, 2, 3, 0]])
    packed = largest.astype(np.uint32)
    for column in others.T:
        size = np.round(np.abs(column) * np.sqrt(2) * QUAT_STEPS).astype(np.uint32)
        packed = packed << 10 | (column < 0).astype(np.uint32) << 9 | np.minimum(size, QUAT_STEPS)
    return packed.astype("<u4")


def write_splat(request: ExportRequest, path: Path) -> None:
    """Means and scales as float32, colours, opacities and quaternions wxyz as bytes; y down and z forward.

    Sorted by volume times opacity, so that a part of the file already looks right.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    means, quats, scales, opacities, colors = (part.numpy() for part in y_down(posed_splats(request)))
    order = np.argsort(-scales.prod(1) * opacities, kind="stable")
    rows = np.zeros(len(order), SPLAT_ROW)
    rows["mean"], rows["scales"] = means[order], scales[order]
    rows["rgba"] = to_bytes(255 * np.concatenate([colors, opacities[:, None]], 1)[order])
    rows["quat"] = to_bytes(128 + 128 * quats[order])
    write_file(path, rows.tobytes())


SOG_LEVELS = 256
"""Levels of scales and colours, evenly spaced: steps of 1 to 2 % of a scale, and finer than a byte of a colour."""
LARGEST_ALPHA = 252
"""Alpha of a quaternion whose largest component is the first of wxyz."""
LOSSLESS = (cv2.IMWRITE_WEBP_QUALITY, 101)
FIRST_DAY = (1980, 1, 1, 0, 0, 0)
"""Date of the files in the ZIP, so that equal avatars are equal bytes."""


def write_sog(request: ExportRequest, path: Path) -> None:
    """Means in 16 bits of their logarithm, all else in bytes; y down and z forward, as in .ply.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    means, quats, scales, opacities, colors = (part.double().numpy() for part in y_down(posed_splats(request)))
    order = morton_order(means)
    places = np.sign(means) * np.log1p(np.abs(means))
    least, most = places.min(0), places.max(0)
    fixed = np.round((places[order] - least) / np.maximum(most - least, 1e-12) * 65535).astype(np.uint16)
    largest, others = largest_component(quats[order])
    smaller = to_bytes(255 * (others / math.sqrt(2) + 0.5))
    scale_levels, scale_bytes = _sog_levels(np.log(scales[order]))
    color_levels, color_bytes = _sog_levels((colors[order] - 0.5) / SH_C0)
    pictures = {
        "means_l.webp": (fixed & 255).astype(np.uint8),
        "means_u.webp": (fixed >> 8).astype(np.uint8),
        "scales.webp": scale_bytes,
        "quats.webp": np.concatenate([smaller, (LARGEST_ALPHA + largest)[:, None].astype(np.uint8)], 1),
        "sh0.webp": np.concatenate([color_bytes, to_bytes(255 * opacities[order, None])], 1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": f"oasis_warp {__version__}"},
        "count": len(means),
        "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_levels, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_levels, "files": ["sh0.webp"]},
    }
    contents = {"meta.json": json.dumps(meta).encode(), **{name: _webp(rows) for name, rows in pictures.items()}}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in contents.items():
            archive.writestr(zipfile.ZipInfo(name, FIRST_DAY), data)
    write_file(path, stream.getvalue())


def _sog_levels(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Evenly spaced levels between the least and the greatest value, and the nearest one of each value."""
    levels = np.linspace(values.min(), values.max(), SOG_LEVELS)
    step = max(levels[1] - levels[0], 1e-12)
    return levels.tolist(), to_bytes((values - levels[0]) / step)


def _webp(rows: np.ndarray) -> bytes:
    """A picture of about as many rows as columns, with these pixels, [N, 3 or 4], row by row."""
    width = math.ceil(math.sqrt(len(rows)))
    pixels = np.zeros((-(-len(rows) // width) * width, rows.shape[1]), np.uint8)
    pixels[: len(rows)] = rows
    pixels = pixels.reshape(-1, width, rows.shape[1])
    order = cv2.COLOR_RGBA2BGRA if rows.shape[1] == 4 else cv2.COLOR_RGB2BGR
    return cv2.imencode(".webp", cv2.cvtColor(pixels, order), LOSSLESS)[1].tobytes()


GLTF_EXTENSION = "KHR_gaussian_splatting"


def write_splat_gltf(request: ExportRequest, path: Path) -> None:
    """Points with scales [m], opacities in [0, 1], quaternions xyzw and the constant harmonic of sRGB; y up.

    Programs without the extension show coloured points.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    splats = posed_splats(request)
    means, quats, scales, opacities, colors = (part.numpy().astype("<f4") for part in splats)
    seen = np.concatenate([linear_light(splats.colors.clamp(0, 1)).numpy(), opacities[:, None]], 1)
    buffer = GltfBuffer()
    attributes = {
        "POSITION": buffer.add(means, "VEC3", target=VERTICES),
        "COLOR_0": buffer.add(np.round(255 * seen).astype("u1"), "VEC4", target=VERTICES, normalized=True),
        f"{GLTF_EXTENSION}:ROTATION": buffer.add(quats[:, [1, 2, 3, 0]], "VEC4", target=VERTICES),
        f"{GLTF_EXTENSION}:SCALE": buffer.add(scales, "VEC3", target=VERTICES),
        f"{GLTF_EXTENSION}:OPACITY": buffer.add(opacities, "SCALAR", target=VERTICES),
        f"{GLTF_EXTENSION}:SH_DEGREE_0_COEF_0": buffer.add((colors - 0.5) / np.float32(SH_C0), "VEC3", target=VERTICES),
    }
    looks = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    points = {"mode": 0, "attributes": attributes, "extensions": {GLTF_EXTENSION: looks}}
    document = {
        "extensionsUsed": [GLTF_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "hand", "mesh": 0}],
        "meshes": [{"name": "hand", "primitives": [points]}],
    }
    write_gltf(path, document, buffer)
