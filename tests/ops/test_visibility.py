"""Depth buffer and visibility: known answers and laws, where gradients flow, and batches."""

import math

import pytest
import torch

from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.ops._runtime import depth_buffer

WIDTH, HEIGHT = 37, 26
TAU = 0.05


def soup(seed, n_faces=25, near=False, dtype=torch.float64, device="cpu"):
    """Triangles at random in front of a turned camera; with `near`, also across its plane and behind it."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    depth = 4 * torch.rand(n_faces, 1, generator=generator, dtype=torch.float64) + (-1.5 if near else 2.0)
    centres = torch.cat([0.7 * normal(n_faces, 2), depth], 1)
    in_camera = (centres[:, None] + (1.0 if near else 0.5) * normal(n_faces, 3, 3)).reshape(-1, 3)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = to_matrix(normal(4))
    viewmat[:3, 3] = normal(3)
    vertices = (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3]
    K = torch.tensor([[30.0, 0, 18.3], [0, 28.0, 13.1], [0, 0, 1]], dtype=torch.float64)
    faces = torch.arange(3 * n_faces).view(-1, 3)
    return [vertices.to(device, dtype), faces.to(device), viewmat.to(device, dtype), K.to(device, dtype)]


def some_points(vertices, faces, seed, n=60):
    """Points near the faces: in front of them, on them, behind them."""
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(n, 3, generator=generator, dtype=torch.float64).softmax(-1).to(vertices)
    chosen = torch.randint(len(faces), (n,), generator=generator).to(faces.device)
    jitter = TAU * torch.randn(n, 3, generator=generator, dtype=torch.float64).to(vertices)
    return (weights[..., None] * vertices[faces[chosen]]).sum(1) + jitter


def visible(points, vertices, faces, viewmat, K, **options):
    return depth_visibility(points, vertices, faces, K, viewmat, WIDTH, HEIGHT, **{"tau": TAU, **options})


@pytest.fixture(params=["vectors", "faces"])
def backend(request, monkeypatch):
    """Both ways to fill the buffer: the generic kernels, a thread a face, run on the CPU too."""
    if request.param == "faces":
        monkeypatch.setattr(depth_buffer, "draw_by_vectors", depth_buffer.draw_by_faces)


def test_depth_maps_carry_no_gradient():
    vertices, faces, viewmat, K = soup(1)
    points = some_points(vertices, faces, 1).requires_grad_()
    vertices.requires_grad_()
    assert not any(t.requires_grad for t in depth_map(vertices, faces, viewmat, K, WIDTH, HEIGHT))
    seen = visible(points, vertices, faces, viewmat, K)
    assert seen.visibility.requires_grad and not seen.depth_map.requires_grad and not seen.face_ids.requires_grad


def test_the_literal_formula_has_neither_margin_nor_identity():
    vertices, faces, viewmat, K = soup(2)
    everywhere = torch.arange(len(vertices))
    literal = visible(vertices, vertices, faces, viewmat, K, literal=True, point_vertices=everywhere)
    plain = visible(vertices, vertices, faces, viewmat, K, margin=0.0)
    assert torch.equal(literal.visibility, plain.visibility)
    assert not torch.equal(literal.visibility, visible(vertices, vertices, faces, viewmat, K).visibility)


def test_moving_mesh_points_and_camera_together_changes_nothing():
    vertices, faces, viewmat, K = soup(3)
    points = some_points(vertices, faces, 3)
    rotation = to_matrix(torch.tensor([0.3, -0.8, 0.2, 0.5], dtype=torch.float64))
    shift = torch.tensor([0.4, -1.0, 2.0], dtype=torch.float64)
    moved_view = viewmat.clone()
    moved_view[:3, :3] = viewmat[:3, :3] @ rotation.T
    moved_view[:3, 3] = viewmat[:3, 3] - moved_view[:3, :3] @ shift
    before = visible(points, vertices, faces, viewmat, K)
    after = visible(points @ rotation.T + shift, vertices @ rotation.T + shift, faces, moved_view, K)
    assert torch.equal(before.face_ids, after.face_ids)
    torch.testing.assert_close(before.visibility, after.visibility, rtol=0, atol=1e-10)


def test_the_order_of_faces_and_corners_changes_no_depth():
    vertices, faces, viewmat, K = soup(6, near=True)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    plain = depth_map(vertices, faces, viewmat, K, WIDTH, HEIGHT)
    shuffled = depth_map(vertices, faces[order], viewmat, K, WIDTH, HEIGHT)
    torch.testing.assert_close(plain.depth, shuffled.depth, rtol=1e-12, atol=0)
    assert torch.equal(plain.face_ids >= 0, shuffled.face_ids >= 0)
    assert torch.equal(plain.face_ids[plain.face_ids >= 0].long(), order[shuffled.face_ids[plain.face_ids >= 0].long()])
    for corners in ([1, 2, 0], [0, 2, 1]):  # turned, and wound the other way
        other = depth_map(vertices, faces[:, corners], viewmat, K, WIDTH, HEIGHT)
        assert torch.equal(plain.face_ids, other.face_ids)
        torch.testing.assert_close(plain.depth, other.depth, rtol=1e-12, atol=0)
        torch.testing.assert_close(plain.barycentrics[..., corners], other.barycentrics, rtol=0, atol=1e-10)


def test_of_two_equal_faces_the_first_is_kept(backend):
    vertices, faces, viewmat, K = soup(7)
    twice = depth_map(vertices, torch.cat([faces, faces]), viewmat, K, WIDTH, HEIGHT)
    once = depth_map(vertices, faces, viewmat, K, WIDTH, HEIGHT)
    assert torch.equal(once.face_ids, twice.face_ids) and torch.equal(once.depth, twice.depth)


def test_a_face_through_the_near_plane_is_seen_beyond_it_only(backend):
    # The floor y = 0.5 has depth 20 / (row below the horizon): with the near plane at 2 m, its last rows are too near.
    floor = torch.tensor([[-300.0, 0.5, -300], [300, 0.5, -300], [0, 0.5, 900]], dtype=torch.float64)
    K = torch.tensor([[40.0, 0, 8], [0, 40, 0], [0, 0, 1]], dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64)
    got = depth_map(floor, torch.tensor([[0, 1, 2]]), eye, K, 16, 16, near_plane=2.0)
    below = torch.arange(16) + 0.5
    assert torch.equal(got.face_ids >= 0, (20 / below > 2)[:, None].expand(16, 16))


def test_a_point_that_comes_nearer_along_its_ray_is_never_less_visible():
    vertices, faces, viewmat, K = soup(9)
    points = some_points(vertices, faces, 9)
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    last = torch.zeros(len(points), dtype=torch.float64)
    for share in torch.linspace(1.2, 0.2, 11):
        now = visible(eye + share * (points - eye), vertices, faces, viewmat, K).visibility
        assert ((now >= 0) & (now <= 1)).all() and (now >= last - 1e-12).all()
        last = now


def test_the_containing_pixel_counts_not_the_nearest_centre():
    # Two walls meet at the border of columns 4 and 5; a point just left of it belongs to column 4.
    K = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]], dtype=torch.float64)
    near_wall = torch.tensor([[0.0, -2, 1], [2, -2, 1], [2, 2, 1], [0, 2, 1]], dtype=torch.float64)
    far_wall = torch.tensor([[-6.0, -6, 3], [6, -6, 3], [6, 6, 3], [-6, 6, 3]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    vertices, eye = torch.cat([near_wall, far_wall]), torch.eye(4, dtype=torch.float64)
    columns = torch.tensor([4.9, 5.1], dtype=torch.float64)
    points = torch.stack([(columns - 5) / 10 * 2, torch.zeros(2), torch.full((2,), 2.0)], 1).double()
    seen = depth_visibility(points, vertices, faces, K, eye, 10, 10, tau=0.01).visibility
    assert seen[0] > 0.999 and seen[1] < 0.001


def test_large_values_below_the_limit_are_no_error():
    # Their sum is above it, which is what the kernels look at first.
    vertices, faces, viewmat, K = soup(0)
    vertices[0], points = 0.9e15, some_points(vertices, faces, 0)
    points[1] = -0.9e15
    assert visible(points, vertices, faces, viewmat, K).visibility.isfinite().all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width: expected a whole number of pixels from 1 to 8388608, got 0."),
        ({"height": -3}, "height: expected a whole number of pixels from 1 to 8388608, got -3."),
        ({"near_plane": 0.0}, "near_plane: expected a positive"),
        ({"tau": 0.0}, "tau: expected a positive"),
        ({"tau": math.nan}, "tau: expected a positive"),
        ({"margin": -1.0}, "margin: expected a finite number, 0 or more, got -1.0."),
        ({"margin": math.nan}, "margin: expected a finite number"),
        ({"K": torch.diag(torch.tensor([0.0, 1, 1])).double()}, r"K\[0, 0\]: expected a positive"),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_expected(change, message, as_shipped):
    vertices, faces, viewmat, K = soup(0)
    arguments = {"points": some_points(vertices, faces, 0), "vertices": vertices, "faces": faces, "K": K}
    arguments |= {"viewmat": viewmat, "width": WIDTH, "height": HEIGHT} | change
    with pytest.raises(ValueError, match="^" + message):
        depth_visibility(**arguments)


def test_without_validation_values_that_are_no_numbers_stay_inside_the_buffer():
    scene = soup(1)
    points = some_points(scene[0], scene[1], 1)
    plain, trusted = visible(points, *scene), visible(points, *scene, validate=False)
    assert all(torch.equal(a, b) for a, b in zip(plain, trusted, strict=True))
    for value in (math.nan, math.inf, -math.inf):
        scene[0][0], points[0] = value, value
        broken = visible(points, *scene, validate=False)
        assert broken.visibility[0] == 0 and broken.visibility.isfinite().all()
        assert (broken.face_ids > 0).any()


def test_a_map_gives_masks_normals_and_textured_pictures(device):
    # A tilted wall, coloured by a linear function of the world: interpolation over the picture must return it.
    in_view = torch.tensor([[-0.5, -0.4, 1], [0.8, -0.5, 2], [0.1, 0.6, 1.5]], dtype=torch.float64)
    _, _, viewmat, K = soup(12)
    wall = (in_view - viewmat[:3, 3]) @ viewmat[:3, :3]
    faces = torch.tensor([[0, 1, 2]])
    slope = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.4, -0.7]], dtype=torch.float64)
    values = wall @ slope.T + 1
    seen = depth_map(*(t.to(device) for t in (wall, faces, viewmat, K)), WIDTH, HEIGHT)
    depth, face_ids, barycentrics = (t.cpu() for t in seen)

    mask = face_ids >= 0
    pixels = (in_view[:, :2] / in_view[:, 2:]) * K[[0, 1], [0, 1]] + K[:2, 2]
    (ax, ay), (bx, by), (cx, cy) = pixels.tolist()
    area = abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / 2
    assert abs(int(mask.sum()) - area) < 0.05 * area

    x, y = torch.meshgrid(torch.arange(WIDTH).double() + 0.5, torch.arange(HEIGHT).double() + 0.5, indexing="xy")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1)
    hits = (rays[mask] * depth[mask][:, None] - viewmat[:3, 3]) @ viewmat[:3, :3]
    corners = values[faces[face_ids.clamp_min(0).long()]]
    picture = (corners * barycentrics[..., None]).sum(-2)
    torch.testing.assert_close(picture[mask], hits @ slope.T + 1, rtol=0, atol=1e-10)
    assert not picture[~mask].any()

    normals = torch.nn.functional.normalize(torch.linalg.cross(wall[1] - wall[0], wall[2] - wall[0]), dim=0)[None]
    assert ((hits - wall[0]) * normals[face_ids[mask].long()]).sum(-1).abs().max() < 1e-10


# Gradients and batches


@pytest.fixture(params=["vectors", "points"])
def backward(request, monkeypatch):
    """Both ways to add up gradients at vertices: the generic kernels run on the CPU too."""
    if request.param == "points":
        monkeypatch.setattr(depth_buffer, "vertex_gradients_by_vectors", depth_buffer.vertex_gradients_by_points)


def test_points_that_move_with_a_wall_across_the_view_keep_their_score():
    # Moved by dz along the axis, a wall square to it and points at it stay as far apart.
    wall = torch.tensor([[-9.0, -9, 3], [9, -9, 3], [0, 9, 3]], dtype=torch.float64).requires_grad_()
    points = torch.tensor([[0.1, 0.2, 2.9], [-0.3, 0.1, 2.8]], dtype=torch.float64).requires_grad_()
    K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]], dtype=torch.float64)
    seen = depth_visibility(points, wall, torch.tensor([[0, 1, 2]]), K, torch.eye(4).double(), 16, 16, 0.5)
    by_points, by_wall = torch.autograd.grad(seen.visibility.sum(), [points, wall])
    assert (by_points[:, 2] < -0.01).all() and not by_points[:, :2].any()
    normal = torch.linalg.cross(wall[1] - wall[0], wall[2] - wall[0]).detach()
    assert torch.linalg.cross(by_wall, normal.expand(3, 3)).norm() < 1e-12 * normal.norm()
    torch.testing.assert_close(by_wall[:, 2].sum(), -by_points[:, 2].sum(), rtol=1e-12, atol=0)


def test_no_gradient_comes_where_the_score_is_not_soft(backward):
    wall = torch.tensor([[-0.1, -0.1, 2], [0.1, -0.1, 2], [0, 0.1, 2]], dtype=torch.float64).requires_grad_()
    points = torch.tensor(
        [[0.0, 0.0, 2.0], [0.7, 0.7, 2.0], [0.0, 0.0, -1.0], [9.0, 0.0, 2.0]], dtype=torch.float64
    ).requires_grad_()  # its own vertex is in view; background; behind the camera; outside
    K = torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]], dtype=torch.float64)
    seen = depth_visibility(
        points, wall, torch.tensor([[0, 1, 2]]), K, torch.eye(4).double(), 40, 40, 0.5,
        point_vertices=torch.tensor([2, -1, -1, -1]),
    )  # fmt: skip
    assert seen.visibility.tolist() == [1, 1, 0, 0]
    by_points, by_wall = torch.autograd.grad(seen.visibility.sum(), [points, wall])
    assert not by_points.any() and not by_wall.any()


def batch(n, dtype=torch.float64):
    """Scenes of one mesh: [B, V, 3], faces, [B, 4, 4], [B, 3, 3], [B, P, 3]."""
    scenes = [soup(seed, dtype=dtype) for seed in range(n)]
    faces = scenes[0][1]
    vertices, viewmats, Ks = (torch.stack([scene[k] for scene in scenes]) for k in (0, 2, 3))
    points = torch.stack([some_points(v, faces, seed, n=37) for seed, v in enumerate(vertices)])
    return vertices, faces, viewmats, Ks, points


@pytest.mark.parametrize("kernels", ["vectors", "generic"])
def test_a_batch_equals_its_parts_to_the_bit(dtype, kernels, monkeypatch):
    if kernels == "generic":
        monkeypatch.setattr(depth_buffer, "draw_by_vectors", depth_buffer.draw_by_faces)
        monkeypatch.setattr(depth_buffer, "vertex_gradients_by_vectors", depth_buffer.vertex_gradients_by_points)
    vertices, faces, viewmats, Ks, points = batch(3, dtype)
    known = torch.arange(37) - 1

    def look(points, vertices, viewmats, Ks):
        leaves = [points.clone().requires_grad_(), vertices.clone().requires_grad_()]
        seen = visible(*leaves, faces, viewmats, Ks, point_vertices=known)
        grads = torch.autograd.grad(seen.visibility.square().sum(), leaves)
        return [*seen, *grads, *depth_map(vertices, faces, viewmats, Ks, WIDTH, HEIGHT)]

    together = look(points, vertices, viewmats, Ks)
    for b in range(3):
        alone = look(points[b], vertices[b], viewmats[b], Ks[b])
        assert all(torch.equal(x[b], y) for x, y in zip(together, alone, strict=True))


def test_batches_of_different_sizes_are_refused(as_shipped):
    vertices, faces, viewmats, Ks, points = batch(3)
    with pytest.raises(ValueError, match=r"^viewmat: expected shape \[3, 4, 4\], got \[2, 4, 4\]."):
        depth_map(vertices, faces, viewmats[:2], Ks, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"^points: expected shape \[3, P, 3\], got \[2, 37, 3\]."):
        visible(points[:2], vertices, faces, viewmats, Ks)


@pytest.mark.parametrize("n_batch, n_points, n_faces", [(0, 5, 5), (2, 0, 5), (2, 5, 0), (2, 0, 0)])
def test_empty_axes_give_empty_answers_and_gradients(n_batch, n_points, n_faces, backward):
    vertices, faces, viewmats, Ks, points = batch(2)
    points = points[:n_batch, :n_points].clone().requires_grad_()
    vertices = vertices[:n_batch].clone().requires_grad_()
    seen = visible(points, vertices, faces[:n_faces], viewmats[:n_batch], Ks[:n_batch])
    assert seen.visibility.shape == (n_batch, n_points) and seen.face_ids.shape == (n_batch, HEIGHT, WIDTH)
    by_points, by_vertices = torch.autograd.grad(seen.visibility.sum(), [points, vertices])
    assert by_points.shape == points.shape and by_vertices.shape == vertices.shape
    assert not by_vertices.any() or (n_points and n_faces)
    drawn = depth_map(vertices, faces[:n_faces], viewmats[:n_batch], Ks[:n_batch], WIDTH, HEIGHT)
    assert drawn.barycentrics.shape == (n_batch, HEIGHT, WIDTH, 3)
