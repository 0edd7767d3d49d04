import math

import numpy as np
import torch
import trimesh

from oasis_warp.core import surface


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
