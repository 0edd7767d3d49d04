"""Compile the kernels that an avatar needs ahead of time, so that the wait can be shown."""

import torch

from oasis_warp.ops.blend_weights import blend_weights
from oasis_warp.ops.contact import ContactTables, contact_shifts
from oasis_warp.ops.corner_reading import Corners, read_corners
from oasis_warp.ops.face_rotations import face_rotations
from oasis_warp.ops.gaussian_light import light_gaussians
from oasis_warp.ops.mesh_posing import pose_on_mesh
from oasis_warp.ops.rasterization import rasterization
from oasis_warp.ops.skinning import skin
from oasis_warp.ops.sky_exposure import sky_exposure
from oasis_warp.ops.vertex_light import Coarse, InPhoto, Rules, light_vertices
from oasis_warp.ops.visibility import depth_visibility


def warm_up(device: torch.device | str = "cpu") -> None:
    """Run the float32 forward of every operator that makes and draws an avatar once, on a tetrahedron.

    The first time on a machine this compiles the kernels into the kernel cache, within a minute; afterwards it takes
    milliseconds.
    """
    vertices = torch.tensor([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1], [0, 0, 1.1]], device=device)
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], device=device)
    thirds = torch.full((4, 3), 1 / 3, device=device)
    quats = torch.tensor([[1.0, 0, 0, 0]], device=device).expand(4, 4).contiguous()
    scales = torch.full((4, 3), 0.02, device=device)
    ones = torch.ones(4, device=device)
    viewmat = torch.eye(4, device=device)
    K = torch.tensor([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]], device=device)
    with torch.no_grad():
        skin(vertices, None, ones[:, None], viewmat[None])
        turned = face_rotations(vertices, vertices, faces)
        each = torch.arange(4, device=device)
        posed = pose_on_mesh(vertices, faces, each, thirds, turned.vertex_quats, turned.area_ratio, quats, scales)
        each, none = each.int(), each[:1, None].int()
        sky = sky_exposure(vertices[None], vertices[None], each, faces, quats[:1], ones.new_ones(9, 3))
        coarse = Coarse(each, each[:, None], Corners(each[:, None].expand(4, 3), thirds))
        rules = Rules(1.0, *[(1.0, 1.0, 1.0)] * 3, *map(float, range(len(Rules._fields) - 4)))
        photo = InPhoto(vertices, None, None, ones)
        read_corners(sky, coarse.corners)
        columns = light_vertices(vertices[None], scales, scales[:2], rules, coarse, sky, ones[:3], photo=photo)
        light_gaussians(columns, coarse.corners, thirds, thirds, (0.0, 1.0))
        whole = ContactTables(each, 4 * each[:2], 0 * each, none, none, none, ones, 4 * each, each, ones)
        contact_shifts(vertices[None], faces, whole, False)
        depth_visibility(vertices, vertices, faces, K, viewmat, 16, 16)
        blend_weights(*posed, ones, viewmat, K, 16, 16)
        rasterization(*posed, ones, thirds, viewmat[None], K[None], 16, 16, backgrounds=ones[None, :3])
