"""Scenes that break a depth buffer written without care, and the bundled hand against rays."""

import igl
import numpy as np
import pytest
import torch

from oasis_warp.core.hand_model import BACK_SIDE, PALM_SIDE
from oasis_warp.ops import depth_map, depth_visibility

EYE = torch.eye(4, dtype=torch.float64)


def pinhole(focal, width, height, dtype=torch.float64):
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=dtype)


def grid(n, z, spacing, centre=(0.0, 0.0)):
    """A plane of 2 n^2 triangles at depth z, its vertices `spacing` apart."""
    ticks = torch.arange(n + 1, dtype=torch.float64) - n / 2
    y, x = torch.meshgrid(ticks * spacing + centre[1], ticks * spacing + centre[0], indexing="ij")
    vertices = torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3)
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    return vertices, faces


def test_a_plane_through_the_camera_is_seen_up_to_its_horizon(dtype):
    # The floor y = 0.5, from far behind the camera to far before it: at pixel row v its depth is 0.5 f / (v - cy).
    floor = torch.tensor([[-300.0, 0.5, -300], [300, 0.5, -300], [300, 0.5, 300], [-300, 0.5, 300]], dtype=dtype)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    got = depth_map(floor, faces, EYE.to(dtype), pinhole(40.0, 48, 32, dtype), 48, 32).depth
    below = torch.arange(16, 32).double() + 0.5 - 16
    assert got[:16].isinf().all()
    expected = (0.5 * 40 / below)[:, None].expand(16, 48)
    torch.testing.assert_close(got[16:].double(), expected, rtol=1e-7 if dtype == torch.float32 else 1e-12, atol=0)


@pytest.mark.parametrize("shift", [0.0, 0.5, 0.25])
def test_a_closed_grid_has_no_holes_even_where_its_edges_pass_through_pixel_centres(dtype, shift):
    # Vertices lie 1 px apart, moved by `shift` px: at .5, pixel centres fall on vertices but for rounding.
    vertices, faces = grid(40, z=2.0, spacing=0.1, centre=(shift * 0.1, shift * 0.1))
    got = depth_map(vertices.to(dtype), faces, EYE.to(dtype), pinhole(20.0, 32, 32, dtype), 32, 32)
    assert (got.face_ids >= 0).all()
    torch.testing.assert_close(got.depth, torch.full_like(got.depth, 2.0), rtol=1e-7, atol=0)


def test_edges_at_odd_angles_through_pixel_centres_leave_no_hole():
    # A fan round a pixel's centre: that pixel and all on the spokes belong to at least one face.
    generator = torch.Generator().manual_seed(0)
    angles = (6.3 * torch.rand(200, generator=generator, dtype=torch.float64)).sort().values
    rim = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], 1)
    depths = 1 + torch.rand(201, 1, generator=generator, dtype=torch.float64)
    hub = torch.tensor([[0.5 / 40, 0.5 / 40, 1.0]], dtype=torch.float64)
    vertices = torch.cat([hub, (hub + rim)]) * depths
    spokes = torch.arange(1, 201)
    faces = torch.stack([torch.zeros(200, dtype=torch.int64), spokes, spokes.roll(-1)], 1)
    got = depth_map(vertices.float(), faces, EYE.float(), pinhole(40.0, 24, 24, torch.float32), 24, 24)
    assert (got.face_ids >= 0).all()


@pytest.mark.parametrize("focal", [20.0, 33.3, 71.7, 1234.5])
def test_vertices_at_all_pixel_centres_at_random_depths_leave_no_hole(focal):
    # Every pixel is a matter of rounding for the six faces round its vertex, and for their boxes.
    vertices, faces = grid(61, z=1.0, spacing=1.0)
    depths = 0.3 + torch.rand(len(vertices), 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    vertices = torch.cat([vertices[:, :2] / focal, vertices[:, 2:]], 1) * depths
    got = depth_map(vertices, faces, EYE, pinhole(focal, 60, 60), 60, 60)
    assert (got.face_ids >= 0).all()
    torch.testing.assert_close(got.depth, depths.view(62, 62)[1:61, 1:61], rtol=1e-9, atol=0)


def test_points_that_are_not_in_the_picture_are_hidden_and_points_over_the_background_are_seen():
    wall, faces = grid(2, z=2.0, spacing=0.2)
    points = torch.tensor(
        [
            [0.0, 0.0, 0.01],  # on the near plane
            [0.0, 0.0, 0.0],  # in the camera
            [0.0, 0.0, -3.0],  # behind it: must not be mirrored onto the wall
            [5.0, 0.0, 2.0],  # right of the image
            [-5.0, 0.0, 2.0],
            [0.0, -5.0, 2.0],
            [0.0, 5.0, 2.0],
            [-1e14, 1e14, 1.0],  # a pixel that fits in no integer
            [0.7, 0.7, 2.5],  # over the background
            [0.0, 0.0, 1.0],  # before the wall
        ],
        dtype=torch.float64,
    ).requires_grad_()
    vertex = torch.zeros(10, dtype=torch.int64)
    for known in (None, vertex):
        got = depth_visibility(
            points, wall, faces, pinhole(20.0, 16, 16), EYE, 16, 16, tau=0.01, point_vertices=known
        ).visibility
        torch.testing.assert_close(got.detach(), torch.tensor([0.0] * 8 + [1, 1]).double(), rtol=0, atol=1e-12)
        (grad,) = torch.autograd.grad(got.sum(), points)
        assert not grad[:9].any()


def test_a_curved_surface_does_not_shadow_itself():
    # A sphere the size of a hand, 128 px, tau 2 mm: few of its visible points are lost, few of the hidden ones leak.
    n = 120
    polar, azimuth = torch.meshgrid(
        torch.linspace(0.02, np.pi - 0.02, n, dtype=torch.float64),
        torch.linspace(0, 2 * np.pi, 2 * n, dtype=torch.float64),
        indexing="ij",
    )
    sphere = torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], -1).reshape(-1, 3)
    _, faces = grid(2 * n - 1, 0.0, 1.0)
    faces = faces[(faces < n * 2 * n).all(1)]
    vertices = 0.1 * sphere + torch.tensor([0, 0, 0.5])
    facing = -(sphere * torch.nn.functional.normalize(vertices, dim=1)).sum(1)
    for known in (None, torch.arange(len(vertices))):
        scores = depth_visibility(
            vertices, vertices, faces, pinhole(250.0, 128, 128), EYE, 128, 128, tau=0.002, point_vertices=known
        ).visibility
        assert (scores[facing > 0.05] > 0.5).double().mean() > 0.99
        assert (scores[facing < -0.05] > 0.5).double().mean() < 0.05


def palm_view(hand, size, distance=0.5):
    """Vertices and a camera that looks at the palm from below (the palm faces -y)."""
    vertices = hand.template
    centre = (vertices.amin(0) + vertices.amax(0)) / 2
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre + torch.tensor([0, 0, distance])
    return vertices, viewmat, pinhole(2.2 * size, size, size, torch.float32)


@pytest.fixture(scope="module")
def palm(hand):
    """Scores of the hand's vertices from below, how squarely each faces the camera, and its camera."""
    vertices, viewmat, K = palm_view(hand, 256)
    scores = depth_visibility(
        vertices, vertices, hand.faces, K, viewmat, 256, 256, point_vertices=torch.arange(len(vertices))
    ).visibility
    normals = torch.from_numpy(igl.per_vertex_normals(vertices.double().numpy(), hand.faces.numpy()))
    eye = (-viewmat[:3, :3].T @ viewmat[:3, 3]).double()
    facing = (normals * torch.nn.functional.normalize(eye - vertices.double(), dim=1)).sum(1)
    return scores, facing, eye


def test_a_palm_view_shows_the_palm_and_not_the_back(hand, palm):
    scores, facing, _ = palm
    assert (scores[(facing > 0.1) & (hand.region == PALM_SIDE)] > 0.5).double().mean() > 0.99
    # What leaks is the far side of finger tips that are thinner than the margin of 4.5 mm.
    back = scores[(facing < -0.1) & (hand.region == BACK_SIDE)]
    assert (back > 0.5).double().mean() < 0.06 and (back > 0.95).double().mean() < 0.01


def test_rays_agree_about_which_vertices_of_the_hand_are_seen(hand, palm):
    scores, facing, eye = palm
    # Away from the contour and from the margin, where a score of 0.5 is a matter of half a pixel.
    clear = ((facing.abs() > 0.1) & ((scores - 0.5).abs() > 0.4)).nonzero()[:, 0]
    chosen = clear[torch.randperm(len(clear), generator=torch.Generator().manual_seed(0))[:300]]
    # In millimetres: libigl takes triangles of a square millimetre in metres for degenerate ones.
    vertices, faces, eye = 1000 * hand.template.double().numpy(), hand.faces.numpy(), 1000 * eye.numpy()
    agree = []
    for i in chosen.tolist():
        towards = (eye - vertices[i]) / np.linalg.norm(eye - vertices[i])
        hits = igl.ray_mesh_intersect(vertices[i], towards, vertices, faces) or []
        # What is nearer than the margin, the vertex's own faces among it, is no obstacle.
        blocked = any(distance > 4.5 and i not in faces[f] for f, distance, _, _ in hits)
        agree.append((scores[i] < 0.5).item() == blocked)
    assert len(agree) == 300 and np.mean(agree) > 0.98
