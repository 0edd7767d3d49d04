"""Spherical harmonics against the textbook and as colours of Gaussians; how much of the sky vertices see."""

import itertools

import numpy as np
import pytest
import torch
import trimesh
from rasterization_scenes import ordinary_scene
from scipy.special import sph_harm_y

from oasis_kernels.scene import sky_exposure as kernels
from oasis_warp.avatar import sky as avatar_sky
from oasis_warp.avatar.sky import harmonic_basis
from oasis_warp.core import rotation, surface
from oasis_warp.core.mirror import mirror_points
from oasis_warp.ops import rasterization, spherical_harmonics
from oasis_warp.ops.depth_map import depth_map
from oasis_warp.ops.sky_exposure import sky_directions, sky_exposure
from oasis_warp.ops.smoothing import smooth_over_faces
from oasis_warp.ops.spherical_harmonics import sh_to_rgb
from oasis_warp.reference import rasterization as reference
from oasis_warp.reference.rasterization import sh_to_rgb as expected_colors

DEGREES = range(4)


def textbook_basis(degree, directions):
    """[N, (degree + 1)^2] in float64 by SciPy; directions [N, 3] need not be unit."""
    x, y, z = torch.nn.functional.normalize(directions.double(), dim=-1).numpy().T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for degree_l in range(degree + 1):
        for m in range(-degree_l, degree_l + 1):
            value = sph_harm_y(degree_l, abs(m), polar, azimuth)  # carries the Condon-Shortley sign
            if m < 0:
                columns.append(np.sqrt(2) * value.imag)
            elif m == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * value.real)
    return torch.from_numpy(np.stack(columns, -1))


@pytest.mark.parametrize("degree", DEGREES)
def test_the_reference_is_the_textbook_basis(degree):
    directions, _ = directions_and_coefficients(degree)
    torch.testing.assert_close(reference.sh_basis(degree, directions), textbook_basis(degree, directions))


def directions_and_coefficients(degree, n=50, seed=0, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    directions = torch.randn(n, 3, generator=g, dtype=torch.float64) * 10 ** torch.empty(n, 1).uniform_(
        -2, 2, generator=g
    )
    coefficients = torch.randn(n, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64)
    return directions.to(dtype), coefficients.to(dtype)


@pytest.mark.parametrize("degree", DEGREES)
def test_sums_are_those_of_the_textbook_basis(degree, device):
    directions, coefficients = directions_and_coefficients(degree)
    expected = (textbook_basis(degree, directions)[..., None] * coefficients).sum(1)
    got = spherical_harmonics(degree, directions.to(device), coefficients.to(device)).cpu()
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("degree", DEGREES)
def test_gradients_are_those_of_finite_differences(degree, device):
    inputs = [t.to(device).requires_grad_() for t in directions_and_coefficients(degree, n=6)]
    inputs[0] = torch.nn.functional.normalize(inputs[0].detach(), dim=-1).mul_(1.7).requires_grad_()
    assert torch.autograd.gradcheck(lambda *given: spherical_harmonics(degree, *given), inputs, nondet_tol=0.0)


def test_further_coefficients_are_not_read_and_get_no_gradient(device):
    directions, coefficients = (t.to(device) for t in directions_and_coefficients(3))
    coefficients.requires_grad_()
    got = spherical_harmonics(1, directions, coefficients)
    assert torch.equal(got, spherical_harmonics(1, directions, coefficients[:, :4]))
    (g,) = torch.autograd.grad(got.sum(), coefficients)
    assert not g[:, 4:].any() and g[:, :4].any()


def test_one_set_of_coefficients_serves_many_directions(device):
    directions, coefficients = (t.to(device) for t in directions_and_coefficients(2))
    views = torch.stack([directions, -directions])
    got = spherical_harmonics(2, views, coefficients)
    assert got.shape == (2, 50, 3)
    assert torch.equal(got[1], spherical_harmonics(2, -directions, coefficients))


def test_length_of_a_direction_does_not_matter_even_at_the_ends_of_float32(device):
    directions, coefficients = (t.to(device) for t in directions_and_coefficients(3, dtype=torch.float32))
    unit = torch.nn.functional.normalize(directions, dim=-1)
    for length in (1e-30, 1e15):
        torch.testing.assert_close(
            spherical_harmonics(3, unit * length, coefficients), spherical_harmonics(3, unit, coefficients),
            rtol=0, atol=1e-5,
        )  # fmt: skip


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("degree", "shape", "words"),
    [(4, (5, 25, 3), "from 0 to 3"), (-1, (5, 4, 3), "from 0 to 3"), (2, (5, 4, 3), "takes 9"),
     (1, (5, 4, 2), r"\[..., K, 3\]"), (1, (4, 4, 3), "broadcast")],
)  # fmt: skip
def test_a_wrong_degree_or_shape_is_refused(degree, shape, words):
    with pytest.raises(ValueError, match=words):
        spherical_harmonics(degree, torch.ones(5, 3), torch.ones(shape))


def scene_and_coefficients(degree=3, cameras=2, dtype=torch.float64, per_camera=False):
    scene = ordinary_scene(11, n=30, cameras=cameras, dtype=dtype)
    g = torch.Generator().manual_seed(12)
    shape = (cameras,) if per_camera else ()
    return scene, torch.randn(*shape, 30, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64).to(dtype)


def draw(scene, colors, **options):
    return rasterization(
        *scene.gaussians, colors, scene.viewmats, scene.Ks, scene.width, scene.height,
        backgrounds=scene.backgrounds, **options,
    )  # fmt: skip


@pytest.mark.parametrize("per_camera", [False, True])
@pytest.mark.parametrize("degree", range(4))
def test_harmonics_are_drawn_as_the_colours_they_stand_for(degree, per_camera, device):
    scene, coefficients = scene_and_coefficients(per_camera=per_camera)
    colors = expected_colors(degree, scene.means, coefficients, scene.viewmats)
    expected, alphas, _ = draw(scene.to(device), colors.to(device))
    got, got_alphas, _ = draw(scene.to(device), coefficients.to(device), sh_degree=degree)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-12)
    assert torch.equal(got_alphas, alphas)


def test_a_far_camera_sees_the_same_colours(device):
    scene, coefficients = scene_and_coefficients(cameras=1, dtype=torch.float32)
    shift = torch.tensor([1024.0, -512.0, 2048.0])
    far = scene.viewmats.double().clone()
    far[:, :3, 3] -= far[:, :3, :3] @ shift.double()
    # Means on a grid that float32 still holds at that distance.
    near = scene.with_(means=(scene.means * 1024).round() / 1024).to(device)
    moved = near.with_(means=near.means + shift.to(device), viewmats=far.to(torch.float32).to(device))
    exact = moved.to("cpu").to(torch.float64)
    exact_colors = expected_colors(3, exact.means, coefficients.double(), exact.viewmats)
    got = sh_to_rgb(3, moved.means, coefficients.to(device), moved.viewmats).cpu()
    assert (got - exact_colors).norm() <= 1e-6 * exact_colors.norm()


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("degree", "shape", "words"),
    [(4, (30, 25, 3), "sh_degree: expected a degree from 0 to 3"), (3, (30, 9, 3), "sh_degree: expected at most"),
     (1, (30, 3), "colors: expected shape"), (1, (30, 4, 5), "colors: expected shape")],
)  # fmt: skip
def test_a_wrong_degree_or_shape_is_refused_by_name(degree, shape, words):
    scene, _ = scene_and_coefficients(dtype=torch.float32)
    with pytest.raises(ValueError, match=words):
        draw(scene, torch.zeros(shape), sh_degree=degree)


@pytest.mark.parametrize("wanted", [(1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
@pytest.mark.parametrize("per_camera", [False, True])
@pytest.mark.parametrize("degree", range(4))
def test_colours_and_their_gradients_are_those_of_the_reference(degree, per_camera, wanted, device):
    scene, coefficients = scene_and_coefficients(cameras=3, per_camera=per_camera)  # more than the degree's
    inputs = [
        t.to(device).clone().requires_grad_(bool(asked))
        for t, asked in zip((scene.means, coefficients, scene.viewmats), wanted, strict=True)
    ]
    leaves = [t for t in inputs if t.requires_grad]
    got, expected = sh_to_rgb(degree, *inputs), expected_colors(degree, *inputs)
    assert (expected == 0).any() and (expected > 0).any()
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-13)
    incoming = torch.randn(got.shape, generator=torch.Generator().manual_seed(3), dtype=got.dtype).to(device)
    expected = expected + 0 * sum(leaf.sum() for leaf in leaves)  # degree 0 depends on the coefficients alone
    for a, b in zip(
        torch.autograd.grad(got, leaves, incoming), torch.autograd.grad(expected, leaves, incoming), strict=True
    ):
        assert (a - b).norm() <= 1e-12 * b.norm()


def test_nothing_to_see_has_no_colours_and_gradients_of_zero(device):
    scene, coefficients = scene_and_coefficients()
    none = scene.means[:0].to(device), coefficients[:0].to(device), scene.viewmats.to(device)
    inputs = [t.clone().requires_grad_() for t in none]
    colors = sh_to_rgb(3, *inputs)
    assert colors.shape == (2, 0, 3)
    gradients = torch.autograd.grad(colors.sum(), inputs)
    assert [g.shape for g in gradients] == [t.shape for t in inputs] and not gradients[2].any()


def test_colours_that_are_no_numbers_stay_so(device):
    scene, coefficients = scene_and_coefficients(dtype=torch.float32)
    coefficients[3, 0, 1] = float("nan")
    colors = sh_to_rgb(3, scene.means.to(device), coefficients.to(device), scene.viewmats.to(device))
    assert colors[:, 3, 1].isnan().all() and colors.isnan().sum() == 2


HALF_TURN = rotation.from_axis_angle(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(torch.pi))


def light(even, x=0.0):
    """Harmonics of a grey light, and of its change along x."""
    harmonics = torch.zeros(9, 3)
    harmonics[0], harmonics[1] = even, x
    return harmonics


def exposed(meshes, harmonics=None, turns=None):
    """Of [B] meshes with one topology; under light that is even, unless given."""
    vertices = torch.stack([vertices for vertices, _ in meshes])
    faces = meshes[0][1]
    normals = torch.stack([surface.vertex_normals(own, faces) for own in vertices])
    harmonics = (light(1.0) if harmonics is None else harmonics).to(vertices)
    turns = vertices.new_tensor([[1.0, 0, 0, 0]]).expand(len(vertices), 4) if turns is None else turns.to(vertices)
    members = torch.arange(vertices.shape[1], dtype=torch.int32, device=vertices.device)
    return sky_exposure(vertices, normals, members, faces, turns, harmonics)


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
    from_wall = light(0.0, 1.0)
    from_wall[:, 1] *= -1  # green light comes from the other side
    found = exposed([(vertices, faces)], from_wall)[0, :n]
    towards, away = vertices[:n, 0] > 0.028, vertices[:n, 0] < -0.028
    even, red, green, blue = found[towards].mean(0)
    assert float(even) < 0.35 and float(red) < 0.25 and float(green) > 0.5
    assert float(blue) == float(red)
    assert float(found[away].min()) > 0.97


def test_nothing_changes_when_surface_and_directions_turn_together(ball_by_wall):
    """Directions that stay in the world make shadows swim while a stiff hand turns."""
    (vertices, faces), n = ball_by_wall
    turn = HALF_TURN.to(vertices) @ rotation.from_axis_angle(torch.tensor([1.0, 0, 0]), torch.tensor(0.4)).to(vertices)
    rotated = vertices @ turn.T + 0.3, faces
    still, moved = exposed([(vertices, faces)]), exposed([rotated], turns=rotation.from_matrix(turn[None]))
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


def exposed_by_depth_maps(vertices, faces, harmonics):
    """The same from perspective depth maps of very far cameras, one for each direction."""
    sky, size, lift, far = sky_directions(vertices.device), kernels.SIZE, kernels.LIFT, 1e4
    vertices = vertices.double()
    normals = surface.vertex_normals(vertices, faces)
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    radius = kernels.MARGIN * (vertices - middle).norm(dim=1).max()
    K = torch.tensor([[far * size / 2, 0, size / 2], [0, far * size / 2, size / 2], [0, 0, 1]]).to(vertices)
    seen, whole = vertices.new_zeros(2, len(vertices), 4)
    lobe = torch.tensor([avatar_sky.LOBE[degree] for degree in avatar_sky.DEGREES])
    radiance = harmonics / lobe[: len(harmonics), None]
    for direction, weight, axes in zip(*sky, strict=True):
        colors = (harmonic_basis(direction.cpu(), len(harmonics)) @ radiance).clamp_min(0).to(vertices)
        viewmat = torch.eye(4).to(vertices)
        viewmat[:3, :3] = axes
        viewmat[:3, 3] = -axes.double() @ middle
        viewmat[2, 3] += far * radius
        depth = depth_map(vertices, faces, viewmat, K, size, size, outputs=("depth",)).depth
        cosine = normals @ direction.double()
        points = (vertices + lift * normals) @ viewmat[:3, :3].T + viewmat[:3, 3]
        place = (points[:, :2] / points[:, 2:]) * K[0, 0] + size / 2 - 0.5
        corner = place.floor()
        tangent = (1 - cosine.square()).clamp_min(0).sqrt() / cosine
        bias = lift + tangent.clamp(max=kernels.STEEPEST) * 2 * radius / size
        share = torch.zeros_like(cosine)
        for column, row in itertools.product((0, 1), (0, 1)):
            at = (corner + corner.new_tensor([column, row])).clamp(0, size - 1).long()
            gap = depth[at[:, 1], at[:, 0]] + bias - points[:, 2]
            weights = (1 - (place - corner - place.new_tensor([column, row])).abs()).prod(1)
            share += weights * (gap / lift + 1).clamp(0, 1)
        arriving = weight * cosine.clamp_min(0)[:, None] * torch.cat([colors.new_ones(1), colors])
        whole += arriving
        seen += torch.where(arriving > 0, arriving * share[:, None], arriving)
    return smooth_over_faces((seen / whole).float()[None], faces)[0]


@pytest.mark.parametrize("count", [4, 9])
def test_each_pair_of_directions_is_drawn_at_once_as_depth_maps_draw_both(ball_by_wall, count):
    """Nearest and farthest depths are of one drawing: a sign, or a buffer, could be that of the other side."""
    (vertices, faces), _ = ball_by_wall
    harmonics = (light(1.0) + 0.3 * torch.randn(9, 3, generator=torch.Generator().manual_seed(0)))[:count]
    own, expected = exposed([(vertices, faces)], harmonics)[0], exposed_by_depth_maps(vertices, faces, harmonics)
    off = (own - expected).abs()
    assert float(off.mean()) < 1e-3 and float(off.max()) < 0.05  # pixels on an edge of the surface


def test_light_that_never_reaches_a_side_is_not_hidden_there(ball):
    """0 over 0 made black patches on the far side of a lamp."""
    vertices, faces = ball
    found = exposed([(vertices, faces)], light(-0.9, -1.0))[0]  # from the left alone
    assert float(found[vertices[:, 0] > 0.079].min()) == 1


def test_wrong_shapes_are_named(ball, as_shipped):
    vertices, faces = ball
    with pytest.raises(ValueError, match="harmonics"):
        sky_exposure(vertices[None], vertices[None], torch.arange(5), faces[:0], torch.eye(4)[:1], torch.ones(5, 3))
