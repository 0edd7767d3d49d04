"""The avatar file: safetensors with a JSON header, so that loading one executes no code.

The tables `TENSORS`, `LIGHT`, `SHADE`, `FINE_SHADE`, `ALBEDO`, `DOUBT` and `INVENTED` describe the tensors. The
metadata have one entry, "oasis-avatar": the header, a JSON object whose `version` is 8, or less in files without light
(1), shade (2), shade per Gaussian (3), light that the hand hides from itself (4), doubt (5), light through the skin (6)
or dark hollows (7). Files of newer versions are refused. There is only one entry because safetensors writes several in
any order, and the same avatar must give the same bytes.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from safetensors.torch import save
from torch import Tensor

from oasis_warp import __version__
from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.rotation import is_rotation
from oasis_warp.data.json_text import read_json, whole
from oasis_warp.data.output_files import write_file
from oasis_warp.data.tensor_file import open_tensors, tensor_shapes

FORMAT = "oasis-avatar"
VERSION = 8
DARK_HOLLOWS = 8
"""First version whose light arrives in hollows as in photos."""
HARMONICS = (4, 9)
"""Rows that `light.harmonics` may have."""
UNIT_TOLERANCE = 1e-3
UNITS = {"length": "m", "angle": "rad", "quaternion": "wxyz", "color": "sRGB in [0, 1]", "camera": "OpenCV"}
MAX_GAUSSIANS = 4_000_000
"""Forty times what the largest photos give; with all their tensors they fill .5 GB."""
MAX_SIDE = 4096
"""Largest side of the source camera's picture, which `edit` draws, and of a painted picture [px]."""
MAX_NUMBER = 1e9
"""Bound of indices; their true bounds are the hand model's."""


class Entry(NamedTuple):
    """Type, shape and range of a tensor of the file."""

    dtype: torch.dtype
    shape: tuple[int | str, ...]
    """A letter has one value over the whole file; "N" is P + Q."""
    low: float
    high: float
    """Range of the values, up to ten times what avatars of photos have: beyond it there is no hand."""


SHARE = (-UNIT_TOLERANCE, 1 + UNIT_TOLERANCE)
TENSORS = {
    # The surface that Gaussians are bound to: the shaped hand model of the header, plus what the outline adds.
    "shape": Entry(torch.float32, ("S",), -10, 10),
    "surface_offsets": Entry(torch.float32, ("V", 3), -0.05, 0.05),
    # The Gaussians at rest: P bound to vertices, then Q to faces.
    "gaussians.vertex_index": Entry(torch.int64, ("P",), 0, MAX_NUMBER),
    "gaussians.offsets": Entry(torch.float32, ("P", 3), -0.2, 0.2),
    "gaussians.face_index": Entry(torch.int64, ("Q",), 0, MAX_NUMBER),
    "gaussians.barycentrics": Entry(torch.float32, ("Q", 3), *SHARE),
    "gaussians.quats": Entry(torch.float32, ("N", 4), -2, 2),
    "gaussians.scales": Entry(torch.float32, ("N", 3), 1e-8, 0.1),
    "gaussians.opacities": Entry(torch.float32, ("N",), 0, 1),
    "gaussians.colors": Entry(torch.float32, ("N", 3), *SHARE),
    # What the photo showed.
    "source_pose.angles": Entry(torch.float32, (15, 3), -2 * math.pi, 2 * math.pi),
    "source_pose.orientation": Entry(torch.float32, (3, 3), -1 - UNIT_TOLERANCE, 1 + UNIT_TOLERANCE),
    "source_pose.translation": Entry(torch.float32, (3,), -100, 100),
    "source_camera.viewmat": Entry(torch.float32, (4, 4), -100, 100),
    "source_camera.K": Entry(torch.float32, (3, 3), -1e6, 1e6),
}
LIGHT = {
    # The photo's light, where it is not part of the colours: all of it or nothing.
    "light.harmonics": Entry(torch.float32, ("K", 3), -100, 100),
    "light.limits": Entry(torch.float32, (2, 3), 1e-6, 100),
    "light.even": Entry(torch.float32, (3,), 1e-6, 100),
}
SHADE = {
    # What that light does not tell: both, or neither.
    "light.shade": Entry(torch.float32, ("V", 3), 1e-6, 1e4),
    "light.facing": Entry(torch.float32, ("V", 3), -1 - UNIT_TOLERANCE, 1 + UNIT_TOLERANCE),
}
FINE_SHADE = {
    # As SHADE, of each Gaussian: with it, or not at all.
    "gaussians.shade": Entry(torch.float32, ("N", 3), 1e-6, 1e4),
}
ALBEDO = {
    # Where the hand hides light from itself: with any light, or not at all.
    "light.albedo": Entry(torch.float32, (3,), 0, 1),
}
DOUBT = {
    # Where the photo that the shade is of may show something else: with SHADE, or not at all.
    "light.doubt": Entry(torch.float32, ("V",), 0, 1),
}
INVENTED = {
    # Where skin is painted because no photo shows it: with anything, or not at all.
    "invented": Entry(torch.float32, ("V",), 0, 1),
}
HEADER = {"version": int, "side": str, "hand_model": str, "hand_licence": str, "source_camera": dict}
"""Required keys of a header and their types; `source_camera` holds `width` and `height` [px]."""
CAMERA = {"width", "height"}
PINHOLE = ((1, 0, 1), (0, 1, 1), (0, 0, 1))
"""Where a camera's matrix may be other than 0."""


def save_avatar(path: Path | str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write an avatar file atomically.

    Args:
        path: Path of the file; an existing one is replaced.
        tensors: One for every name of `TENSORS`, of `LIGHT` or none of them, then of `SHADE` or none, then of
            `FINE_SHADE` or none, and with `LIGHT` that of `ALBEDO` or none, with `SHADE` that of `DOUBT` or none;
            that of `INVENTED` or none. On any device.
        header: The keys of `HEADER` and any others; `version`, `units`, `counts` and `creator` are filled in.

    Raises:
        ValueError: a tensor or header key is missing, unknown or out of bounds.
        InputError: `path` cannot be written.
    """
    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    sizes = _check_shapes({name: (tensor.dtype, tensor.shape) for name, tensor in stored.items()}, {})
    _check_values(stored, sizes)
    counts = {"gaussians": sizes["N"], "on_vertices": sizes["P"], "on_faces": sizes["Q"]}
    creator = f"oasis_warp {__version__}"
    full = {**header, "version": VERSION, "units": UNITS, "counts": counts, "creator": creator}
    _check_header(full)
    write_file(path, save(stored, {FORMAT: json.dumps(full, allow_nan=False, sort_keys=True)}))


def read_avatar_header(path: Path | str) -> dict[str, Any]:
    """The header of an avatar file.

    Raises:
        InputError: the file is missing, or no avatar of a version that is known.
    """
    with open_tensors(Path(path), "an avatar file", "`oasis reconstruct` writes one") as file:
        return _header_of(Path(path), file)


def _header_of(path: Path, file: Any) -> dict[str, Any]:
    text = (file.metadata() or {}).get(FORMAT)
    if text is None:
        raise InputError(f"{path}: a safetensors file, but not an avatar; give one that `oasis reconstruct` wrote.")
    return _read_header(path, text)


def load_avatar(
    path: Path | str, hand_models: Mapping[str, Mapping[str, int]] = MappingProxyType({})
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors of an avatar file, on the CPU, and its header.

    Args:
        path: Path of the file.
        hand_models: Of those that it may belong to, what the letters S and V must be, and F, the number of faces; any
            if empty.

    Raises:
        InputError: the file is missing, no avatar, of a newer version, of another hand model or truncated, or a tensor
            or header key is missing, unknown or out of bounds.
    """
    path = Path(path)
    with open_tensors(path, "an avatar file", "`oasis reconstruct` writes one") as file:
        header = _header_of(path, file)
        if hand_models and header["hand_model"] not in hand_models:
            name = shortened(repr(header["hand_model"]))
            raise InputError(f"{path}: made with the hand model {name}, which is not installed; reconstruct it again.")
        sizes = hand_models.get(header["hand_model"], {})
        try:
            found = _check_shapes(tensor_shapes(file), sizes)  # before memory is taken for them
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            _check_values(tensors, found)
        except ValueError as error:
            raise _damaged(path, error) from error
    return tensors, header


def _damaged(path: Path, error: ValueError) -> InputError:
    return InputError(f"{path}: a damaged avatar file ({str(error).rstrip('.')}); reconstruct it again.")


def _read_header(path: Path, text: str) -> dict[str, Any]:
    try:
        header = read_json(text)
        version = header.get("version")
        if isinstance(version, int) and version > VERSION:  # before any other check
            raise InputError(
                f"{path}: avatar file of version {version}, newer than the known {VERSION}; update oasis-warp."
            )
        _check_header(header)
    except InputError:
        raise
    except ValueError as error:
        raise _damaged(path, error) from error
    return header


def _check_header(header: Mapping[str, Any]) -> None:
    for key, kind in HEADER.items():
        if type(header.get(key)) is not kind:
            got = shortened(repr(header.get(key)))
            raise ValueError(f"header: expected {key!r} of type {kind.__name__}, got {got}")
    if not whole(header["version"], 1, VERSION):
        raise ValueError(f"header: expected version 1 to {VERSION}, got {header['version']}")
    if header["side"] not in ("left", "right"):
        raise ValueError(f"header: expected side 'left' or 'right', got {shortened(repr(header['side']))}")
    camera = header["source_camera"]
    if camera.keys() != CAMERA or not all(whole(camera[key], 1, MAX_SIDE) for key in CAMERA):
        expected = f"a source_camera with a positive width and height up to {MAX_SIDE}"
        raise ValueError(f"header: expected {expected}, got {shortened(repr(camera))}")


def _check_shapes(
    given: Mapping[str, tuple[torch.dtype | None, Sequence[int]]], sizes: Mapping[str, int]
) -> dict[str, int]:
    """Check types and shapes against the tables; the size of each letter."""
    table = dict(TENSORS)
    parts = (LIGHT, SHADE, FINE_SHADE)
    for k, part in enumerate(parts):  # each needs those before it
        if given.keys() & set().union(*parts[k:]):
            table |= part
    if given.keys() & ALBEDO.keys():
        table |= LIGHT | ALBEDO
    if given.keys() & DOUBT.keys():
        table |= LIGHT | SHADE | DOUBT
    if given.keys() & INVENTED.keys():
        table |= INVENTED
    found = {"missing": table.keys() - given.keys(), "unknown": given.keys() - table.keys()}
    if any(found.values()):
        named = (f"{what} {shortened(', '.join(sorted(names)))}" for what, names in found.items() if names)
        raise ValueError("tensors: " + "; ".join(named))
    known = dict(sizes)
    for name, entry in table.items():
        dtype, shape = given[name]
        expected = [known.get(size, size) if isinstance(size, str) else size for size in entry.shape]
        known |= {a: n for a, n in zip(entry.shape, shape, strict=False) if isinstance(a, str) and a not in known}
        if [known.get(size, size) for size in entry.shape] != list(shape):
            raise ValueError(f"{name}: expected shape [{', '.join(map(str, expected))}], got {list(shape)}")
        if dtype != entry.dtype:
            raise ValueError(f"{name}: expected {entry.dtype}, got {dtype}")
    if known["N"] != known["P"] + known["Q"]:
        raise ValueError(f"gaussians: expected {known['P']} + {known['Q']} rows, got {known['N']}")
    if not 1 <= known["N"] <= MAX_GAUSSIANS:
        raise ValueError(f"gaussians: expected 1 to {MAX_GAUSSIANS}, got {known['N']}")
    if known.get("K", HARMONICS[0]) not in HARMONICS:
        raise ValueError(f"light.harmonics: expected {HARMONICS[0]} or {HARMONICS[1]} rows, got {known['K']}")
    return known


def _check_values(tensors: Mapping[str, Tensor], sizes: Mapping[str, int]) -> None:
    """Refuse values that no hand has, for which drawing would fail or give an empty picture."""
    bounds = {"gaussians.vertex_index": sizes["V"] - 1, "gaussians.face_index": sizes.get("F", MAX_NUMBER) - 1}
    for name, entry in (TENSORS | LIGHT | SHADE | FINE_SHADE | ALBEDO | DOUBT | INVENTED).items():
        if name not in tensors:
            continue
        low, high, values = entry.low, min(entry.high, bounds.get(name, entry.high)), tensors[name]
        bad = ~((values >= low) & (values <= high))  # NaN is neither
        if bool(bad.any()):
            worst = values[bad][0].item()
            what = f"{int(bad.sum())} of {values.numel()} beyond, such as {worst:g}"
            raise ValueError(f"{name}: expected values from {low:g} to {high:g}, got {what}")
    _check_units(tensors)


def _check_units(tensors: Mapping[str, Tensor]) -> None:
    """Refuse quaternions, directions, rotations, weights and a camera that are none."""
    view, K = tensors["source_camera.viewmat"], tensors["source_camera.K"]
    norms = tensors["gaussians.quats"].norm(dim=1)
    good = {
        "gaussians.quats": ((norms > 0.1) & (norms < 10), "quaternions, about of length 1"),
        "gaussians.barycentrics": (_is_near(tensors["gaussians.barycentrics"].sum(1), 1.0), "weights that sum to 1"),
        "source_pose.orientation": (is_rotation(tensors["source_pose.orientation"]), "a rotation"),
        "source_camera.viewmat": (
            is_rotation(view[:3, :3]) & (view[3] == view.new_tensor([0, 0, 0, 1])).all(), "a rotation and a shift",
        ),
        "source_camera.K": (
            (K.diagonal() >= 1).all() & (K == K.new_tensor(PINHOLE) * K).all() & (K[2, 2] == 1), "a camera in pixels",
        ),
    }  # fmt: skip
    if "light.limits" in tensors:
        limits = tensors["light.limits"]
        good["light.limits"] = limits[0] <= limits[1], "the least over the most"
    if "light.facing" in tensors:
        good["light.facing"] = _is_near(tensors["light.facing"].norm(dim=1), 1.0), "unit vectors"
    for name, (ok, expected) in good.items():
        if not bool(ok.all()):
            raise ValueError(f"{name}: expected {expected}, got {int((~ok).sum())} bad rows of {ok.numel()}")


def _is_near(values: Tensor, goal: Tensor | float) -> Tensor:
    return (values - goal).abs() < UNIT_TOLERANCE
