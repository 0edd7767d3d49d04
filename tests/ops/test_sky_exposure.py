import numpy as np
import pytest
import torch
import trimesh

from oasis_warp.core import rotation, surface
from oasis_warp.core.mirror import mirror_points
from oasis_warp.ops.sky_exposure import sky_directions, sky_exposure

HALF_TURN = rotation.from_axis_angle(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(torch.pi))


def exposed(meshes, radiance=None, frames=None):
    """Of [B] meshes with one topology; under light that is even, unless given."""
    vertices = torch.stack([vertices for vertices, _ in meshes])
    faces = meshes[0][1]
    normals = torch.stack([surface.vertex_normals(own, faces) for own in vertices])
    n = len(sky_directions(vertices.device).directions)
    radiance = vertices.new_ones(len(vertices), n, 3) if radiance is None else radiance
    frames = torch.eye(3, device=vertices.device).expand(len(vertices), 3, 3) if frames is None else frames
    return sky_exposure(vertices, normals, faces, frames, radiance)


def mesh(made, device):
    return (
        torch.tensor(made.vertices, dtype=torch.float32, device=device),
        torch.tensor(np.array(made.faces), device=device),
    )


@pytest.fixture
def ball(device):
    return mesh(trimesh.creation.icosphere(3, 0.08), device)


@pytest.fixture
def ball_by_wall(device):
    """Beside a wall twice as high, at +x."""
    made = trimesh.creation.icosphere(3, 0.03)
    wall = trimesh.creation.box((0.01, 0.16, 0.16)).subdivide().subdivide().subdivide()
    wall.apply_translation((0.05, 0, 0))
    return mesh(trimesh.util.concatenate([made, wall]), device), len(made.vertices)


def test_means_over_directions_are_those_over_the_sphere():
    directions, weights, axes = sky_directions(torch.device("cpu"))
    x, y, z = directions.double().T
    weights = weights.double()
    assert float(weights.sum()) == pytest.approx(1)
    for power, mean in ((2, 1 / 3), (4, 1 / 5), (6, 1 / 7), (8, 1 / 9)):
        assert float((weights * z**power).sum()) == pytest.approx(mean, abs=1e-6)
    assert float((weights * x**4 * y**2 * z**2).sum()) == pytest.approx(1 / 315, abs=1e-6)  # 3!! 1!! 1!! / 9!!
    mirrored = mirror_points(directions)
    assert float(torch.cdist(mirrored, directions).amin(1).max()) < 1e-6
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand_as(axes), atol=1e-6, rtol=0)
    torch.testing.assert_close(axes[:, 2], -directions)


def test_a_ball_hides_nothing_from_itself(ball):
    assert float(exposed([ball]).min()) > 0.97


def test_a_wall_hides_the_half_of_the_sky_that_lies_behind_it(ball_by_wall):
    (vertices, faces), n = ball_by_wall
    directions = sky_directions(vertices.device).directions
    from_wall = (directions[:, :1] > 0.3).float().repeat(1, 3)
    from_wall[:, 1] = 1 - from_wall[:, 1]
    found = exposed([(vertices, faces)], from_wall[None])[0, :n]
    towards, away = vertices[:n, 0] > 0.028, vertices[:n, 0] < -0.028
    even, red, green, blue = found[towards].mean(0)
    assert float(even) < 0.35 and float(red) < 0.25 and float(green) > 0.5
    assert float(blue) == float(red)
    assert float(found[away].min()) > 0.97


def test_nothing_changes_when_surface_and_directions_turn_together(ball_by_wall):
    """Directions that stay in the world make shadows swim while a stiff hand turns."""
    (vertices, faces), n = ball_by_wall
    turn = HALF_TURN.to(vertices) @ rotation.from_axis_angle(torch.tensor([1.0, 0, 0]), torch.tensor(0.4)).to(vertices)
    turned = vertices @ turn.T + 0.3, faces
    still, moved = exposed([(vertices, faces)]), exposed([turned], frames=turn[None])
    torch.testing.assert_close(moved[0, :n], still[0, :n], atol=0.02, rtol=0)


def test_a_mirror_image_is_lit_as_the_mirror_image(ball_by_wall):
    (vertices, faces), n = ball_by_wall
    plain = exposed([(vertices, faces)])[0, :n]
    left = exposed([(mirror_points(vertices), faces.flip(1))])[0, :n]
    torch.testing.assert_close(left, plain, atol=0.02, rtol=0)


def test_a_surface_is_the_same_in_a_batch_as_alone(ball_by_wall):
    (vertices, faces), _ = ball_by_wall
    other = vertices * 1.1, faces
    together = exposed([(vertices, faces), other])
    alone = torch.stack([exposed([other])[0], exposed([(vertices, faces)])[0]])
    if vertices.is_cuda:  # torch's batched products of matrices round otherwise than single ones
        torch.testing.assert_close(together.flip(0), alone, atol=0.02, rtol=0)
    else:
        assert torch.equal(together.flip(0), alone)


def test_light_that_never_reaches_a_side_is_not_hidden_there(ball):
    """0 over 0 made black patches on the far side of a lamp."""
    vertices, faces = ball
    directions = sky_directions(vertices.device).directions
    from_left = (directions[:, :1] < -0.9).float().repeat(1, 3)
    found = exposed([(vertices, faces)], from_left[None])[0]
    assert float(found[vertices[:, 0] > 0.079].min()) == 1


def test_wrong_shapes_are_named(ball, as_shipped):
    vertices, faces = ball
    with pytest.raises(ValueError, match="radiance"):
        sky_exposure(vertices[None], vertices[None], faces, torch.eye(3)[None], torch.ones(1, 5, 3))
