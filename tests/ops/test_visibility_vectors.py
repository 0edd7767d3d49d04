"""The vectorised depth buffer of the CPU against the plain float64 kernels, where a float32 filter is most in doubt."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.ops._runtime import depth_buffer

SIZES = ((1, 1), (1, 40), (33, 2), (64, 64), (130, 47))


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def uniform(generator, *shape):
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def sheet(generator, width, height, spacing, roughness):
    """A surface over the whole picture of a camera with focal length `width`: corners, in pixels and depths."""
    columns, rows = int(width / spacing) + 3, int(height / spacing) + 3
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    pixels = torch.stack([x, y], -1).double().reshape(-1, 2) * spacing - spacing
    depths = 2 + roughness * normal(generator, len(pixels)).clamp(-3, 3)
    a = (torch.arange(rows - 1)[:, None] * columns + torch.arange(columns - 1)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + columns + 1], 1), torch.stack([a, a + columns + 1, a + columns], 1)])
    return pixels, depths, faces


def unproject(pixels, depths, K):
    rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    return torch.cat([rays, torch.ones(len(rays), 1, dtype=torch.float64)], 1) * depths[:, None]


def small_faces(generator, K, width, height):
    pixels, depths, faces = sheet(generator, width, height, 2.3, 0.3)
    pixels = pixels + 0.8 * normal(generator, *pixels.shape)  # folds over itself here and there
    return unproject(pixels, depths, K), faces


def corners_on_pixel_centres(generator, K, width, height):
    pixels, depths, faces = sheet(generator, width, height, 3.0, 0.2)
    return unproject(pixels + 0.5, depths, K), faces


def corners_a_little_off_pixel_centres(generator, K, width, height):
    pixels, depths, faces = sheet(generator, width, height, 3.0, 0.2)
    off = 10 ** (-12 * uniform(generator, len(pixels), 1)) * normal(generator, *pixels.shape)
    return unproject(pixels + 0.5 + off, depths, K), faces


def one_surface_triangulated_twice(generator, K, width, height):
    pixels, _, faces = sheet(generator, width, height, 4.0, 0.0)
    columns = int(width / 4.0) + 3
    a = faces[: len(faces) // 2, 0]
    other = torch.cat([torch.stack([a, a + 1, a + columns], 1), torch.stack([a + 1, a + columns + 1, a + columns], 1)])
    depths = 1 / (0.5 + 1e-3 * (pixels @ torch.tensor([0.7, -0.4], dtype=torch.float64)))  # a tilted plane
    faces = torch.cat([faces, other])
    return unproject(pixels, depths, K), faces[torch.randperm(len(faces), generator=generator)]


def thin_layers(generator, K, width, height):
    pixels, depths, faces = sheet(generator, width, height, 5.0, 0.1)
    gaps = [0.0, *(10.0 ** -torch.arange(3, 12, 2)).tolist()]
    vertices = torch.cat([unproject(pixels, depths * (1 + gap), K) for gap in gaps])
    faces = torch.cat([faces + k * len(pixels) for k in range(len(gaps))])
    return vertices, faces[torch.randperm(len(faces), generator=generator)]


def slivers(generator, K, width, height):
    n = 150
    centre = (uniform(generator, n, 2) * torch.tensor([width, height])).floor() + 0.5
    along, off = 8 * normal(generator, n, 2), 10 ** (-6 * uniform(generator, n, 1)) * normal(generator, n, 2)
    # Each holds a pixel's centre, however thin it is.
    pixels = torch.stack([centre - along - off, centre + along - off, centre + 2 * off], 1).reshape(-1, 2)
    depths = 1 + uniform(generator, 3 * n)
    # Each with another just behind it, so that their steep depths must be right.
    vertices = torch.cat([unproject(pixels, depths * behind, K) for behind in (1 + 3e-5, 1, 1 + 1e-4)])
    return vertices, torch.arange(9 * n).view(-1, 3)


def huge_triangles(generator, K, width, height):
    n = 40
    pixels = 10 ** (4 * uniform(generator, 3 * n, 1)) * width * normal(generator, 3 * n, 2)
    return unproject(pixels, 0.5 + uniform(generator, 3 * n), K), torch.arange(3 * n).view(-1, 3)


def across_the_near_plane(generator, K, width, height):
    n = 40
    vertices = normal(generator, 3 * n, 3) * torch.tensor([1.0, 1.0, 0.3])
    return vertices, torch.arange(3 * n).view(-1, 3)


def all_depths_at_once(generator, K, width, height):
    n = 60
    depths = 10 ** (6 * uniform(generator, 3 * n) - 2)
    pixels = uniform(generator, 3 * n, 2) * torch.tensor([width, height])
    return unproject(pixels, depths, K), torch.arange(3 * n).view(-1, 3)


SCENES = [
    small_faces, corners_on_pixel_centres, corners_a_little_off_pixel_centres, one_surface_triangulated_twice,
    thin_layers, slivers, huge_triangles, across_the_near_plane, all_depths_at_once,
]  # fmt: skip


def make(scene, seed, width, height, dtype):
    """Arguments of `depth_map`: the scene, from a turned camera far from the world's origin."""
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[max(width, 8), 0, width / 2 + 0.3], [0, 1.1 * max(width, 8), height / 2], [0, 0, 1]]).double()
    vertices, faces = scene(generator, K, width, height)
    viewmat = torch.eye(4, dtype=torch.float64)
    if seed % 2:  # else corners stay where they were put, to the bit
        viewmat[:3, :3] = to_matrix(normal(generator, 4))
        viewmat[:3, 3] = 10 * normal(generator, 3)
        vertices = (vertices - viewmat[:3, 3]) @ viewmat[:3, :3]
    return vertices.to(dtype), faces, viewmat.to(dtype), K.to(dtype), width, height


@pytest.fixture
def plainly(monkeypatch):
    """Calls a function with the plain kernels in the place of the vectorised ones."""

    def call(function, *args, **options):
        with monkeypatch.context() as patch:
            patch.setattr(depth_buffer, "draw_by_vectors", depth_buffer.draw_by_faces)
            patch.setattr(depth_buffer, "vertex_gradients_by_vectors", depth_buffer.vertex_gradients_by_points)
            return function(*args, **options)

    return call


@pytest.mark.parametrize("scene", SCENES)
def test_vectors_see_the_same_as_the_plain_kernels_to_the_bit(scene, dtype, plainly):
    covered = 0
    for seed, (width, height) in enumerate(SIZES * 2):
        arguments = make(scene, seed, width, height, dtype)
        got, want = depth_map(*arguments), plainly(depth_map, *arguments)
        for name, a, b in zip(got._fields, got, want, strict=True):
            assert torch.equal(a, b), f"{name}: seed {seed}, {width} x {height}"
        covered += int((want.face_ids >= 0).sum())
    assert covered > 100


def test_scores_and_gradients_are_those_of_the_plain_kernels(dtype, plainly):
    def look(points, vertices, *rest, **options):
        leaves = [points.clone().requires_grad_(), vertices.clone().requires_grad_()]
        seen = depth_visibility(*leaves, *rest, **options)
        return seen, torch.autograd.grad(seen.visibility.square().sum(), leaves)

    eps = torch.finfo(dtype).eps
    for seed, (width, height) in enumerate(SIZES):
        vertices, faces, viewmat, K, *_ = make(small_faces, seed, width, height, dtype)
        arguments = (vertices + 0.05, vertices, faces, K, viewmat, width, height, 0.1)
        known = torch.arange(len(vertices))
        known[::3] = -1
        for options in ({}, {"point_vertices": known}, {"literal": True}):
            (got, gradients), (want, exact) = look(*arguments, **options), plainly(look, *arguments, **options)
            torch.testing.assert_close(got.visibility, want.visibility, rtol=0, atol=4 * eps)
            assert torch.equal(got.face_ids, want.face_ids)
            # The filter's inverse depths, as they are: within 2^-18 by the bound, and much closer in fact.
            close = 2**-18 if dtype == torch.float32 else 0
            torch.testing.assert_close(got.depth_map, want.depth_map, rtol=close, atol=0)
            for a, b in zip(gradients, exact, strict=True):
                assert (a - b).norm() <= 40 * eps * b.norm()


def test_neither_threads_nor_parts_of_the_mesh_change_a_bit(hand, with_threads, monkeypatch):
    monkeypatch.setattr(depth_buffer, "FACES_PER_PART", 7)
    for scene in (small_faces, one_surface_triangulated_twice, across_the_near_plane):
        vertices, faces, viewmat, K, width, height = make(scene, 1, 130, 47, torch.float32)

        def look(vertices=vertices, faces=faces, viewmat=viewmat, K=K, width=width, height=height):
            leaf = vertices.clone().requires_grad_()
            seen = depth_visibility(vertices, leaf, faces, K, viewmat, width, height, 0.1)
            seen.visibility.sum().backward()
            return [*seen, leaf.grad, *depth_map(vertices, faces, viewmat, K, width, height)]

        alone = with_threads(1, look)
        for n_threads in (2, 3, 8):
            several = with_threads(n_threads, look)
            assert all(torch.equal(a, b) for a, b in zip(alone, several, strict=True))


GUARD = 1024
"""Bytes before and after a buffer."""


def test_nothing_is_written_past_a_buffer(monkeypatch):
    guarded = []

    def empty(scene, *shape, dtype=None):
        like = scene.vertices.new_empty((len(scene.vertices), *shape), dtype=dtype, device="meta")
        size = like.numel() * like.element_size()
        memory = torch.full((size + 2 * GUARD,), 0xA5, dtype=torch.uint8)
        guarded.append(memory)
        return memory[GUARD : GUARD + size].view(like.dtype).view(like.shape)

    monkeypatch.setattr(depth_buffer.DepthScene, "empty", empty)
    monkeypatch.setattr(depth_buffer, "FACES_PER_PART", 20)
    for dtype in (torch.float32, torch.float64):
        for seed, (width, height) in enumerate(SIZES):
            for scene in SCENES:
                vertices, faces, viewmat, K, *_ = make(scene, seed, width, height, dtype)
                # The mesh's last corners and faces fill no vector.
                leaf = vertices[: int(faces.max()) + 1].requires_grad_()
                points = vertices[: len(vertices) // 2 + 1]
                seen = depth_visibility(points, leaf, faces, K, viewmat, width, height, 0.1)
                seen.visibility.sum().backward()
                depth_map(vertices, faces, viewmat, K, width, height)
    assert len(guarded) > 500
    assert all((m[:GUARD] == 0xA5).all() and (m[-GUARD:] == 0xA5).all() for m in guarded)


PICTURES = """
import sys, torch
sys.path.insert(0, sys.argv[2])
from test_visibility_vectors import SCENES, make
from oasis_warp.ops import depth_map, depth_visibility
torch.set_num_threads(1)
out = []
for scene in SCENES:
    vertices, faces, viewmat, K, width, height = make(scene, 1, 64, 64, torch.float32)
    leaf = vertices.clone().requires_grad_()
    seen = depth_visibility(vertices, leaf, faces, K, viewmat, width, height, 0.1)
    seen.visibility.sum().backward()
    out += [*depth_map(vertices, faces, viewmat, K, width, height), *(t.detach() for t in seen), leaf.grad]
torch.save(out, sys.argv[1])
"""


@pytest.mark.slow
def test_narrower_vectors_give_the_same_pictures(tmp_path):
    answers = []
    for k, flags in enumerate([None, "-target-cpu x86-64-v3", "-target-cpu x86-64-v2"]):
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        environment |= {} if flags is None else {"OASIS_WARP_CPU_FLAGS": flags}
        command = [sys.executable, "-c", PICTURES, str(tmp_path / f"{k}.pt"), str(Path(__file__).parent)]
        subprocess.run(command, env=environment, check=True)
        answers.append(torch.load(tmp_path / f"{k}.pt"))
    for other in answers[1:]:
        for a, b in zip(answers[0], other, strict=True):
            if a.dtype == torch.int32:
                assert torch.equal(a, b)
            else:
                torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)
