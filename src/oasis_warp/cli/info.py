"""`oasis info`: the contents of avatar files."""

from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from oasis_warp.cli.options import Info
from oasis_warp.cli.progress import print_tables
from oasis_warp.cli.report import to_json
from oasis_warp.core.errors import InputError
from oasis_warp.core.surface import vertex_areas
from oasis_warp.data.avatar_file import read_avatar_header
from oasis_warp.data.output_files import write_file
from oasis_warp.hand_avatar import Avatar

FACTS = {
    "side": ("side", "{}"),
    "hand_model": ("hand model", "{}"),
    "version": ("file version", "{}"),
    "creator": ("created by", "{}"),
    "megabytes": ("file size", "{:.1f} MB"),
    "n_gaussians": ("Gaussians", "{}"),
    "median_size_mm": ("median size of a Gaussian", "{:.2f} mm"),
    "length_mm": ("wrist to middle fingertip", "{:.0f} mm"),
    "breadth_mm": ("breadth across the knuckles", "{:.0f} mm"),
    "painted_percent": ("surface inpainted", "{:.0f} %"),
    "light": ("light", "{}"),
    "photo_px": ("crop of the photo", "{} px"),
}
"""Name and form of every fact."""
MIDDLE_TIP, INDEX_BASE, LITTLE_BASE = 2, 1, 7
"""Row of the tips, and joints."""


def run(options: Info) -> int:
    """Print a table with a column for each avatar.

    Raises:
        InputError: no avatar, or a wrong file.
    """
    if not options.avatars:
        raise InputError("avatars: expected at least one avatar.safetensors, got none; name it after `oasis info`.")
    facts = {str(path): describe(path)[1] for path in options.avatars}
    table = Table(show_header=len(facts) > 1)
    for heading in ("", *facts):
        table.add_column(heading, overflow="fold")
    for key, (name, form) in FACTS.items():
        table.add_row(name, *("-" if own[key] is None else form.format(own[key]) for own in facts.values()))
    print_tables([table], 80)
    if options.json is not None:
        write_file(options.json, to_json(facts).encode())
    return 0


@torch.no_grad()
def describe(path: Path) -> tuple[Avatar, dict[str, Any]]:
    """An avatar and its facts; None where it has none.

    Raises:
        InputError: it is no avatar file.
    """
    header, avatar = read_avatar_header(path), Avatar.load(path)
    rest, hand = avatar.rest, avatar.hand
    painted = None
    if avatar.invented is not None:
        areas = vertex_areas(rest.vertices, hand.faces)
        painted = float((areas * avatar.invented).sum() / areas.sum() * 100)
    return avatar, {
        "side": avatar.side,
        "hand_model": header["hand_model"],
        "hand_licence": header["hand_licence"],
        "version": header["version"],
        "creator": header.get("creator"),
        "megabytes": path.stat().st_size / 1e6,
        "n_gaussians": len(avatar.gaussians.opacities),
        "median_size_mm": float(avatar.gaussians.scales.amax(1).median()) * 1000,
        "length_mm": float((rest.tips[MIDDLE_TIP] - rest.joints[0]).norm()) * 1000,
        "breadth_mm": float((rest.joints[INDEX_BASE] - rest.joints[LITTLE_BASE]).norm()) * 1000,
        "painted_percent": painted,
        "light": _light(avatar),
        "photo_px": avatar.source_camera.width,
    }


def _light(avatar: Avatar) -> str:
    if avatar.light is None:
        return "none stored"
    hidden = "" if avatar.light.albedo is None else " with self-occlusion"
    return f"{len(avatar.light.harmonics)} spherical harmonics{hidden}"
