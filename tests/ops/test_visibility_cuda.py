"""The depth buffer in float32, on CUDA above all: the faces of float64, pixel by pixel, in any order of the threads."""

import re

import pytest
import torch
from test_visibility import some_points
from test_visibility_vectors import (
    SCENES,
    SIZES,
    make,
    normal,
    one_surface_triangulated_twice,
    small_faces,
    thin_layers,
    uniform,
    unproject,
)

from oasis_kernels.depth import depth_buffer_cuda
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.ops._runtime import depth_cuda


def on(device, arguments):
    return [a.to(device) if isinstance(a, torch.Tensor) else a for a in arguments]


def in_float64(arguments):
    """The same numbers in double precision."""
    return [a.double() if isinstance(a, torch.Tensor) and a.is_floating_point() else a for a in arguments]


def assert_same_picture(got, want):
    assert torch.equal(got.face_ids, want.face_ids)
    torch.testing.assert_close(got.depth.double(), want.depth, rtol=1e-7, atol=0)
    torch.testing.assert_close(got.barycentrics.double(), want.barycentrics, rtol=0, atol=1e-7)


def scattered(generator, K, width, height):
    """Triangles of all sizes at random, a tenth of them larger than the picture, two without an area."""
    n = 300
    size = 10 ** (3 * uniform(generator, n, 1, 1) - 1)
    centre = uniform(generator, n, 1, 2) * torch.tensor([width, height])
    pixels = (centre + size * normal(generator, n, 3, 2)).reshape(-1, 2)
    vertices = unproject(pixels, 0.5 + 2 * uniform(generator, 3 * n), K)
    vertices[2] = vertices[1]
    vertices[5] = 0.5 * (vertices[3] + vertices[4])
    return vertices, torch.arange(3 * n).view(-1, 3)


@pytest.mark.parametrize("scene", [*SCENES, scattered])
def test_float32_shows_the_faces_that_float64_shows(scene, device):
    covered = 0
    for seed, (width, height) in enumerate((*SIZES, (310, 270))):
        arguments = on(device, make(scene, seed, width, height, torch.float32))
        want = depth_map(*in_float64(arguments))
        assert_same_picture(depth_map(*arguments), want)
        covered += int((want.face_ids >= 0).sum())
    assert covered > 100


@pytest.mark.gpu
@pytest.mark.parametrize("scene", [scattered, one_surface_triangulated_twice, thin_layers])
def test_neither_a_full_queue_nor_few_blocks_lose_a_face(scene, monkeypatch):
    arguments = on("cuda", make(scene, 1, 310, 270, torch.float32))
    want = depth_map(*in_float64(arguments))
    for queue, blocks in ((0, 1 << 22), (3, 2), (1 << 17, 5)):
        monkeypatch.setattr(depth_buffer_cuda, "QUEUE", queue)
        monkeypatch.setattr(depth_cuda, "MAX_BLOCKS", blocks)
        assert_same_picture(depth_map(*arguments), want)


@pytest.mark.gpu
def test_of_thousands_of_faces_in_one_place_the_first_is_kept():
    corners = torch.tensor([[-9.0, -9, 3], [9, -9, 3], [0, 9, 3]])
    behind = corners * torch.tensor([1, 1, 1 + 1e-6])
    K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    n = 5000
    generator = torch.Generator().manual_seed(0)
    is_near = torch.rand(n, generator=generator) < 0.3
    is_near[:7] = False
    faces = torch.where(is_near[:, None], torch.arange(3), torch.arange(3, 6))
    got = depth_map(torch.cat([corners, behind]).cuda(), faces.cuda(), torch.eye(4).cuda(), K.cuda(), 16, 16)
    assert (got.face_ids[4:12, 4:12] == int(is_near.nonzero()[0])).all()


def graded(points, vertices, weights, *rest, **options):
    """Scores, maps and both gradients."""
    leaves = [points.clone().requires_grad_(), vertices.clone().requires_grad_()]
    seen = depth_visibility(*leaves, *rest, **options)
    return [*(t.detach() for t in seen), *torch.autograd.grad((seen.visibility * weights).sum(), leaves)]


def scoring(seed, width=130, height=47):
    """Arguments of `graded`: every vertex and points near the faces."""
    vertices, faces, viewmat, K, *_ = make(small_faces, seed, width, height, torch.float32)
    points = torch.cat([vertices, some_points(vertices, faces, seed).float()])
    weights = torch.randn(len(points), generator=torch.Generator().manual_seed(seed))
    return [points, vertices, weights, faces, K, viewmat, width, height, 0.1]


@pytest.mark.parametrize("known", [None, torch.int32, torch.int64])
def test_scores_and_gradients_are_those_of_float64(known, device):
    for seed in range(3):
        arguments = on(device, scoring(seed))
        points, vertices = arguments[:2]
        named = None
        if known is not None:
            named = torch.full((len(points),), -1, dtype=known, device=device)
            named[: len(vertices) : 2] = torch.arange(len(vertices), dtype=known, device=device)[::2]
        got = graded(*arguments, point_vertices=named)
        want = graded(*in_float64(arguments), point_vertices=named)
        assert torch.equal(got[2], want[2])
        torch.testing.assert_close(got[0].double(), want[0], rtol=0, atol=1e-6)
        for a, b in zip(got[3:], want[3:], strict=True):
            assert b.norm() > 0.1
            assert (a.double() - b).norm() <= 1e-6 * b.norm()


@pytest.mark.gpu
def test_repeats_and_few_blocks_give_the_same_bits(monkeypatch):
    arguments = on("cuda", scoring(1))
    first = graded(*arguments)
    for blocks in (1, 2, 1 << 22):
        monkeypatch.setattr(depth_cuda, "MAX_BLOCKS", blocks)
        monkeypatch.setattr(depth_buffer_cuda, "PEAKS", min(blocks, 1024))
        for _ in range(5):
            again = graded(*arguments)
            assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_a_gradient_that_is_no_number_spoils_the_corners_that_it_reaches_and_no_others(device):
    arguments = on(device, scoring(2))
    points, vertices, weights = arguments[:3]
    clean = graded(*arguments)
    i = int(clean[3].norm(dim=-1).argmax())
    spoilt = weights.clone()
    spoilt[i] = torch.nan
    got = graded(points, vertices, spoilt, *arguments[3:])[4]
    bad = got.isnan().any(-1)
    assert 1 <= bad.sum() <= 3
    torch.testing.assert_close(got[~bad], clean[4][~bad], rtol=1e-5, atol=1e-5 * float(clean[4].abs().max()))


@pytest.mark.parametrize("outputs", [("depth",), ("face_ids",), ("barycentrics",), ("face_ids", "depth"), ()])
def test_only_what_is_asked_for_is_computed(outputs, device):
    arguments = on(device, make(small_faces, 3, 64, 64, torch.float32))
    full, some = depth_map(*arguments), depth_map(*arguments, outputs=outputs)
    for name, part in some._asdict().items():
        if name in outputs:
            torch.testing.assert_close(part, getattr(full, name), rtol=5e-6, atol=0)
        else:
            assert part.shape[:2] == (0, 0)
    batch = depth_map(arguments[0].expand(2, -1, -1), *arguments[1:], outputs=outputs)
    assert all(part.shape == (2, *alone.shape) for part, alone in zip(batch, some, strict=True))


@pytest.mark.parametrize("graded_too", [False, True])
def test_scores_without_maps_are_the_same(graded_too, device):
    points, vertices, weights, *rest = on(device, scoring(0))
    if graded_too:
        want, got = graded(points, vertices, weights, *rest), graded(points, vertices, weights, *rest, maps=False)
    else:
        want = depth_visibility(points, vertices, *rest)
        got = depth_visibility(points, vertices, *rest, maps=False)
    assert got[1].shape == got[2].shape == (0, 0)
    for k in (0, *range(3, len(want))):
        assert torch.equal(got[k], want[k])


def test_an_output_that_does_not_exist_is_named(as_shipped):
    arguments = make(small_faces, 0, 8, 8, torch.float32)
    with pytest.raises(ValueError, match="^outputs: expected one of 'depth', 'face_ids', 'barycentrics', got 'ids'"):
        depth_map(*arguments, outputs=("ids",))


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype")
def test_a_trusted_call_never_waits_for_the_device(dtype):
    arguments = on("cuda", scoring(1))
    arguments = arguments if dtype == torch.float32 else in_float64(arguments)
    known = torch.arange(len(arguments[0]), device="cuda") % len(arguments[1])
    options = {"point_vertices": known, "validate": False}
    want = graded(*arguments, **options)
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("error")
        got = graded(*arguments, **options)
        drawn = depth_map(arguments[1], arguments[3], arguments[5], arguments[4], 130, 47, validate=False)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(drawn.face_ids, got[2])
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


@pytest.mark.gpu
def test_a_captured_call_follows_its_inputs():
    arguments = on("cuda", scoring(1))
    points, vertices = arguments[:2]
    options = {"validate": False}
    graded(*arguments, **options)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = graded(*arguments, **options)
        drawn = depth_map(vertices, arguments[3], arguments[5], arguments[4], 130, 47, validate=False)
    for shift in (0.0, 0.02, -0.05):
        with torch.no_grad():
            vertices += shift
            points -= shift / 2
        graph.replay()
        want = graded(*arguments, **options)
        assert all(torch.equal(a, b) for a, b in zip(captured, want, strict=True))
        assert torch.equal(drawn.face_ids, want[2])


@pytest.mark.gpu
@pytest.mark.slow
def test_millions_of_faces_on_a_large_picture_are_those_of_float64():
    generator = torch.Generator().manual_seed(0)
    side, size = 2240, 4096
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    pixels = torch.stack([x, y], -1).double().reshape(-1, 2) * (size / (side - 1))
    pixels = pixels + 0.7 * normal(generator, *pixels.shape)
    a = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + side + 1], 1), torch.stack([a, a + side + 1, a + side], 1)])
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]], dtype=torch.float64)
    vertices = unproject(pixels, 2 + 0.3 * uniform(generator, len(pixels)), K).float()
    # And a wall behind them that covers all of it, two faces.
    wall = unproject(torch.tensor([[-9.0, -9], [9000, -9], [9000, 9000], [-9, 9000]]).double(), torch.tensor([3.0]), K)
    vertices = torch.cat([vertices, wall.float()])
    n = len(vertices) - 4
    faces = torch.cat([torch.tensor([[n, n + 1, n + 2], [n, n + 2, n + 3]]), faces])
    assert len(faces) > 10_000_000
    arguments = on("cuda", [vertices, faces, torch.eye(4), K.float(), size, size])
    got = depth_map(*arguments)
    assert (got.face_ids >= 0).all() and (got.face_ids < 2).any()
    assert_same_picture(got, depth_map(*in_float64(arguments)))


@pytest.mark.parametrize("name", ["vertices", "viewmat", "K", "points", "K[0, 0]", "K[1, 1]", "point_vertices"])
def test_a_bad_value_is_refused_by_name(name, device):
    points, vertices, _, faces, K, viewmat, *rest = on(device, scoring(1))
    named = torch.arange(len(points), device=device) % len(vertices)
    given = {"vertices": vertices, "viewmat": viewmat, "K": K, "points": points}
    depth_visibility(points, vertices, faces, K, viewmat, *rest, point_vertices=named)
    if name in given:
        given[name][1, 1] = torch.nan
    elif name == "point_vertices":
        named[7] = len(vertices)
    else:
        K[int(name[2]), int(name[2])] = 0
    for literal in (False, True):
        with pytest.raises(ValueError, match="^" + re.escape(name) + ": expected"):
            depth_visibility(points, vertices, faces, K, viewmat, *rest, point_vertices=named, literal=literal)


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:The CUDA Graph is empty")
def test_a_look_at_values_is_refused_in_a_graph():
    arguments = on("cuda", make(small_faces, 1, 33, 20, torch.float32))
    depth_map(*arguments)
    torch.cuda.synchronize()
    with (
        pytest.raises(ValueError, match="^validate: expected False while a CUDA graph is being captured"),
        torch.cuda.graph(torch.cuda.CUDAGraph()),
    ):
        depth_map(*arguments)
