"""Scenes that benchmarks draw, and how the cost of drawing grows with them."""

import json
import sys
from dataclasses import replace

import pytest
import torch
from gpu_rows import POINT, STUDY, line

from oasis_warp.bench import scaling, scenes, speed
from oasis_warp.bench.knobs import generic_kernels
from oasis_warp.bench.operators import OPERATORS, draw_in_torch, forward
from oasis_warp.bench.roofline import count, count_mesh
from oasis_warp.bench.rows import json_text
from oasis_warp.bench.scaling import Point, measure_scaling, picture_errors, points, steepest
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


SMALL = Point("gaussians", "64 x 64", lambda seed: surface(2_000, 64, 2, seed))


def test_the_study_goes_as_far_as_was_promised():
    whole = points(quick=False)
    assert len([p for p in whole if p.axis == "gaussians"]) == 9
    assert [p.series for p in whole if p.axis == "stress"] == ["one tile", "giants"]
    sizes = [p.make for p in whole if p.axis == "gaussians"]
    assert len(sizes[0](0).means) == 1_000
    assert {p.series for p in whole if p.axis == "pixels"} == {"37,000 Gaussians", "1,000,000 Gaussians"}
    assert len([p for p in whole if p.axis == "pixels"]) == 12
    views = [p.make for p in whole if p.axis == "views"]
    assert len(views[-1](0).viewmats) == 64
    assert len(points(quick=True)) < len(whole) / 2


def test_a_point_is_timed_in_both_passes_and_its_picture_compared(cpu):
    forward_row, both = measure_scaling([SMALL], cpu, seconds=0.1)
    assert (forward_row.pass_, both.pass_) == ("forward", "forward + backward")
    assert (both.gaussians, both.views, both.width, both.amount) == (2_000, 2, 64, 2_000)
    assert both.pairs == count(surface(2_000, 64, 2)).pairs
    assert both.finite
    assert both.checked == "all"
    assert both.max_abs < 2 / 255
    assert both.most_abs < 2e-6
    assert both.wall_ms > 0
    assert forward_row.wall_ms > 0
    assert (both.busy_ms, both.overflow, both.not_captured) == (None, None, "no CUDA device")


@pytest.mark.parametrize("affordable", [10**9, 0])
def test_a_wrong_picture_is_seen_whether_all_of_it_or_a_part_is_compared(monkeypatch, affordable):
    monkeypatch.setitem(scaling.AFFORDABLE, "cpu", affordable)
    scene = surface(5_000, 256)
    work = count(scene)
    image, _ = forward(OPERATORS["rasterization"].call, scene, {})
    what, largest, most = picture_errors(scene, image, work)
    assert what == ("all" if affordable else "crop")
    assert most < 2e-6
    assert largest < 2 / 255
    assert picture_errors(scene, image.roll(1, dims=2), work)[1] > 0.05


def test_a_part_at_the_edge_of_the_picture_is_compared_too(monkeypatch):
    monkeypatch.setitem(scaling.AFFORDABLE, "cpu", 0)
    scene = surface(3_000, 100)
    moved = replace(scene, Ks=scene.Ks + torch.tensor([[0.0, 0, 60], [0, 0, 60], [0, 0, 0]]))
    image, _ = forward(OPERATORS["rasterization"].call, moved, {})
    assert float(image[0, -1, -1].sum()) > 0
    what, _, most = picture_errors(moved, image, count(moved))
    assert what == "crop"
    assert most < 2e-6


def test_values_that_are_not_finite_are_told(cpu):
    def broken(seed):
        scene = surface(200, 32, 1, seed)
        return replace(scene, colors=scene.colors * float("inf"))

    row, _ = measure_scaling([Point("gaussians", "32 x 32", broken)], cpu, seconds=0.05)
    assert not row.finite


def test_growth_is_that_of_time_over_that_of_work():
    found = {(g.axis, g.pass_): g for g in steepest(STUDY)}
    assert set(found) == {(a, p) for a in ("gaussians", "pixels", "views") for p in ("forward", "forward + backward")}
    gaussians, views = found["gaussians", "forward"], found["views", "forward"]
    assert gaussians.ratio == pytest.approx((0.6 / 0.03) / 10)
    assert (gaussians.before, gaussians.after, gaussians.cliff) == (10_000, 100_000, True)
    assert views.ratio == pytest.approx(6 / 8)
    assert not views.cliff


def test_what_grows_is_what_the_axis_says():
    assert [row.amount for row in line("pixels", "", (128**2,), (1.0,))] == [128**2] * 2
    assert [row.amount for row in line("views", "", (8,), (1.0,))] == [8] * 2
    assert POINT.amount == 1_000
    assert POINT.cost_ms == 0.02
    assert replace(POINT, busy_ms=None).cost_ms == 0.1


@pytest.mark.gpu
def test_a_point_on_a_gpu_is_timed_in_a_graph():
    for row in measure_scaling([SMALL], torch.device("cuda"), seconds=0.2):
        assert row.not_captured == ""
        assert row.busy_ms is not None
        assert 0 < row.busy_ms < 10
        assert row.most_abs < 2e-5
        assert row.overflow is False


CPU_ONCE = speed.RunOptions(device=torch.device("cpu"), repeats=2)


@pytest.fixture(scope="module")
def mesh():
    return hand_scenes(32)[1]


@pytest.mark.slow
def test_every_way_is_timed_in_every_pass_and_all_agree(small):
    rows = speed.measure_operator(OPERATORS["rasterization"], small, CPU_ONCE)
    assert [(r.pass_, r.way) for r in rows] == [
        (pass_, way) for pass_ in ("forward", "forward + backward") for way in ("warp", "scalar", "torch")
    ]
    for row in rows:
        assert row.rel_l2 < 5e-6
        assert (row.gradient_rel_l2 is None) == (row.pass_ == "forward")
        assert row.gradient_rel_l2 is None or row.gradient_rel_l2 < 1e-3
        assert row.over_yardstick > 0
        assert (row.over_warp == 1) == (row.way == "warp")


@pytest.mark.parametrize("name", OPERATORS)
def test_generic_kernels_give_float32_answers_of_their_own(name, small, mesh):
    operator = OPERATORS[name]
    scene = operator.prepare(small if operator.scene is type(small) else mesh)
    vectors = operator.comparable(forward(operator.call, scene, {}))
    with generic_kernels():
        scalars = operator.comparable(forward(operator.call, scene, {}))
    again = operator.comparable(forward(operator.call, scene, {}))
    for a, b, c in zip(vectors, scalars, again, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
        assert torch.equal(a, c)  # and afterwards everything is as it was


def test_generic_kernels_answer_no_wherever_an_operator_asks_for_vectors():
    def answers():
        modules = [m for name, m in sys.modules.items() if name.startswith("oasis_warp.ops.")]
        return [m.has_vectors(torch.zeros(1)) for m in modules if hasattr(m, "has_vectors")]

    assert len(answers()) > 3
    assert all(answers())
    with generic_kernels():
        assert not any(answers())


def test_rows_are_plain_json(small):
    rows = speed.measure_operator(OPERATORS["blend_colors"], small, CPU_ONCE)
    records = json.loads(json_text(rows))
    assert [r["way"] for r in records] == ["warp", "torch"] * 2  # sparse products are torch's: nothing to vectorise
    assert {r["pass"] for r in records} == {"forward", "forward + backward"}
