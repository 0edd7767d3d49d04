"""Scenes that break an obvious float32 rasterizer: needles, overflows, cancellations, ties, stacks.

Limits are rel-L2 of float32 against the float64 twin on the same float32 numbers, pixels on the edge of a decision
left out: 1e-5 and 1e-4 (values, gradients), for long needles 2e-5 and 2e-4.
"""

import pytest
import torch
from rasterization_scenes import frontal_scene, intrinsics, look_from, ordinary_scene
from test_rasterization import assert_equals_twin, draw

from oasis_warp.ops import rasterization
from oasis_warp.ops._runtime.tiles import MAX_PAIRS, bin_by_dealing, bin_by_sorting, bin_to_tiles, opaque_elements
from oasis_warp.ops.projection import project

STIFF = 1e-5, 1e-4
NEEDLES = 2e-5, 2e-4


def cloud(n, seed=0, spread=(1.0, 1.0, 0.6), centre=(0.0, 0.0, 3.0)):
    g = torch.Generator().manual_seed(seed)
    uniform = torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5
    return 2 * uniform * torch.tensor(spread, dtype=torch.float64) + torch.tensor(centre, dtype=torch.float64)


def scales_of(*rows, n):
    return torch.tensor(rows, dtype=torch.float64).repeat(n // len(rows), 1)


CASES = {
    "needles of 30 px": (frontal_scene(cloud(40), scales_of([0.8, 1e-3, 1e-3], n=40), 0.6, 64, 64, 90.0), NEEDLES),
    "needles of 600 px": (frontal_scene(cloud(40), scales_of([20.0, 1e-4, 1e-4], n=40), 0.5, 64, 64, 90.0), NEEDLES),
    "pancakes": (frontal_scene(cloud(60), scales_of([0.2, 0.2, 1e-6], n=60), 0.6), STIFF),
    "flat": (frontal_scene(cloud(60), scales_of([0.2, 0.1, 0.0], n=60), 0.6), STIFF),
    "lines": (frontal_scene(cloud(60), scales_of([0.2, 0.0, 0.0], n=60), 0.6), STIFF),
    "points": (frontal_scene(cloud(60), 0.0, 0.9), STIFF),
    "far below a pixel": (frontal_scene(cloud(60), 1e-5, 0.9), STIFF),
    "larger than the image": (frontal_scene(cloud(12), 40.0, 0.3), STIFF),
    # The image is uniform, so that randomly signed pixels cancel in the gradient by the means: ten times the limit.
    "larger than integers": (frontal_scene(cloud(6), scales_of([1e12, 1e9, 1e10], n=6), 0.3), (1e-5, 1e-3)),
    "at the near plane": (
        frontal_scene(cloud(40, spread=(0.008, 0.008, 0.0199), centre=(0, 0, 0.0301)), 1e-3, 0.5), STIFF),
    "partly behind the camera": (frontal_scene(cloud(80, spread=(1, 1, 4.0), centre=(0, 0, 0)), 0.15, 0.6), STIFF),
    "beyond the clamp": (frontal_scene(cloud(60, spread=(6, 6, 0.5), centre=(0, 0, 1.2)), 0.5, 0.5), STIFF),
    "tiny focal length": (frontal_scene(cloud(40), 0.5, 0.5, focal=0.5), STIFF),
    "long focal length": (
        frontal_scene(cloud(60, spread=(0.4, 0.4, 0.5), centre=(0, 0, 1000.0)), 0.05, 0.6, 64, 64, 9600.0 * 4),
        NEEDLES),
    "opaque stack": (
        frontal_scene(cloud(50, spread=(0.05, 0.05, 0.8)), scales_of([0.3, 0.2, 0.1], n=50), 1.0), STIFF),
    "nearly opaque front": (
        frontal_scene(cloud(6, spread=(0.1, 0.1, 0.0)) + torch.arange(6)[:, None] * torch.tensor([0, 0, 0.1]),
                      0.4, [0.9, 0.95, 0.9, 0.5, 0.6, 0.7]), STIFF),
    "3000 faint layers": (
        frontal_scene(cloud(3000, spread=(0.2, 0.2, 0.8)), 0.5,
                      torch.rand(3000, generator=torch.Generator().manual_seed(1)) * 0.016 + 0.004, 12, 12, 15.0),
        STIFF),
    "opacities at the cut-off": (
        frontal_scene(cloud(60), 0.3, torch.linspace(0.0, 0.012, 60, dtype=torch.float64)), STIFF),
    "one Gaussian": (frontal_scene(cloud(1), 0.2, 0.8), STIFF),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_stiff_scenes_equal_the_dense_twin(name, dtype, device):
    scene, (values, gradients) = CASES[name]
    if dtype == torch.float64:
        values, gradients = 1e-11, 1e-8
    # A flat line of pixels at the cut-off runs around every Gaussian; the more of them, the more pixels.
    assert_equals_twin(scene, dtype, device, values, gradients, max_fragile=0.6)


@pytest.mark.parametrize("norm", [1e-12, 1e-3, 1e3, 1e12])
def test_the_norm_of_quaternions_does_not_matter(norm, device):
    scene = ordinary_scene(1)
    unit = torch.nn.functional.normalize(scene.quats.double(), dim=-1)
    assert_equals_twin(scene.with_(quats=(norm * unit).float()), torch.float32, device, *STIFF)


def test_a_far_origin_of_the_world_costs_no_accuracy(device):
    shift = torch.tensor([1000.0, -500.0, 2000.0], dtype=torch.float64)
    scene = ordinary_scene(2)
    eyes = [(0.3, -0.2, -3.0), (2.1, 0.4, -2.2)]
    viewmats = torch.stack([look_from((torch.tensor(e) + shift).tolist(), shift.tolist()) for e in eyes])
    scene = scene.with_(means=(scene.means.double() + shift).float(), viewmats=viewmats.float())
    assert_equals_twin(scene, torch.float32, device, *STIFF)


@pytest.mark.parametrize("reverse", [False, True])
def test_equal_depths_are_drawn_in_the_order_of_memory(reverse, device):
    means = cloud(30)
    means[:, 2] = 3.0
    scene = frontal_scene(means, 0.2, 0.7)
    if reverse:
        scene = scene.with_(means=scene.means.flip(0), colors=scene.colors.flip(0))
    assert_equals_twin(scene, torch.float32, device, *STIFF)


def test_all_gaussians_behind_the_camera_leave_the_background_untouched(device):
    scene = frontal_scene(cloud(50, centre=(0, 0, -3.0)), 0.3, 0.9).to(device, torch.float32)
    image, alphas = draw(scene)
    assert torch.equal(image, scene.backgrounds[:, None, None].expand_as(image))
    assert not alphas.any()


def test_a_gaussian_on_the_near_plane_is_drawn(device):
    scene = frontal_scene([[0.0, 0.0, 0.01]], 1e-3, 0.9).to(device, torch.float32)
    assert draw(scene)[1].any()
    nearer = scene.with_(means=torch.nextafter(scene.means, torch.zeros_like(scene.means)))
    assert not draw(nearer)[1].any()


def test_no_gaussians_give_the_background_and_empty_gradients(device):
    scene = ordinary_scene(3, device=device)
    inputs = {k: getattr(scene, k)[:0].requires_grad_() for k in ("means", "quats", "scales", "opacities", "colors")}
    viewmats, backgrounds = (getattr(scene, k).clone().requires_grad_() for k in ("viewmats", "backgrounds"))
    empty = scene.with_(**inputs, viewmats=viewmats, backgrounds=backgrounds)
    image, alphas = draw(empty)
    assert torch.equal(image, backgrounds[:, None, None].expand_as(image))
    assert not alphas.any()
    gradients = torch.autograd.grad(image.sum() + alphas.sum(), [*inputs.values(), viewmats, backgrounds])
    assert [tuple(g.shape) for g in gradients[:5]] == [(0, 3), (0, 4), (0, 3), (0,), (0, 3)]
    assert not gradients[5].any()
    assert torch.allclose(gradients[6], torch.full_like(backgrounds, scene.width * scene.height))


def test_culled_gaussians_get_zero_gradients(device):
    scene = ordinary_scene(4, device=device)
    means = scene.means.clone().requires_grad_()
    far = means + torch.where(torch.arange(60, device=device) % 2 == 0, 0.0, 1e4)[:, None]
    image, _ = draw(scene.with_(means=far))
    (g,) = torch.autograd.grad(image.square().sum(), means)
    assert not g[1::2].any() and g[::2].any()


def test_a_gaussian_in_the_plane_of_the_camera_gets_a_zero_gradient(device):
    # Dividing by its depth, even where the result is multiplied by zero, would give NaN.
    scene = frontal_scene([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], 0.3, 0.8).to(device)
    inputs = [t.clone().requires_grad_() for t in (*scene.gaussians, scene.viewmats)]
    image, *_ = rasterization(*inputs[:4], scene.colors, inputs[4], scene.Ks, 32, 32, render_mode="RGB+D")
    *gradients, g_viewmats = torch.autograd.grad(image.square().sum(), inputs)
    assert all(not g[0].any() and g[1].any() for g in gradients)
    assert torch.isfinite(g_viewmats).all()


def test_one_tile_can_hold_twenty_thousand_gaussians(device):
    g = torch.Generator().manual_seed(6)
    opacities = torch.rand(20_000, generator=g) * 0.01 + 0.003
    scene = frontal_scene(cloud(20_000, spread=(0.3, 0.3, 1.0)), 0.05, opacities, 8, 7, 10.0)
    assert_equals_twin(scene, torch.float32, device, *STIFF, max_fragile=1.0)


@pytest.mark.slow
def test_more_pairs_than_can_be_counted_are_refused_with_their_number():
    n, size = 2**19 + 1, 64
    K, eye = intrinsics(50.0, 50.0, 32.0, 32.0).float()[None], torch.eye(4)[None]
    means = torch.zeros(n, 3)
    means[:, 2] = 2
    options = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3}
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    projection = project(means, quats, torch.full((n, 3), 9.0), torch.full((n,), 0.5), eye, K, size, size, **options)
    with pytest.raises(ValueError, match=f"at most {MAX_PAIRS} pairs of a Gaussian and a tile, got {n * 4096}"):
        bin_to_tiles(projection.tables().boxes, projection.tables().sort_depths, size, size, 1)


@pytest.mark.parametrize("name", ["larger than the image", "3000 faint layers", "partly behind the camera"])
def test_dealing_and_sorting_fill_the_same_lists(name):
    scene = CASES[name][0]
    scene = scene.with_(means=torch.cat([scene.means, scene.means]))  # every depth is there twice
    twice = [torch.cat([t, t]) for t in scene.gaussians[1:]]
    options = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3}
    cameras, Ks = scene.viewmats.repeat(2, 1, 1), scene.Ks.repeat(2, 1, 1)
    projection = project(scene.means, *twice, cameras, Ks, scene.width, scene.height, **options)
    records = projection.tables()
    dealt, sorted_ = (f(records.boxes, records.sort_depths, 7, 10, 10) for f in (bin_by_dealing, bin_by_sorting))
    assert torch.equal(dealt.starts, sorted_.starts)
    assert torch.equal(opaque_elements(dealt.gaussians), opaque_elements(sorted_.gaussians))
    assert torch.equal(dealt.pair_counts, sorted_.pair_counts)
    for lists in (dealt, sorted_):
        gaussians, pairs = opaque_elements(lists.gaussians), opaque_elements(lists.pairs)
        # A pair's number is its Gaussian's first plus its place among that Gaussian's tiles.
        first = lists.pair_starts[gaussians.long()]
        place = pairs - first
        assert place.min() >= 0 and (place < lists.pair_counts[gaussians.long()]).all()
        assert torch.equal(pairs.sort().values, torch.arange(len(pairs)))


def test_ordinary_scenes_do_not_feel_an_absent_low_pass(device):
    scene = ordinary_scene(5)
    assert_equals_twin(scene, torch.float32, device, *STIFF, eps2d=0.0)


def test_flat_gaussians_seen_edge_on_are_skipped_without_a_low_pass(device):
    scene = frontal_scene(cloud(10), 0.0, 0.9).to(device, torch.float32)
    image, alphas, meta = rasterization(*scene.gaussians, scene.colors, scene.viewmats, scene.Ks, 32, 32, eps2d=0.0)
    assert torch.isfinite(image).all() and not alphas.any() and not meta["radii"].any()
