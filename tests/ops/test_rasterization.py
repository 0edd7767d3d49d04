"""The rasterizer against its dense float64 twin, and laws that any correct one obeys."""

from functools import partial

import pytest
import torch
from rasterization_scenes import frontal_scene, ordinary_scene

from oasis_warp.core.rotation import to_matrix
from oasis_warp.core.types import Camera
from oasis_warp.ops import rasterization
from oasis_warp.reference import rasterization as twin

# Rel-L2 of a careful float32 rasterizer against float64 is below 1e-6 in values and 2e-5 in gradients; of the float64
# build against the twin it is the rounding of a few thousand operations.
VALUE_ERROR = {torch.float32: 5e-6, torch.float64: 1e-12}
GRADIENT_ERROR = {torch.float32: 5e-5, torch.float64: 1e-11}
INPUTS = "means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"


def draw(scene, function=rasterization, **options):
    out = function(
        *scene.gaussians, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height,
        backgrounds=scene.backgrounds, **options,
    )  # fmt: skip
    return out[0], out[1]


def rel(a, b):
    scale = b.norm()
    return float((a.double().cpu() - b).norm() / scale) if scale > 0 else float(a.abs().max())


def values_and_gradients(scene, function=rasterization, keep=None, seed=0, **options):
    """Image, alpha and the gradients of a randomly signed sum over them; pixels not in `keep` do not count."""
    inputs = {name: getattr(scene, name).detach().clone().requires_grad_() for name in INPUTS}
    image, alphas = draw(scene.with_(**inputs), function, **options)
    g = torch.Generator().manual_seed(seed)
    loss = 0
    for out in (image, alphas):
        weight = torch.randint(0, 2, out.shape, generator=g).to(out) * 2 - 1
        if keep is not None:
            weight = weight * keep[..., None].to(out)
        loss = loss + (out * weight).sum()
    return image.detach(), alphas.detach(), torch.autograd.grad(loss, list(inputs.values()), allow_unused=True)


def sound_pixels(scene, **options):
    """Pixels [C, H, W] where no decision hangs on rounding."""
    views = scene.viewmats, scene.Ks, scene.width, scene.height
    return ~twin.rasterization(*scene.gaussians, scene.colors, *views, dense=True, **options).fragile


def assert_equals_twin(scene, dtype, device, value_error=None, gradient_error=None, max_fragile=0.02, **options):
    exact = scene.to("cpu", torch.float64)
    depth_options = {k: v for k, v in options.items() if k in ("near_plane", "far_plane", "eps2d")}
    mode = {k: v for k, v in options.items() if k == "render_mode"}
    keep = sound_pixels(exact, **depth_options)
    assert (~keep).double().mean() <= max_fragile, "choose a scene with fewer fragile pixels"
    image, alphas, gradients = values_and_gradients(scene.to(device, dtype), keep=keep.to(device), **options)
    dense = partial(twin.rasterization, dense=True)
    image64, alphas64, gradients64 = values_and_gradients(exact, dense, keep=keep, **mode, **depth_options)
    limit = VALUE_ERROR[dtype] if value_error is None else value_error
    for name, got, want in (("image", image, image64), ("alphas", alphas, alphas64)):
        assert torch.isfinite(got).all(), name
        assert rel(got * keep[..., None].to(got), want * keep[..., None]) <= limit, name
        assert float((got.double().cpu() - want).abs().max()) <= 6e-3 * float(want.abs().max() + 1), name
    limit = GRADIENT_ERROR[dtype] if gradient_error is None else gradient_error
    for name, got, want in zip(INPUTS, gradients, gradients64, strict=True):
        if want is None:
            assert got is None or not got.any(), name
            continue
        assert torch.isfinite(got).all(), name
        assert rel(got, want) <= limit, f"{name}: {rel(got, want):.2e}"


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request):
    return request.param


@pytest.mark.parametrize("seed", range(6))
def test_values_and_gradients_equal_the_dense_twin(seed, device, dtype):
    assert_equals_twin(ordinary_scene(seed, n=60 + 30 * seed), dtype, device)


@pytest.mark.parametrize("mode", ["D", "ED", "RGB+D", "RGB+ED"])
def test_every_render_mode_equals_the_dense_twin(mode, device, dtype):
    # ED divides by alpha, which magnifies the rounding of 1 - T in the float64 twin where alpha is near 1/255.
    error = 1e-10 if dtype == torch.float64 else None
    assert_equals_twin(ordinary_scene(11), dtype, device, error, error, render_mode=mode)


@pytest.mark.parametrize("channels", [1, 2, 5, 32])
def test_any_number_of_channels_up_to_32_equals_the_dense_twin(channels, device, dtype):
    assert_equals_twin(ordinary_scene(12, channels=channels), dtype, device)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (257, 2), (65, 63)])
def test_odd_image_sizes_equal_the_dense_twin(size, device, dtype):
    assert_equals_twin(ordinary_scene(14, width=size[0], height=size[1]), dtype, device, max_fragile=0.2)


def test_four_cameras_equal_the_dense_twin(device, dtype):
    assert_equals_twin(ordinary_scene(13, cameras=4), dtype, device)


def test_a_narrow_low_pass_and_tight_planes_equal_the_dense_twin(device, dtype):
    assert_equals_twin(ordinary_scene(15), dtype, device, eps2d=0.02, near_plane=2.5, far_plane=3.4)


@pytest.mark.parametrize("name", INPUTS)
def test_a_gradient_does_not_depend_on_which_others_are_asked_for(name, device):
    scene = ordinary_scene(16, device=device, dtype=torch.float64)
    all_of_them = dict(zip(INPUTS, values_and_gradients(scene)[2], strict=True))
    alone = getattr(scene, name).clone().requires_grad_()
    image, alphas = draw(scene.with_(**{name: alone}))
    g = torch.Generator().manual_seed(0)
    weights = [torch.randint(0, 2, out.shape, generator=g).to(out) * 2 - 1 for out in (image, alphas)]
    (gradient,) = torch.autograd.grad((image * weights[0]).sum() + (alphas * weights[1]).sum(), alone)
    assert torch.equal(gradient, all_of_them[name])


def test_colors_of_each_camera_are_drawn_in_that_camera(device):
    scene = ordinary_scene(17, device=device)
    colors = torch.stack([scene.colors, 1 - scene.colors])
    image, _ = draw(scene.with_(colors=colors))
    for c in range(2):
        one = scene.with_(colors=colors[c], viewmats=scene.viewmats[c : c + 1], Ks=scene.Ks[c : c + 1],
                          backgrounds=scene.backgrounds[c : c + 1])  # fmt: skip
        assert torch.equal(draw(one)[0][0], image[c])


def test_no_background_is_a_black_one(device):
    scene = ordinary_scene(18, device=device)
    black, _ = draw(scene.with_(backgrounds=torch.zeros_like(scene.backgrounds)))
    assert torch.equal(draw(scene.with_(backgrounds=None))[0], black)


# Laws


@pytest.mark.parametrize("factor", [-1.0, 2.0, -0.5])
def test_the_sign_and_a_power_of_two_of_a_quaternion_change_no_bit(factor, device, dtype):
    scene = ordinary_scene(20, device=device, dtype=dtype)
    assert torch.equal(draw(scene)[0], draw(scene.with_(quats=factor * scene.quats))[0])


def test_the_order_in_memory_does_not_matter(device, dtype):
    scene = ordinary_scene(21, device=device, dtype=dtype)
    order = torch.randperm(len(scene.means), generator=torch.Generator().manual_seed(0)).to(device)
    shuffled = scene.with_(**{k: getattr(scene, k)[order] for k in ("means", "quats", "scales", "opacities", "colors")})
    # Depths are distinct, so that the layers and with them every rounding are the same.
    assert torch.equal(draw(scene)[0], draw(shuffled)[0])


def test_the_image_is_linear_in_the_background(device, dtype):
    scene = ordinary_scene(22, device=device, dtype=dtype)
    image, alphas = draw(scene)
    black, _ = draw(scene.with_(backgrounds=None))
    expected = black + (1 - alphas) * scene.backgrounds[:, None, None]
    assert torch.allclose(image, expected, rtol=0, atol=8 * torch.finfo(dtype).eps)


def test_the_image_is_linear_in_the_colors(device, dtype):
    a, b = (ordinary_scene(seed, device=device, dtype=dtype).with_(backgrounds=None) for seed in (23, 24))
    other = a.with_(colors=b.colors)
    mixed = a.with_(colors=0.25 * a.colors - 2 * other.colors)
    expected = 0.25 * draw(a)[0] - 2 * draw(other)[0]
    assert torch.allclose(draw(mixed)[0], expected, rtol=0, atol=50 * torch.finfo(dtype).eps)


def test_alpha_stays_in_0_to_1_and_never_passes_the_stop(device, dtype):
    scene = ordinary_scene(25, n=400, device=device, dtype=dtype)
    alphas = draw(scene.with_(opacities=torch.ones_like(scene.opacities)))[1]
    assert alphas.min() >= 0 and alphas.max() <= 1 - 1e-4 + 4 * torch.finfo(dtype).eps
    assert alphas.max() > 0.999, "the scene should be opaque somewhere"


def test_gaussians_of_zero_opacity_change_nothing(device, dtype):
    scene, extra = (ordinary_scene(seed, device=device, dtype=dtype) for seed in (26, 27))
    extra = extra.with_(opacities=torch.zeros_like(extra.opacities))
    both = {k: torch.cat([getattr(extra, k), getattr(scene, k)]) for k in INPUTS[:5]}
    assert torch.equal(draw(scene)[0], draw(scene.with_(**both))[0])


def test_moving_scene_and_camera_together_changes_nothing(device):
    scene = ordinary_scene(28, device=device, dtype=torch.float64)
    turn = torch.tensor([[0.3, 0.8, -0.4, 0.2]], dtype=torch.float64)
    R = to_matrix(turn)[0].to(device)
    w, x, y, z = (turn[0] / turn.norm()).to(device)
    left = torch.stack([
        torch.stack([w, -x, -y, -z]), torch.stack([x, w, -z, y]), torch.stack([y, z, w, -x]),
        torch.stack([z, -y, x, w]),
    ])  # fmt: skip
    shift = torch.tensor([0.5, -2.0, 1.0], dtype=torch.float64, device=device)
    back = torch.eye(4, dtype=torch.float64, device=device)
    back[:3, :3], back[:3, 3] = R.T, -R.T @ shift
    moved = scene.with_(means=scene.means @ R.T + shift, quats=scene.quats @ left.T, viewmats=scene.viewmats @ back)
    assert torch.allclose(draw(scene)[0], draw(moved)[0], rtol=0, atol=1e-10)


def test_scaling_the_world_changes_nothing(device):
    scene = ordinary_scene(29, device=device, dtype=torch.float64)
    viewmats = scene.viewmats.clone()
    viewmats[:, :3, 3] *= 7
    scaled = scene.with_(means=7 * scene.means, scales=7 * scene.scales, viewmats=viewmats)
    assert torch.allclose(draw(scene)[0], draw(scaled)[0], rtol=0, atol=1e-11)


def test_a_crop_is_a_shift_of_the_principal_point(device):
    # The Jacobian's clamp depends on the image's borders; nothing here comes near it.
    scene = ordinary_scene(30, width=48, height=40, device=device, dtype=torch.float64)
    scene = scene.with_(means=0.5 * scene.means)
    Ks = scene.Ks.clone()
    Ks[:, 0, 2] -= 7
    Ks[:, 1, 2] -= 5
    crop = scene.with_(Ks=Ks, width=36, height=30)
    assert torch.allclose(draw(scene)[0][:, 5:35, 7:43], draw(crop)[0], rtol=0, atol=1e-10)


def test_mirroring_the_world_mirrors_the_image(device):
    scene = frontal_scene(
        ordinary_scene(31).means.double() + torch.tensor([0, 0, 3.0]), 0.08, 0.7, colors=ordinary_scene(31).colors
    ).to(device)
    flip = torch.tensor([-1.0, 1, 1], dtype=torch.float64, device=device)
    Ks = scene.Ks.clone()
    Ks[:, 0, 2] = scene.width - Ks[:, 0, 2]
    turned = scene.quats * torch.tensor([1.0, 1, -1, -1], dtype=torch.float64, device=device)
    mirrored = scene.with_(means=scene.means * flip, quats=turned, Ks=Ks)
    assert torch.allclose(draw(scene)[0].flip(2), draw(mirrored)[0], rtol=0, atol=1e-11)


def test_an_opaque_front_layer_hides_the_rest_up_to_the_cap(device, dtype):
    behind = ordinary_scene(32)
    scene = frontal_scene(
        torch.cat([torch.tensor([[0.0, 0, 1.0]]), behind.means + torch.tensor([0, 0, 4.0])]),
        torch.cat([torch.full((1, 3), 50.0), behind.scales]),
        torch.cat([torch.ones(1), behind.opacities]),
    ).to(device, dtype)
    image = draw(scene.with_(backgrounds=None))[0]
    assert (image - scene.colors[0]).abs().max() <= 1.01e-3


def test_tile_size_changes_no_bit_of_image_or_alpha(device, dtype):
    scene = ordinary_scene(33, device=device, dtype=dtype)
    image, alphas = draw(scene)
    for tile_size in (1, 5, 8, 64):
        other, other_alphas = draw(scene, tile_size=tile_size)
        # On CUDA lanes of one and of several pixels are unrolled apart, and their multiply-adds fused apart.
        atol = 0 if device.type == "cpu" else 10 * torch.finfo(dtype).eps
        torch.testing.assert_close((image, alphas), (other, other_alphas), rtol=0, atol=atol)


def test_repeats_are_bit_equal(device, dtype):
    scene = ordinary_scene(34, n=300, device=device, dtype=dtype)
    first = values_and_gradients(scene)
    for _ in range(3):
        again = values_and_gradients(scene)
        assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
        assert all(torch.equal(a, b) for a, b in zip(first[2], again[2], strict=True))


def test_the_number_of_threads_changes_no_bit(dtype):
    # Large enough that projection, too, is shared out.
    scene = ordinary_scene(35, n=5000, width=64, height=48, size=(0.01, 0.04), dtype=dtype)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = values_and_gradients(scene)
        torch.set_num_threads(3)
        shared = values_and_gradients(scene)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(alone[0], shared[0]) and torch.equal(alone[1], shared[1])
    for name, a, b in zip(INPUTS, alone[2], shared[2], strict=True):
        assert torch.equal(a, b), name


def test_meta_describes_the_projection(device):
    scene = ordinary_scene(36, device=device, dtype=torch.float64)
    *_, meta = rasterization(*scene.gaussians, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height)
    cpu = scene.to("cpu")
    for c in range(2):
        splats = twin.project(
            twin.Gaussians(*cpu.gaussians), Camera(cpu.viewmats[c], cpu.Ks[c], scene.width, scene.height)
        )
        order = splats.index.argsort()
        assert torch.equal(splats.index[order], torch.arange(60))
        drawn = (meta["radii"][c] > 0).all(-1).cpu()
        assert torch.allclose(meta["means2d"][c].cpu()[drawn], splats.centers[order][drawn], rtol=1e-13)
        assert torch.allclose(meta["depths"][c].cpu(), splats.depths[order], rtol=1e-13)
        cov = splats.covars[order][:, [0, 1, 1, 2]]
        conic = torch.linalg.inv(cov.reshape(-1, 2, 2)).reshape(-1, 4)[:, [0, 1, 3]]
        assert torch.allclose(meta["conics"][c].cpu()[drawn], conic[drawn], rtol=1e-9)
        reach = torch.sqrt(2 * torch.log(255 * cpu.opacities))
        radii = torch.ceil(reach[:, None] * cov[:, [0, 3]].sqrt())
        assert (meta["radii"][c].cpu()[drawn] - radii[drawn]).abs().max() <= 1
    assert meta["opacities"].shape == (2, 60)
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (37, 29, 2)
    assert meta["tile_size"] == 16


def test_means2d_of_meta_keeps_its_gradient_for_densification(device):
    scene = ordinary_scene(37, device=device, dtype=torch.float64)
    means = scene.means.clone().requires_grad_()
    image, _, meta = rasterization(
        means, *scene.gaussians[1:], scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height
    )
    meta["means2d"].retain_grad()
    image.square().sum().backward()
    assert meta["means2d"].grad.shape == (2, 60, 2) and meta["means2d"].grad.abs().sum() > 0


def test_a_radius_clip_drops_the_small_ones(device):
    scene = ordinary_scene(38, device=device)
    _, _, meta = rasterization(*scene.gaussians, scene.colors, scene.viewmats, scene.Ks, 37, 29)
    clip = float(meta["radii"].amax(-1).float().median())
    _, _, clipped = rasterization(*scene.gaussians, scene.colors, scene.viewmats, scene.Ks, 37, 29, radius_clip=clip)
    expected = torch.where((meta["radii"] > clip).any(-1, keepdim=True), meta["radii"], 0)
    assert torch.equal(clipped["radii"], expected)
