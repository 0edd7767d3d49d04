import numpy as np
import pytest
import torch
import trimesh

from oasis_warp.core import surface
from oasis_warp.ops import depth_map
from oasis_warp.ops.smoothing import smooth_over_faces
from oasis_warp.synthetic.illumination import look_at
from oasis_warp.synthetic.ops.batched_lbs import batched_lbs
from oasis_warp.synthetic.ops.pixel_noise import pixel_noise
from oasis_warp.synthetic.ops.room_tracing import PATTERNS, SHAPES, SOLID_WORDS, trace_rooms
from oasis_warp.synthetic.ops.skin_shading import sky_transfer, surface_state
from oasis_warp.synthetic.ops.surface_patterns import NoiseField, point_grid, surface_dabs, surface_noise
from oasis_warp.synthetic.ops.views import Lamps
from oasis_warp.synthetic.view_and_light import sphere

UNIFORM_SKY = torch.zeros(9, 3)
UNIFORM_SKY[0] = 0.5 / 0.2820948  # light of .5 from everywhere


def _ball(device, radius=0.1):
    mesh = trimesh.creation.icosphere(3, radius)
    vertices = torch.tensor(mesh.vertices, dtype=torch.float32, device=device)
    return vertices + torch.tensor([0.0, 0, 0.5], device=device), torch.tensor(np.array(mesh.faces), device=device)


def _no_lamps(device, batch=1):
    far = torch.full((batch, 1, 4, 4), torch.inf, device=device)
    ones, eye = torch.ones(batch, 1, device=device), torch.eye(4, device=device).expand(batch, 1, 4, 4)
    zeros = torch.zeros(batch, 1, 3, device=device)
    return Lamps(zeros, zeros, ones, ones, eye.contiguous(), ones, far)


def _sky_of(vertices, faces, n=64):
    normals = surface_state(vertices[None], faces).normals
    directions = torch.from_numpy(sphere(n)).float().to(vertices.device)
    center = torch.tensor([0.0, 0, 0.5], device=vertices.device)
    radius = float((vertices - center).norm(dim=1).max()) * 1.02
    away = center + directions * 20 * radius
    views = look_at(away, center.expand_as(away))
    size, focal = 96, 20 * 96 / 2
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]], device=vertices.device)
    depths = depth_map(vertices.expand(n, -1, -1), faces, views, K.expand(n, 3, 3), size, size).depth
    focals = torch.tensor([float(focal)], device=vertices.device)
    return normals, sky_transfer(vertices[None], normals, directions, views[None], focals, depths[None], lift=0.003)


def test_normals_are_those_of_the_surface(device):
    vertices, faces = _ball(device)
    state = surface_state(vertices[None], faces)
    torch.testing.assert_close(state.normals[0], surface.vertex_normals(vertices, faces), atol=1e-5, rtol=0)
    areas = surface.vertex_areas(vertices, faces)
    torch.testing.assert_close(state.areas[0], 6 * areas, atol=1e-7, rtol=1e-4)


def test_smoothing_keeps_a_constant_and_the_order_of_a_batch(device):
    vertices, faces = _ball(device)
    values = torch.stack([torch.ones_like(vertices), vertices])
    out = smooth_over_faces(values, faces)
    torch.testing.assert_close(out[0], values[0])
    torch.testing.assert_close(smooth_over_faces(values[1:], faces)[0], out[1])


def test_a_ball_sees_half_the_sky_everywhere(device):
    _, transfer = _sky_of(*_ball(device))
    assert float(transfer[0, :, 9].min()) > 0.93
    irradiance = transfer[0, :, :9] @ UNIFORM_SKY.to(device)
    torch.testing.assert_close(irradiance, torch.full_like(irradiance, 0.5), atol=0.03, rtol=0)


def test_the_inside_of_a_bowl_is_darker_than_its_outside(device):
    vertices, faces = _ball(device)
    bowl = faces[(vertices[faces][:, :, 1] > 0).all(1)]  # open towards -y, which is up
    inner, outer = vertices.clone(), vertices.clone()
    center = torch.tensor([0.0, 0, 0.5], device=device)
    inner = center + 0.9 * (inner - center)
    both = torch.cat([outer, inner])
    walls = torch.cat([bowl, bowl.flip(1) + len(vertices)])  # the inner wall looks inwards
    _, transfer = _sky_of(both, walls)
    bottom = int(vertices[:, 1].argmax())
    outside, inside = transfer[0, bottom, 9], transfer[0, bottom + len(vertices), 9]
    assert float(outside) > 0.9
    assert float(inside) < 0.75


def test_a_wall_in_even_light_shows_its_own_colour(device):
    wall = torch.zeros(1, 1, SOLID_WORDS, device=device)
    wall[0, 0, :6] = torch.tensor([SHAPES.index("box"), PATTERNS.index("paint"), 0.1, 0, 0, 1])
    wall[0, 0, 6:12] = torch.tensor([0, 0, 2.0, 5, 5, 0.05])
    wall[0, 0, 12:21] = torch.eye(3).flatten()
    wall[0, 0, 21:] = torch.tensor([0.6, 0.3, 0.1]).repeat(2)
    hidden = torch.zeros(1, 24, 24, device=device)
    hidden[0, :8] = 1
    one = torch.ones(1, device=device)
    light = trace_rooms(wall, 30 * one, UNIFORM_SKY[None].to(device), _no_lamps(device), hidden, 0.5 * one, 0.0 * one)
    assert float(light[0, :8].abs().max()) == 0
    seen = light[0, 8:].mean((0, 1)).cpu()
    torch.testing.assert_close(seen, 0.5 * torch.tensor([0.6, 0.3, 0.1]), rtol=0.08, atol=0)


@pytest.mark.parametrize("flat", [False, True])
def test_a_dab_is_seen_where_it_is_the_strongest_of_its_kind(device, flat):
    rng = np.random.default_rng(0)
    points, centers = rng.uniform(0, 10, (300, 3)), rng.uniform(-1, 11, (200, 3))
    widths, strengths, kinds = rng.uniform(0.4, 0.9, 200), rng.uniform(-0.1, 1, 200), rng.integers(0, 3, 200)
    q = ((points[:, None] - centers) ** 2).sum(-1) / widths**2
    each = np.where(q < 8, strengths * np.exp(-(q**2 if flat else q)), 0).clip(0)
    wanted = np.stack([each[:, kinds == k].max(1) for k in range(3)])
    t = lambda a: torch.from_numpy(a).float().to(device)  # noqa: E731
    grid = point_grid(t(points), 0.7)
    found = surface_dabs(grid, t(centers), t(widths), t(strengths), torch.from_numpy(kinds).to(device), 3, flat=flat)
    np.testing.assert_allclose(found.cpu(), wanted, atol=1e-5)


def test_no_dabs_leave_no_trace(device):
    none = torch.zeros(0, device=device)
    grid = point_grid(torch.zeros(4, 3, device=device), 1.0)
    out = surface_dabs(grid, torch.zeros(0, 3, device=device), none, none, none.int(), 2)
    assert out.shape == (2, 4) and not bool(out.any())


def test_noise_depends_on_its_seed_and_hardly_leaves_one(device):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).to(device) * 40
    a, b, c = surface_noise(points, [NoiseField(5.0, 1), NoiseField(5.0, 2), NoiseField(5.0, 1)])
    assert torch.equal(a, c) and not torch.equal(a, b)
    assert 0.2 < float(a.std()) < 0.8 and float(a.abs().max()) < 1.6


def test_pixel_noise_is_normal_and_each_seeds_own(device):
    seeds = torch.tensor([3, 4], dtype=torch.int32, device=device)
    noise = pixel_noise(seeds, 3, 40, 40)
    assert abs(float(noise.mean())) < 0.05 and abs(float(noise.std()) - 1) < 0.05
    assert torch.equal(pixel_noise(seeds[1:], 3, 40, 40)[0], noise[1])


def test_wrong_arguments_are_named(as_shipped):
    grid = point_grid(torch.zeros(1, 3), 1.0)
    with pytest.raises(ValueError, match="kinds"):
        surface_dabs(grid, torch.zeros(2, 3), torch.ones(2), torch.ones(2), torch.tensor([0, 1]), 1)
    with pytest.raises(ValueError, match="widths"):
        surface_dabs(grid, torch.zeros(2, 3), torch.ones(3), torch.ones(2), torch.zeros(2).int(), 1)
    with pytest.raises(ValueError, match="points"):
        point_grid(torch.zeros(0, 3), 1.0)
    with pytest.raises(ValueError, match="normals"):
        sky_transfer(torch.zeros(1, 5, 3), torch.zeros(1, 4, 3), torch.zeros(2, 3), torch.zeros(1, 2, 4, 4),
                     torch.ones(1), torch.ones(1, 2, 8, 8))  # fmt: skip
    with pytest.raises(ValueError, match="solids"):
        trace_rooms(torch.zeros(1, 2, 5), torch.ones(1), torch.zeros(1, 9, 3), _no_lamps("cpu"), torch.zeros(1, 8, 8),
                    torch.ones(1), torch.ones(1))  # fmt: skip


def _case(device, batch=3, n=50, joints=4, correctives=6, knuckles=5):
    random = torch.Generator().manual_seed(0)
    sizes = [(batch, n, 3), (n, 3, correctives), (batch, correctives), (n, 3), (n, knuckles), (batch, knuckles),
             (n, joints), (batch, joints, 3, 3), (batch, joints, 3)]  # fmt: skip
    case = [torch.randn(*size, generator=random).to(device) for size in sizes]
    case[6][:, 1] = 0  # a bone that moves nobody
    return case


def test_flesh_is_displaced_then_carried_by_its_bones(device):
    case = _case(device)
    rest, displacements, strengths, normals, rises, knuckles, weights, rotations, shifts = (t.double() for t in case)
    moved = rest + torch.einsum("vdc,bc->bvd", displacements, strengths)
    moved = moved + torch.einsum("vk,bk->bv", rises, knuckles)[..., None] * normals
    carried = torch.einsum("bjde,bve->bvjd", rotations, moved) + shifts[:, None]
    wanted = torch.einsum("vj,bvjd->bvd", weights, carried)
    torch.testing.assert_close(batched_lbs(*case).double(), wanted, atol=1e-4, rtol=1e-5)


def test_a_hand_has_the_same_bits_in_any_batch(device):
    case = _case(device)
    alone = [t[2:] if k in (0, 2, 5, 7, 8) else t for k, t in enumerate(case)]
    assert torch.equal(batched_lbs(*alone), batched_lbs(*case)[2:])


def test_wrong_shapes_are_named(as_shipped):
    case = _case("cpu")
    case[5] = case[5][:, :2]
    with pytest.raises(ValueError, match="knuckles"):
        batched_lbs(*case)
