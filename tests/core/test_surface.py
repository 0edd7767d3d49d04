import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from oasis_warp.core import rotation, surface


def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces)), mesh


def test_normals_of_a_sphere_point_outwards():
    vertices, faces, _ = sphere()
    assert float((surface.vertex_normals(vertices, faces) * vertices).sum(-1).min()) > 0.999


def test_vertex_areas_add_up_to_the_surface():
    vertices, faces, mesh = sphere()
    assert math.isclose(float(surface.vertex_areas(vertices, faces).sum()), mesh.area, rel_tol=1e-12)


def test_a_degenerate_face_has_a_zero_normal():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    normals, areas = surface.face_normals(vertices, torch.tensor([[0, 1, 2]]))
    assert torch.equal(normals, torch.zeros(1, 3))
    assert float(areas) == 0


def test_every_edge_is_listed_once():
    _, faces, mesh = sphere()
    edges = surface.mesh_edges(faces)
    assert len(edges) == len(mesh.edges_unique)
    assert bool((edges[:, 0] < edges[:, 1]).all())


def test_smoothing_keeps_constants_and_calms_noise():
    vertices, faces, _ = sphere()
    edges = surface.mesh_edges(faces)
    noise = torch.randn(len(vertices), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(surface.smooth_over_mesh(torch.ones_like(noise), edges, 3), torch.ones_like(noise))
    assert float(surface.smooth_over_mesh(noise, edges, 3).std()) < 0.4 * float(noise.std())


def random_quats(n, seed):
    generator = torch.Generator().manual_seed(seed)
    q = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def test_matrices_agree_with_scipy():
    q = random_quats(100, 0)
    theirs = Rotation.from_quat(q[:, [1, 2, 3, 0]].numpy()).as_matrix()  # SciPy's are xyzw
    torch.testing.assert_close(rotation.to_matrix(q), torch.from_numpy(theirs), atol=1e-14, rtol=0)


def test_scaling_a_quaternion_changes_no_matrix():
    q = random_quats(20, 1)
    torch.testing.assert_close(rotation.to_matrix(3 * q), rotation.to_matrix(q), atol=1e-14, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1.0, math.pi - 1e-7, math.pi])
def test_matrix_to_quaternion_and_back_at_every_angle(angle):
    axes = random_quats(50, 2)[:, 1:]
    axes = axes / axes.norm(dim=-1, keepdim=True)
    matrices = rotation.from_axis_angle(axes, torch.full((50,), angle, dtype=torch.float64))
    quats = rotation.from_matrix(matrices)
    torch.testing.assert_close(rotation.to_matrix(quats), matrices, atol=1e-14, rtol=0)
    assert bool((quats[:, 0] >= 0).all())


def test_multiply_composes_rotations():
    a, b = random_quats(30, 3), random_quats(30, 4)
    composed = rotation.to_matrix(a) @ rotation.to_matrix(b)
    torch.testing.assert_close(rotation.to_matrix(rotation.multiply(a, b)), composed, atol=1e-14, rtol=0)
