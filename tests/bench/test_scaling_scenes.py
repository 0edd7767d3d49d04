import pytest
import torch

from oasis_warp.bench.counts import count, count_mesh
from oasis_warp.bench.operators import OPERATORS, forward
from oasis_warp.bench.scaling_scenes import TILE, crop, giants, one_tile, points_on, surface, turned_about_z
from oasis_warp.bench.scenes import HAND_GAUSSIANS, frontal, hand, hand_scenes
from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import rasterization
from oasis_warp.reference.errors import largest_error

MAKERS = {
    "surface": lambda seed: surface(500, 32, 2, seed),
    "one tile": lambda seed: one_tile(100, 32, seed),
    "giants": lambda seed: giants(20, 32, seed),
}


def draw(scene):
    return forward(OPERATORS["rasterization"].call, scene, {})


@pytest.mark.parametrize("name", MAKERS)
def test_a_seed_makes_the_same_scene_every_time(name):
    one, again, other = MAKERS[name](3), MAKERS[name](3), MAKERS[name](4)
    assert torch.equal(one.means, again.means)
    assert torch.equal(one.scales, again.scales)
    assert not torch.equal(one.means, other.means)
    assert one.means.dtype == torch.float32


def test_any_number_of_surfels_covers_the_hand_alike():
    covered = [float((draw(surface(n, 128))[1] > 0.5).float().mean()) for n in (3_000, 30_000)]
    whole = float((draw(hand(128))[1] > 0.5).float().mean())
    assert covered == pytest.approx([whole, whole], rel=0.1)


def test_a_surface_with_as_many_surfels_as_the_hand_is_as_much_work():
    ours, hands = count(surface(HAND_GAUSSIANS, 256)), count(hand(256))
    assert ours.pairs == pytest.approx(hands.pairs, rel=0.15)
    assert ours.busy_tiles == pytest.approx(hands.busy_tiles, rel=0.1)


def test_views_go_all_round_and_the_first_stays():
    many, one = surface(200, 32, 4), surface(200, 32, 1)
    assert torch.equal(many.viewmats[:1], one.viewmats)
    assert torch.equal(many.means, one.means)
    axes = many.viewmats[:, 2, :3]  # where each camera looks
    torch.testing.assert_close(axes[0], -axes[2], rtol=0, atol=1e-6)
    assert torch.equal(hand_scenes(32, n_views=3)[0].viewmats[:1], hand(32).viewmats)


def test_points_on_triangles_spread_evenly():
    generator = torch.Generator().manual_seed(0)
    corners = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]).expand(20_000, 3, 3)
    x, y, z = points_on(corners, generator).unbind(-1)
    assert float(x.min()) >= 0
    assert float((x + y).max()) <= 1 + 1e-6
    assert float(z.abs().max()) == 0
    assert float((x + y < 0.5).float().mean()) == pytest.approx(0.25, abs=0.02)  # a quarter of the area
    assert float((x < 0.5).float().mean()) == pytest.approx(0.75, abs=0.02)


def test_turning_about_the_own_axis_leaves_it():
    quats = torch.nn.functional.normalize(torch.randn(5, 4, generator=torch.Generator().manual_seed(0)), dim=-1)
    before, after = to_matrix(quats), to_matrix(turned_about_z(quats, torch.full((5,), 0.5 * torch.pi)))
    torch.testing.assert_close(after[..., 2], before[..., 2])
    torch.testing.assert_close(after[..., 0], before[..., 1])


def test_one_tile_lists_all_and_draws_nearly_all():
    scene = one_tile(2_000, 64)
    work = count(scene)
    assert (work.longest, work.busy_tiles, work.pairs) == (2_000, 1, 2_000)
    alpha = draw(one_tile(100_000, 64))[1][0, ..., 0]
    inside = alpha[32 + 2 : 32 + TILE - 2, 32 + 2 : 32 + TILE - 2]
    assert float(inside.min()) > 0.99
    assert float((alpha > 0).float().sum()) <= TILE * TILE


def test_every_tile_lists_every_giant_and_no_pixel_ends():
    work = count(giants(50, 64))
    assert work.pairs == 50 * 64
    assert work.longest == 50
    assert float(draw(giants(1_000, 64))[1].max()) < 1 - 1e-4


def test_a_crop_is_that_part_of_the_picture():
    scene = surface(3_000, 128)
    part = draw(crop(scene, 40, 56, 48))[0]
    assert largest_error(part, draw(scene)[0][:, 56:104, 40:88]) < 1e-6


def test_work_is_counted_as_one_would_by_hand():
    scene = frontal(
        "two", 0, torch.tensor([[0.0, 0.0, 1.0], [0.25, 0.0, 1.0]]), torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.tensor([[0.05] * 3, [0.01] * 3]), torch.tensor([0.5, 0.9]), torch.rand(2, 3), 32,
    )  # fmt: skip
    work = count(scene)
    _, _, meta = rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks, 32, 32
    )
    pairs, box_pixels, lists = 0, 0, torch.zeros(4, 4)
    for (x, y), (rx, ry) in zip(meta["means2d"][0].tolist(), covers(scene), strict=True):
        columns = [c for c in range(32) if abs(c + 0.5 - x) <= rx]
        rows = [r for r in range(32) if abs(r + 0.5 - y) <= ry]
        tiles = {(r // TILE, c // TILE) for r in rows for c in columns}
        pairs, box_pixels = pairs + len(tiles), box_pixels + len(rows) * len(columns)
        for tile in tiles:
            lists[tile] += 1
    assert (work.gaussians, work.drawn, work.tiles, work.pixels, work.views) == (2, 2, 16, 1024, 1)
    assert (work.pairs, work.box_pixels) == (pairs, box_pixels)
    assert (work.longest, work.busy_tiles) == (int(lists.max()), int((lists > 0).sum()))


def covers(scene):
    """Half sides of the boxes within which the Gaussians of a frontal scene reach 1/255, round ones before the axis."""
    variances = (32 * scene.scales[:, 0].double()).square() + 0.3
    reach = (2 * (255 * scene.opacities.double()).log()).sqrt().clamp_max(3.33)
    # Away from the axis a ball is wider: its depth counts by the slope of the ray.
    slopes = (scene.means[:, 0] / scene.means[:, 2]).double()
    wide = variances + (32 * scene.scales[:, 0].double() * slopes).square()
    return [(float(r * w.sqrt()), float(r * v.sqrt())) for r, w, v in zip(reach, wide, variances, strict=True)]


def test_views_add_up():
    one, three = count(surface(500, 64, 1)), count(surface(500, 64, 3))
    assert (three.gaussians, three.tiles, three.pixels, three.views) == (1_500, 3 * 64, 3 * 64 * 64, 3)
    assert three.pairs > one.pairs
    assert three.longest >= one.longest


def test_a_mesh_is_counted():
    mesh = hand_scenes(32)[1]
    counts = count_mesh(mesh)
    assert counts.vertex_gaussians + counts.face_gaussians == HAND_GAUSSIANS
    assert (counts.faces, counts.joints, counts.pixels) == (24_608, 16, 1024)
