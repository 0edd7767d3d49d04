"""`export_avatar`: the file formats and their writers, by the ending of a name."""

from collections.abc import Callable
from pathlib import Path

import torch

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandPose, Photo
from oasis_warp.data.photo import as_photo
from oasis_warp.export import usd
from oasis_warp.export.hand_parameters import write_parameters
from oasis_warp.export.page_file import write_page
from oasis_warp.export.request import ExportRequest, Light
from oasis_warp.export.skinned_gltf import write_skinned_gltf
from oasis_warp.export.splat_formats import (
    write_compressed_ply,
    write_ply,
    write_sog,
    write_splat,
    write_splat_gltf,
    write_spz,
    write_spz4,
)
from oasis_warp.export.surface_mesh import write_obj
from oasis_warp.export.usd import write_skinned_usd, write_splat_usd
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import check_finite
from oasis_warp.ops.checks import check_choice, check_shape

Writer = Callable[[ExportRequest, Path], None]
"""Writes a file atomically. Raises an InputError where it cannot."""

WRITERS: dict[str, Writer] = {
    ".ply": write_ply,
    ".compressed.ply": write_compressed_ply,
    ".splat": write_splat,
    ".spz": write_spz,
    ".v4.spz": write_spz4,
    ".sog": write_sog,
    ".splats.glb": write_splat_gltf,
    ".splats.gltf": write_splat_gltf,
    ".glb": write_skinned_gltf,
    ".gltf": write_skinned_gltf,
    ".obj": write_obj,
    ".json": write_parameters,
    ".html": write_page,
    **{ending: write_skinned_usd for ending in usd.ENDINGS},
    **{f".splats{ending}": write_splat_usd for ending in usd.ENDINGS},
}
"""By the ending of the file's name; the longest that fits wins."""


def choose_writer(path: Path | str) -> Writer:
    """The writer for the name of `path`; capitals mean nothing.

    Raises:
        InputError: no format has this ending.
    """
    name = Path(path).name.lower()
    fitting = [ending for ending in WRITERS if name.endswith(ending) and name != ending]
    if not fitting:
        raise InputError(f"{path}: expected a name that ends in {', '.join(WRITERS)}; rename the output.")
    return WRITERS[max(fitting, key=len)]


@torch.no_grad()
def export_avatar(
    avatar: Avatar,
    path: Path | str,
    *,
    pose: HandPose | str | None = None,
    light: Light | None = None,
    photo: Photo | Path | str | None = None,
) -> None:
    """Write `avatar` in the format that the ending of `path` says; docs/export.md lists them.

    Args:
        avatar: The avatar whose Gaussians or skin are written.
        path: File to write; an existing one is replaced when the new one is complete.
        pose: Pose of the hand, or the name of one, as in `Avatar.held`. By default that of the photo, and in files that
            can be posed the rest pose.
        light: "baked" to write colours as they are in the avatar's light, "none" as in even light, for programs with
            lights of their own. By default "baked" for Gaussians, and "none" for meshes.
        photo: Shown beside the hand in a .html page, or its file; other formats have no place for it.

    Raises:
        InputError: an unknown ending, a value that is not finite, or `path` cannot be written.
        TypeError: `pose` is neither a pose nor a name, or `photo` neither a photo nor a file.
        ValueError: a part of the pose has another shape or is not finite, no pose has that name, or another light.
    """
    writer = choose_writer(path)
    if light is not None:
        check_choice("light", light, ("baked", "none"))
    if pose is not None:
        pose = avatar.as_pose(pose)
        check_shape("pose.angles", pose.angles, 15, 3, hint="One pose a file.")
        check_shape("pose.orientation", pose.orientation, 3, 3)
        check_shape("pose.translation", pose.translation, 3)
        check_finite(**pose._asdict())
        pose = HandPose(*(part.detach().to(avatar.shape).cpu() for part in pose))
    shown = None if photo is None else as_photo(photo)
    writer(ExportRequest(avatar.to("cpu"), pose, light, shown), Path(path))
