"""The avatar file: safetensors with a JSON header, so that loading one executes no code.

The tables `TENSORS`, `LIGHT`, `SHADE`, `FINE_SHADE`, `ALBEDO` and `INVENTED` describe the tensors. The metadata have
one entry, "oasis-avatar": the header, a JSON object whose `version` is 5, or less in files without light (1), shade
(2), shade per Gaussian (3) or light that the hand hides from itself (4). Files of newer versions are refused. There is
only one entry because safetensors writes several in any order, and the same avatar must give the same bytes.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import save
from torch import Tensor

from oasis_warp import __version__
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import write_file
from oasis_warp.data.tensor_file import open_tensors
from oasis_warp.ops.checks import check_finite, check_shape

FORMAT = "oasis-avatar"
VERSION = 5
LIGHT_HIDDEN = 5
"""First version whose light is fitted with what the hand hides of it."""
HARMONICS = (4, 9)
"""Rows that `light.harmonics` may have."""
UNIT_TOLERANCE = 1e-3
UNITS = {"length": "m", "angle": "rad", "quaternion": "wxyz", "color": "sRGB in [0, 1]", "camera": "OpenCV"}


class Entry(NamedTuple):
    """Type and shape of a tensor of the file."""

    dtype: torch.dtype
    shape: tuple[int | str, ...]
    """A letter has one value over the whole file; "N" is P + Q."""


TENSORS = {
    # The hand the Gaussians ride on: the hand model that the header names, shaped, plus what the outline adds.
    "shape": Entry(torch.float32, ("S",)),
    "surface_offsets": Entry(torch.float32, ("V", 3)),
    # The Gaussians at rest: P ride on vertices, then Q on faces.
    "gaussians.vertex_index": Entry(torch.int64, ("P",)),
    "gaussians.offsets": Entry(torch.float32, ("P", 3)),
    "gaussians.face_index": Entry(torch.int64, ("Q",)),
    "gaussians.barycentrics": Entry(torch.float32, ("Q", 3)),
    "gaussians.quats": Entry(torch.float32, ("N", 4)),
    "gaussians.scales": Entry(torch.float32, ("N", 3)),
    "gaussians.opacities": Entry(torch.float32, ("N",)),
    "gaussians.colors": Entry(torch.float32, ("N", 3)),
    # What the photo showed.
    "source_pose.angles": Entry(torch.float32, (15, 3)),
    "source_pose.orientation": Entry(torch.float32, (3, 3)),
    "source_pose.translation": Entry(torch.float32, (3,)),
    "source_camera.viewmat": Entry(torch.float32, (4, 4)),
    "source_camera.K": Entry(torch.float32, (3, 3)),
}
LIGHT = {
    # The photo's light, where it is not part of the colours: all of it or nothing.
    "light.harmonics": Entry(torch.float32, ("K", 3)),
    "light.limits": Entry(torch.float32, (2, 3)),
    "light.even": Entry(torch.float32, (3,)),
}
SHADE = {
    # What that light does not tell: both, or neither.
    "light.shade": Entry(torch.float32, ("V", 3)),
    "light.facing": Entry(torch.float32, ("V", 3)),
}
FINE_SHADE = {
    # As SHADE, of each Gaussian: with it, or not at all.
    "gaussians.shade": Entry(torch.float32, ("N", 3)),
}
ALBEDO = {
    # Where the hand hides light from itself: with any light, or not at all.
    "light.albedo": Entry(torch.float32, (3,)),
}
INVENTED = {
    # Where skin is painted because no photo shows it: with anything, or not at all.
    "invented": Entry(torch.float32, ("V",)),
}
HEADER = {"version": int, "side": str, "hand_model": str, "hand_licence": str, "source_camera": dict}
"""Required keys of a header and their types; `source_camera` holds `width` and `height` [px]."""


def save_avatar(path: Path | str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write an avatar file atomically.

    Args:
        path: Path of the file; an existing one is replaced.
        tensors: One for every name of `TENSORS`, of `LIGHT` or none of them, then of `SHADE` or none, then of
            `FINE_SHADE` or none, and with `LIGHT` that of `ALBEDO` or none; that of `INVENTED` or none. On any device.
        header: The keys of `HEADER` and any others; `version`, `units`, `counts` and `creator` are filled in.

    Raises:
        ValueError: a tensor or header key is missing, unknown or out of bounds.
        InputError: `path` cannot be written.
    """
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    sizes = _check_tensors(stored)
    counts = {"gaussians": sizes["N"], "on_vertices": sizes["P"], "on_faces": sizes["Q"]}
    creator = f"oasis_warp {__version__}"
    full = {**header, "version": VERSION, "units": UNITS, "counts": counts, "creator": creator}
    _check_header(full)
    write_file(path, save(stored, {FORMAT: json.dumps(full, allow_nan=False, sort_keys=True)}))


def load_avatar(path: Path | str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of an avatar file, on the CPU, and its header.

    Raises:
        InputError: the file is missing, no avatar, of a newer version or truncated, or a tensor or header key is
            missing, unknown or out of bounds.
    """
    path = Path(path)
    with open_tensors(path, "an avatar file", "`oasis reconstruct` writes one") as file:
        text = (file.metadata() or {}).get(FORMAT)
        if text is None:
            raise InputError(f"{path}: a safetensors file, but no avatar; give the one `oasis reconstruct` wrote.")
        header = _read_header(path, text)
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    try:
        _check_tensors(tensors)
    except ValueError as error:
        raise _damaged(path, error) from error
    return tensors, header


def _damaged(path: Path, error: ValueError) -> InputError:
    return InputError(f"{path}: a damaged avatar file ({str(error).rstrip('.')}); reconstruct it again.")


def _read_header(path: Path, text: str) -> dict[str, Any]:
    try:
        header = json.loads(text)
        version = header.get("version") if isinstance(header, dict) else None
        if isinstance(version, int) and version > VERSION:  # before any other check
            raise InputError(
                f"{path}: avatar file of version {version}, but {VERSION} is the last known here; update oasis-warp."
            )
        _check_header(header)
    except InputError:
        raise
    except ValueError as error:  # json.JSONDecodeError is one
        raise _damaged(path, error) from error
    return header


def _check_header(header: Any) -> None:
    if not isinstance(header, dict):
        raise ValueError(f"header: expected a JSON object, got {type(header).__name__}")
    for key, kind in HEADER.items():
        if not isinstance(header.get(key), kind):
            raise ValueError(f"header: expected {key!r} of type {kind.__name__}, got {header.get(key)!r}")
    if header["version"] not in range(1, VERSION + 1):
        raise ValueError(f"header: expected version 1 to {VERSION}, got {header['version']}")
    if header["side"] not in ("left", "right"):
        raise ValueError(f"header: expected side 'left' or 'right', got {header['side']!r}")
    size = [header["source_camera"].get(key) for key in ("width", "height")]
    if not all(isinstance(n, int) and n > 0 for n in size):
        raise ValueError(f"header: expected a source_camera with a positive width and height, got {size}")


def _check_tensors(tensors: Mapping[str, Tensor]) -> dict[str, int]:
    """Check the tensors against the tables; the size of each letter."""
    table = dict(TENSORS)
    parts = (LIGHT, SHADE, FINE_SHADE)
    for k, part in enumerate(parts):  # each needs those before it
        if tensors.keys() & set().union(*parts[k:]):
            table |= part
    if tensors.keys() & ALBEDO.keys():
        table |= LIGHT | ALBEDO
    if tensors.keys() & INVENTED.keys():
        table |= INVENTED
    missing, unknown = table.keys() - tensors.keys(), tensors.keys() - table.keys()
    if missing or unknown:
        found = {"missing": missing, "unknown": unknown}
        raise ValueError("tensors: " + "; ".join(f"{k} {', '.join(sorted(v))}" for k, v in found.items() if v))
    sizes: dict[str, int] = {}
    for name, entry in table.items():
        check_shape(name, tensors[name], *entry.shape, sizes=sizes)
        if tensors[name].dtype != entry.dtype:
            raise ValueError(f"{name}: expected {entry.dtype}, got {tensors[name].dtype}")
        if entry.dtype.is_floating_point:
            check_finite(**{name: tensors[name]})
    if sizes["N"] != sizes["P"] + sizes["Q"]:
        raise ValueError(f"gaussians: expected {sizes['P']} + {sizes['Q']} rows, got {sizes['N']}")
    _check_gaussians(tensors)
    return sizes


def _check_gaussians(tensors: Mapping[str, Tensor]) -> None:
    """Refuse values for which rendering would fail or give an empty picture."""
    n_vertices = len(tensors["surface_offsets"])
    vertices = tensors["gaussians.vertex_index"]
    good = {
        "gaussians.vertex_index": ((vertices >= 0) & (vertices < n_vertices), f"indices of {n_vertices} vertices"),
        "gaussians.face_index": (tensors["gaussians.face_index"] >= 0, "no negative index"),
        "gaussians.quats": (tensors["gaussians.quats"].norm(dim=1) > 1e-6, "no zero quaternion"),
        "gaussians.scales": ((tensors["gaussians.scales"] > 0).all(1), "positive scales"),
        "gaussians.opacities": (
            tensors["gaussians.opacities"].clamp(0, 1) == tensors["gaussians.opacities"],
            "opacities in [0, 1]",
        ),
    }
    if "light.limits" in tensors:
        rows = len(tensors["light.harmonics"])
        if rows not in HARMONICS:
            raise ValueError(f"light.harmonics: expected {HARMONICS[0]} or {HARMONICS[1]} rows, got {rows}")
        limits = tensors["light.limits"]
        good["light.limits"] = (limits > 0) & (limits[0] <= limits[1]), "the least, above 0, over the most"
        good["light.even"] = tensors["light.even"] > 0, "light"
    if "light.albedo" in tensors:
        good["light.albedo"] = (tensors["light.albedo"] >= 0) & (tensors["light.albedo"] <= 1), "reflectances in [0, 1]"
    if "invented" in tensors:
        good["invented"] = (tensors["invented"] >= 0) & (tensors["invented"] <= 1), "shares in [0, 1]"
    if "light.shade" in tensors:
        good["light.shade"] = (tensors["light.shade"] > 0).all(1), "factors above 0"
        good["light.facing"] = (tensors["light.facing"].norm(dim=1) - 1).abs() < UNIT_TOLERANCE, "unit vectors"
    if "gaussians.shade" in tensors:
        good["gaussians.shade"] = (tensors["gaussians.shade"] > 0).all(1), "factors above 0"
    for name, (ok, expected) in good.items():
        if not bool(ok.all()):
            raise ValueError(f"{name}: expected {expected}, got {int((~ok).sum())} bad rows of {len(ok)}")
