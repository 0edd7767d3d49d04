import math

import pytest
import torch

from oasis_warp.core.camera import crop_camera, orbit_camera, project
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
