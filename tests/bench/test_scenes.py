import pytest
import torch

from oasis_warp.bench import scenes
from oasis_warp.bench.counts import count, count_mesh
from oasis_warp.bench.operators import OPERATORS, draw_in_torch, forward
from oasis_warp.bench.scenes import (
    HAND_GAUSSIANS,
    TILE,
    crop,
    frontal,
    giants,
    hand,
    hand_scenes,
    one_tile,
    points_on,
    surface,
    turned_about_z,
)
from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops import rasterization
from oasis_warp.reference.errors import largest_error, relative_error

MAKERS = {
    "hand": lambda seed: scenes.hand(32, seed),
    "surfels": lambda seed: scenes.surfels(500, 32, seed),
    "far hand": lambda seed: scenes.far_hand(32, seed)[0],
    "layered": lambda seed: scenes.layered(seed=seed),
    "needles": lambda seed: scenes.needles(seed=seed),
    "opaque": lambda seed: scenes.opaque(seed=seed),
    "equal depths": lambda seed: scenes.equal_depths(seed=seed),
    "surface": lambda seed: surface(500, 32, 2, seed),
    "one tile": lambda seed: one_tile(100, 32, seed),
    "giants": lambda seed: giants(20, 32, seed),
}


@pytest.mark.parametrize("name", MAKERS)
def test_a_seed_makes_the_same_scene_every_time(name):
    torch.manual_seed(1)
    one = MAKERS[name](3)
    torch.manual_seed(2)
    again, other = MAKERS[name](3), MAKERS[name](4)
    assert torch.equal(one.means, again.means)
    assert torch.equal(one.colors, again.colors)
    assert torch.equal(one.scales, again.scales)
    assert not torch.equal(one.colors, other.colors)
    assert all(t.dtype == torch.float32 for t in (one.means, one.quats, one.scales, one.opacities, one.colors))


def test_the_hand_is_the_bundled_one():
    drawn, mesh = scenes.hand_scenes(32)
    assert len(drawn.means) == scenes.HAND_GAUSSIANS
    assert len(mesh.faces) == 24_608
    assert len(mesh.vertex_index) + len(mesh.face_index) == len(mesh.quats) == len(drawn.means)


def test_fewer_surfels_cover_as_much():
    def area(scene):
        return float((scene.opacities * scene.scales[:, :2].prod(-1)).sum())

    assert area(scenes.surfels(9_000, 64)) == pytest.approx(area(scenes.hand(64)), rel=0.02)


def test_more_surfels_than_the_hand_has_are_refused():
    with pytest.raises(ValueError, match=r"n: expected 1 to 36881 Gaussians, got 40000"):
        scenes.surfels(40_000, 32)


def test_a_far_camera_sees_the_hand_in_the_same_place():
    (near, _), (far, _) = scenes.hand_scenes(48), scenes.far_hand(48)
    images = [draw_in_torch(scene.to(dtype=torch.float64)).image for scene in (near, far)]
    assert relative_error(images[1], images[0]) < 0.5
    assert float(far.viewmats[0, 2, 3]) > 99


def test_slivers_are_flat_in_one_direction():
    mesh = scenes.slivers(32)
    variances = torch.linalg.eigvalsh(torch.cov(mesh.posed_vertices.T.double()))
    assert float(variances[0] / variances[-1]) < 1e-5


def test_precision_changes_floats_only():
    mesh = scenes.slivers(32).to(dtype=torch.float64)
    assert mesh.posed_vertices.dtype == torch.float64
    assert mesh.faces.dtype == torch.int64
    assert mesh.name == "slivers"


def draw(scene):
    return forward(OPERATORS["rasterization"].call, scene, {})


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
