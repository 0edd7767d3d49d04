"""Gradients of the soft score by points and vertices, and the op as torch sees it: compiled, checked, once only."""

import pytest
import torch
from test_visibility import HEIGHT, TAU, WIDTH, some_points, soup, visible

from oasis_warp.core.types import Camera
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.ops._runtime import depth_buffer
from oasis_warp.reference import visibility as twin


@pytest.fixture(params=["vectors", "points"])
def backward_way(request, monkeypatch):
    """Both ways to sum up for the vertices: the one for CUDA runs on the CPU too."""
    if request.param == "points":
        monkeypatch.setattr(depth_buffer, "vertex_gradients_by_vectors", depth_buffer.vertex_gradients_by_points)


def twin_gradients(points, vertices, faces, viewmat, K, weights):
    points, vertices = (t.detach().double().requires_grad_() for t in (points, vertices))
    camera = Camera(viewmat.double(), K.double(), WIDTH, HEIGHT)
    scores = twin.depth_visibility(points, vertices, faces, camera, tau=TAU, margin=3 * TAU)
    return torch.autograd.grad((scores * weights).sum(), [points, vertices])


@pytest.mark.parametrize("seed", range(3))
def test_both_gradients_are_those_of_the_twin(seed, dtype, device, backward_way):
    vertices, faces, viewmat, K = soup(seed, dtype=dtype)
    points = some_points(vertices, faces, seed)
    weights = torch.randn(len(points), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    want = twin_gradients(points, vertices, faces, viewmat, K, weights)
    leaves = [t.to(device).requires_grad_() for t in (points, vertices)]
    seen = visible(*leaves, faces.to(device), viewmat.to(device), K.to(device))
    got = torch.autograd.grad((seen.visibility * weights.to(device, dtype)).sum(), leaves)
    tolerance = 5e-6 if dtype == torch.float32 else 1e-10
    for a, b in zip(got, want, strict=True):
        assert b.norm() > 0.1
        assert (a.cpu().double() - b).norm() <= tolerance * b.norm()


def test_the_score_passes_gradcheck_in_points_and_vertices():
    vertices, faces, viewmat, K = soup(5)
    points = some_points(vertices, faces, 5, n=16)
    # Differences are safe away from the borders of pixels, where the buffer jumps, and from edges of faces there.
    camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixel = camera[:, :2] / camera[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    points = points[((pixel - pixel.round()).abs() > 1e-3).all(-1)]
    assert len(points) > 12
    barycentrics = depth_map(vertices, faces, viewmat, K, WIDTH, HEIGHT).barycentrics
    assert barycentrics[barycentrics.any(-1)].abs().min() > 1e-5
    leaves = (points.requires_grad_(), vertices.requires_grad_())

    def score(points, vertices):
        return visible(points, vertices, faces, viewmat, K).visibility

    assert torch.autograd.gradcheck(score, leaves)


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


def test_no_gradient_comes_where_the_score_is_not_soft(backward_way):
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


def test_what_needs_no_gradient_gets_none_and_costs_nothing_to_keep():
    vertices, faces, viewmat, K = soup(1)
    points = some_points(vertices, faces, 1)
    assert not visible(points, vertices, faces, viewmat, K).visibility.requires_grad
    for wanted in (0, 1):
        leaves = [points.clone(), vertices.clone()]
        leaves[wanted].requires_grad_()
        visible(*leaves, faces, viewmat, K).visibility.sum().backward()
        assert leaves[wanted].grad.any() and leaves[1 - wanted].grad is None
    camera = viewmat.clone().requires_grad_()
    assert not visible(points, vertices, faces, camera, K).visibility.requires_grad


def test_the_vertices_gradient_is_the_same_every_time(backward_way, with_threads):
    vertices, faces, viewmat, K = soup(2, dtype=torch.float32)
    points = some_points(vertices, faces, 2, n=3000)

    def gradient():
        leaf = vertices.clone().requires_grad_()
        visible(points, leaf, faces, viewmat, K).visibility.sum().backward()
        return leaf.grad

    first = gradient()
    for n_threads in (1, 2, 3):
        assert torch.equal(first, with_threads(n_threads, gradient))


def batch(n, dtype=torch.float64):
    """Scenes of one mesh: [B, V, 3], faces, [B, 4, 4], [B, 3, 3], [B, P, 3]."""
    scenes = [soup(seed, dtype=dtype) for seed in range(n)]
    faces = scenes[0][1]
    vertices, viewmats, Ks = (torch.stack([scene[k] for scene in scenes]) for k in (0, 2, 3))
    points = torch.stack([some_points(v, faces, seed, n=37) for seed, v in enumerate(vertices)])
    return vertices, faces, viewmats, Ks, points


@pytest.mark.parametrize("way", ["vectors", "plain"])
def test_a_batch_equals_its_parts_to_the_bit(dtype, way, monkeypatch):
    if way == "plain":
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


def test_what_has_no_batch_axis_is_shared_and_its_gradient_summed():
    vertices, faces, viewmats, Ks, points = batch(3)
    mesh, asked = vertices[0].clone().requires_grad_(), points[0].clone().requires_grad_()
    shared = visible(asked, mesh, faces, viewmats, Ks[0])
    whole = visible(asked.expand(3, -1, -1), mesh.expand(3, -1, -1), faces, viewmats, Ks[:1].expand(3, -1, -1))
    assert shared.visibility.shape == (3, 37) and shared.depth_map.shape == (3, HEIGHT, WIDTH)
    assert all(torch.equal(a, b) for a, b in zip(shared, whole, strict=True))
    got = torch.autograd.grad(shared.visibility.sum(), [asked, mesh])
    parts = [visible(asked, mesh, faces, viewmat, Ks[0]).visibility.sum() for viewmat in viewmats]
    want = torch.autograd.grad(sum(parts), [asked, mesh])
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_batches_of_different_sizes_are_refused(as_shipped):
    vertices, faces, viewmats, Ks, points = batch(3)
    with pytest.raises(ValueError, match=r"^viewmat: expected shape \[3, 4, 4\], got \[2, 4, 4\]."):
        depth_map(vertices, faces, viewmats[:2], Ks, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match=r"^points: expected shape \[3, P, 3\], got \[2, 37, 3\]."):
        visible(points[:2], vertices, faces, viewmats, Ks)


def test_a_bad_value_anywhere_in_a_batch_is_refused_by_name():
    for name in ("points", "vertices", "viewmat", "K"):
        vertices, faces, viewmats, Ks, points = batch(3)
        {"points": points, "vertices": vertices, "viewmat": viewmats, "K": Ks}[name][2, 0, 0] = torch.nan
        with pytest.raises(ValueError, match=f"^{name}: expected finite values"):
            visible(points, vertices, faces, viewmats, Ks)


@pytest.mark.parametrize("n_batch, n_points, n_faces", [(0, 5, 5), (2, 0, 5), (2, 5, 0), (2, 0, 0)])
def test_empty_axes_give_empty_answers_and_gradients(n_batch, n_points, n_faces, backward_way):
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


def test_any_layout_of_the_inputs_gives_the_same_bits():
    vertices, faces, viewmats, Ks, points = batch(2, torch.float32)

    def scattered(tensor):
        wide = tensor.new_empty([2 * size + 1 for size in tensor.shape])
        inside = wide[tuple(slice(1, None, 2) for _ in tensor.shape)]
        return inside.copy_(tensor)

    def look(points, vertices, faces, viewmats, Ks):
        leaves = [points.detach().requires_grad_(), vertices.detach().requires_grad_()]
        seen = visible(*leaves, faces, viewmats, Ks, point_vertices=torch.arange(37).int())
        weights = torch.ones((), dtype=points.dtype).expand(seen.visibility.shape)  # a gradient without memory
        return [*seen, *torch.autograd.grad(seen.visibility, leaves, weights)]

    plain = look(points, vertices, faces, viewmats, Ks)
    inputs = [scattered(t) for t in (points, vertices, faces, viewmats, Ks)]
    assert not any(t.is_contiguous() for t in inputs)
    assert all(torch.equal(a, b) for a, b in zip(plain, look(*inputs), strict=True))


def test_torch_compiles_both_functions_without_a_break(as_shipped):
    vertices, faces, viewmat, K = soup(3)
    points = some_points(vertices, faces, 3)

    def scores(points, vertices):
        seen = depth_visibility(points, vertices, faces, K, viewmat, WIDTH, HEIGHT, TAU)
        return seen.visibility.square(), seen.depth_map

    def mask(vertices):
        return depth_map(vertices, faces, viewmat, K, WIDTH, HEIGHT).face_ids >= 0

    leaves = [points.requires_grad_(), vertices.requires_grad_()]
    compiled = torch.compile(scores, fullgraph=True, backend="aot_eager")
    got, want = compiled(*leaves), scores(*leaves)
    assert torch.equal(got[0], want[0]) and torch.equal(got[1], want[1])
    for a, b in zip(torch.autograd.grad(got[0].sum(), leaves), torch.autograd.grad(want[0].sum(), leaves), strict=True):
        assert torch.equal(a, b)
    assert torch.equal(torch.compile(mask, fullgraph=True, backend="aot_eager")(vertices), mask(vertices))


def test_the_ops_keep_the_contract_of_custom_ops(dtype):
    vertices, faces, viewmats, Ks, points = batch(2, dtype)
    ops = torch.ops.oasis_warp
    for outputs in ((True, True, True), (False, True, False)):
        torch.library.opcheck(ops.depth_map, (vertices, faces, viewmats, Ks, WIDTH, HEIGHT, 0.01, *outputs, True))
    leaves = (points.requires_grad_(), vertices.requires_grad_())
    for keep, maps, known in ((True, True, torch.arange(37)), (True, False, None), (False, False, None)):
        rest = (faces, viewmats, Ks, known, known is not None, WIDTH, HEIGHT, 0.01, TAU, 3 * TAU, maps, keep, True)
        inputs = leaves if keep else [t.detach() for t in leaves]
        torch.library.opcheck(ops.depth_visibility, (*inputs, *rest))
