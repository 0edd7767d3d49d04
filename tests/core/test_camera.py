"""Cameras, surfaces and backgrounds."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from oasis_warp.core import color, rotation, surface
from oasis_warp.core.camera import crop_camera, orbit_camera, project
from oasis_warp.core.color import plain_background
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.types import Camera


@pytest.fixture
def points():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(200, 3, generator=generator) * torch.tensor([0.09, 0.04, 0.05]) + torch.tensor([0.1, -0.2, 0.6])


@pytest.fixture
def camera():
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.01, 0.02, 0.03])
    return Camera(viewmat, torch.tensor([[500.0, 0, 170], [0, 510, 220], [0, 0, 1]]), 320, 480)


@pytest.mark.parametrize("azimuth", [0.0, 0.7, math.pi, 5.0])
@pytest.mark.parametrize("elevation", [0.0, 0.6, -1.2])
def test_orbit_frames_every_point(points, azimuth, elevation):
    view = orbit_camera(points, azimuth, elevation, size=100)
    uv, depth = project(view, points)
    assert bool((depth > 0).all())
    assert bool(((uv > 0) & (uv < 100)).all())


def test_orbit_at_zero_looks_along_z_with_y_down(points):
    torch.testing.assert_close(orbit_camera(points, 0.0).viewmat[:3, :3], torch.eye(3))


def test_orbit_moves_left_with_azimuth_and_up_with_elevation(points):
    middle = (points.amin(0) + points.amax(0)) / 2

    def position(camera):
        return -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3] - middle

    assert float(position(orbit_camera(points, 0.3))[0]) < 0
    assert float(position(orbit_camera(points, 0.0, 0.3))[1]) < 0  # y points down


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-0.6, 0.8, 0.9)])
def test_orbit_goes_around_the_part_of_up_that_the_picture_shows(points, up):
    """A hand that points to the side was seen along its arm from 90 degrees."""
    up = torch.tensor(up)
    torch.testing.assert_close(orbit_camera(points, 0.0, up=up).viewmat[:3, :3], torch.eye(3))
    shown = torch.nn.functional.normalize(up * torch.tensor([1.0, 1.0, 0.0]), dim=0)
    for azimuth in (0.3, math.pi / 2, math.pi):
        view = orbit_camera(points, azimuth, up=up).viewmat[:3, :3]
        torch.testing.assert_close(view @ shown, shown)  # where it was in the picture
        upright = orbit_camera(points, azimuth).viewmat[:3, :3]
        assert float(view[2, 2]) == pytest.approx(float(upright[2, 2]), abs=1e-6)  # as far around
    raised = orbit_camera(points, 0.0, 0.3, up=up).viewmat[2, :3]
    assert float(raised @ shown) == pytest.approx(-math.sin(0.3), abs=1e-6)


@pytest.mark.parametrize("up", [(0.0, 0.0, 0.0), (0.01, 0.01, -1.0)])
def test_orbit_goes_around_the_vertical_where_up_points_along_the_view(points, up):
    turned = orbit_camera(points, 0.7, 0.2, up=torch.tensor(up))
    assert torch.equal(turned.viewmat, orbit_camera(points, 0.7, 0.2).viewmat)


def test_a_crop_shows_the_same_points_moved_and_scaled(points, camera):
    uv, _ = project(camera, points)
    cropped, _ = project(crop_camera(camera, 30.5, 40.0, 200.0, 100), points)
    torch.testing.assert_close(cropped, (uv - torch.tensor([30.5, 40.0])) * 0.5, atol=1e-3, rtol=0)


def test_the_mirrored_camera_sees_the_mirrored_world_mirrored(points, camera):
    uv, depth = project(camera, points)
    mirrored, mirrored_depth = project(mirror_camera(camera), points * torch.tensor([-1.0, 1, 1]))
    torch.testing.assert_close(mirrored[:, 0], camera.width - uv[:, 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(mirrored[:, 1], uv[:, 1], atol=1e-3, rtol=0)
    torch.testing.assert_close(mirrored_depth, depth)


@pytest.mark.parametrize("azimuth", [0.0, 0.7, 2.0, -1.3])
@pytest.mark.parametrize("elevation", [-0.6, 0.4])
def test_an_orbit_keeps_its_height_and_its_horizon_all_the_way_round(points, azimuth, elevation):
    camera = orbit_camera(points, azimuth, elevation)
    middle = (points.amin(0) + points.amax(0)) / 2
    position = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3] - middle
    direction = position / position.norm()
    expected = torch.tensor([
        -math.sin(azimuth) * math.cos(elevation), -math.sin(elevation), -math.cos(azimuth) * math.cos(elevation),
    ])  # fmt: skip
    torch.testing.assert_close(direction, expected, atol=1e-5, rtol=0)
    assert abs(float(camera.viewmat[0, 1])) < 1e-6  # the picture's x axis is level


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


COLOR = (0.25, 0.5, 1.0)


def test_every_camera_gets_the_color(device):
    for dtype in (torch.float32, torch.float64):
        made = plain_background(COLOR, 2, torch.zeros(1, dtype=dtype, device=device))
        assert torch.equal(made, torch.tensor([COLOR, COLOR], dtype=dtype, device=device))


def test_one_color_is_one_tensor_and_others_are_others(device):
    like = torch.zeros(3, device=device)
    first = plain_background(COLOR, 1, like)
    assert plain_background(COLOR, 1, like + 1) is first
    others = [plain_background((0.25, 0.5, 0.0), 1, like), plain_background(COLOR, 1, like.double())]
    assert all(other is not first for other in others) and len(plain_background(COLOR, 2, like)) == 2


def test_what_inference_mode_made_can_be_saved_for_a_gradient(monkeypatch):
    monkeypatch.setattr(color, "_kept", {})
    with torch.inference_mode():
        made = plain_background(COLOR, 1, torch.zeros(1))
    leaf = torch.ones(3, requires_grad=True)
    assert torch.equal(torch.autograd.grad((leaf * made).sum(), leaf)[0], made[0])


def test_a_traced_call_neither_keeps_nor_gets_what_is_kept(monkeypatch):
    monkeypatch.setattr(color, "_kept", {})
    like = torch.zeros(1)
    with torch.device("meta"):  # a mode, which may be watching
        made = plain_background(COLOR, 2, like)
    assert torch.equal(made, torch.tensor([COLOR, COLOR])) and not color._kept


def test_no_more_is_kept_than_the_limit(monkeypatch):
    monkeypatch.setattr(color, "_kept", {})
    like = torch.zeros(1)
    for value in range(color.MAX_KEPT + 3):
        assert plain_background((value / 7,), 1, like).item() == pytest.approx(value / 7)
    assert len(color._kept) == color.MAX_KEPT


@pytest.mark.gpu
def test_a_graph_that_is_captured_fills_its_own(monkeypatch):
    monkeypatch.setattr(color, "_kept", {})
    like = torch.zeros(1, device="cuda")
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        made = plain_background(COLOR, 1, like)
    assert not color._kept
    graph.replay()
    assert made.tolist() == [list(COLOR)]
