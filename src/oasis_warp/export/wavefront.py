"""The posed mesh as Wavefront .obj, with its material and texture beside it."""

from pathlib import Path

import numpy as np
import torch

from oasis_warp.data.output_files import write_files
from oasis_warp.export import texture
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import photo_axes
from oasis_warp.export.surface_mesh import mesh_normals, mesh_points, topology


def write_obj(request: ExportRequest, path: Path) -> None:
    """NAME.obj, NAME.mtl and NAME_skin.png: upright as in the photo, y up, the wrist at the origin [m].

    All three appear when all are complete.

    Raises:
        InputError: a value is not finite, or a file cannot be written.
    """
    avatar, pose = request.avatar, request.pose or request.avatar.source_pose
    picture_path = path.with_name(f"{path.stem}_skin.png")
    posed, mesh, rotation = avatar.mesh(pose), topology(avatar), photo_axes(avatar.source_camera)
    points = (mesh_points(posed.vertices, avatar.hand, mesh) - posed.joints[0]) @ rotation.to(posed.joints).T
    corners = 1 + mesh.faces[:, :, None].expand(-1, -1, 3).flatten(1)  # the same row of v, vt and vn
    text = (
        f"mtllib {path.stem}.mtl\n{_rows('v', points)}{_rows('vt', mesh.uv)}{_rows('vn', mesh_normals(points, mesh))}"
        f"usemtl skin\n{_lines('f %d/%d/%d %d/%d/%d %d/%d/%d', corners.numpy())}"
    )
    material = f"newmtl skin\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd {picture_path.name}\n"
    picture = texture.encoded(texture.bake_texture(request, request.light or "none", texture.SIZE))
    write_files({path: text.encode(), path.with_suffix(".mtl"): material.encode(), picture_path: picture})


def _rows(name: str, values: torch.Tensor) -> str:
    numbers = values.detach().cpu().numpy()
    return _lines(name + " %.7f" * numbers.shape[1], numbers)


def _lines(pattern: str, values: np.ndarray) -> str:
    return (f"{pattern}\n" * len(values)) % tuple(values.ravel().tolist())
