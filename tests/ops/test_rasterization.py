"""Laws that any correct rasterizer obeys, its limits, and gsplat's options against gsplat's definitions."""

import pytest
import torch
from rasterization_scenes import cloud, frontal_scene, ordinary_scene

from oasis_warp.certify.case import STIFF, Case
from oasis_warp.certify.compare import compare
from oasis_warp.certify.families import FAMILIES
from oasis_warp.core.rotation import to_matrix
from oasis_warp.core.types import Camera
from oasis_warp.ops import rasterization
from oasis_warp.reference import rasterization as reference

INPUTS = "means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"


def draw(scene, **options):
    out = rasterization(
        *scene.gaussians, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height,
        backgrounds=scene.backgrounds, **options,
    )  # fmt: skip
    return out[0], out[1]


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


def test_alpha_stays_in_0_to_1_and_never_passes_the_stop(device, dtype):
    scene = ordinary_scene(25, n=400, device=device, dtype=dtype)
    alphas = draw(scene.with_(opacities=torch.ones_like(scene.opacities)))[1]
    assert alphas.min() >= 0 and alphas.max() <= 1 - 1e-4 + 4 * torch.finfo(dtype).eps
    assert alphas.max() > 0.999, "the scene should be opaque somewhere"


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


def test_mirroring_the_world_mirrors_the_image(device):
    scene = frontal_scene(
        ordinary_scene(31).means.double() + torch.tensor([0, 0, 3.0]), 0.08, 0.7, colors=ordinary_scene(31).colors
    ).to(device)
    flip = torch.tensor([-1.0, 1, 1], dtype=torch.float64, device=device)
    Ks = scene.Ks.clone()
    Ks[:, 0, 2] = scene.width - Ks[:, 0, 2]
    rotated = scene.quats * torch.tensor([1.0, 1, -1, -1], dtype=torch.float64, device=device)
    mirrored = scene.with_(means=scene.means * flip, quats=rotated, Ks=Ks)
    assert torch.allclose(draw(scene)[0].flip(2), draw(mirrored)[0], rtol=0, atol=1e-11)


def test_tile_size_changes_no_bit_of_image_or_alpha(device, dtype):
    scene = ordinary_scene(33, device=device, dtype=dtype)
    image, alphas = draw(scene)
    for tile_size in (1, 5, 8, 64):
        other, other_alphas = draw(scene, tile_size=tile_size)
        # On CUDA lanes of one and of several pixels are unrolled apart, and their multiply-adds fused apart.
        atol = 0 if device.type == "cpu" else 10 * torch.finfo(dtype).eps
        torch.testing.assert_close((image, alphas), (other, other_alphas), rtol=0, atol=atol)


# Limits


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


def test_one_tile_can_hold_twenty_thousand_gaussians(device):
    g = torch.Generator().manual_seed(6)
    opacities = torch.rand(20_000, generator=g) * 0.01 + 0.003
    scene = frontal_scene(cloud(20_000, spread=(0.3, 0.3, 1.0)), 0.05, opacities, 8, 7, 10.0)
    names = *INPUTS[:6], "backgrounds"
    floats = {name: getattr(scene, name) for name in (*names, "Ks")}
    case = Case("20,000 layers", 0, floats, names, {"width": 8, "height": 7}, STIFF)
    assert all(found.passed for found in compare(FAMILIES["rasterization"], case, torch.float32, device))


def test_flat_gaussians_seen_edge_on_are_skipped_without_a_low_pass(device):
    scene = frontal_scene(cloud(10), 0.0, 0.9).to(device, torch.float32)
    image, alphas, meta = rasterization(*scene.gaussians, scene.colors, scene.viewmats, scene.Ks, 32, 32, eps2d=0.0)
    assert torch.isfinite(image).all() and not alphas.any() and not meta["radii"].any()


# What comes with the images


def test_meta_describes_the_projection(device):
    scene = ordinary_scene(36, device=device, dtype=torch.float64)
    *_, meta = rasterization(*scene.gaussians, scene.colors, scene.viewmats, scene.Ks, scene.width, scene.height)
    cpu = scene.to("cpu")
    for c in range(2):
        splats = reference.project(
            reference.Gaussians(*cpu.gaussians), Camera(cpu.viewmats[c], cpu.Ks[c], scene.width, scene.height)
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


SIZE = 24
EPS2D = 0.3


def scene(dtype=torch.float64, device="cpu", n=30):
    """Gaussians of all sizes, many below a pixel, that overlap and leave the image on all sides."""
    random = torch.Generator().manual_seed(3)
    means = torch.rand(n, 3, generator=random) * torch.tensor([1.2, 1.2, 0.8]) + torch.tensor([-0.6, -0.6, 1.5])
    quats = torch.randn(n, 4, generator=random)
    scales = torch.exp(torch.randn(n, 3, generator=random) * 0.6 - 3.2)
    opacities = torch.rand(n, generator=random) * 0.8 + 0.1
    colors = torch.rand(n, 3, generator=random)
    rotated = torch.tensor([[0.98, 0, 0.2, 0.05], [0, 1, 0, -0.1], [-0.2, 0, 0.98, 0.3], [0, 0, 0, 1]])
    viewmats = torch.stack([torch.eye(4), rotated])
    Ks = torch.tensor([[[30.0, 0, 12], [0, 28.0, 11], [0, 0, 1]]]).expand(2, 3, 3)
    return [t.to(device, dtype).contiguous() for t in (means, quats, scales, opacities, colors, viewmats, Ks)]


def matrices(conics):
    xx, xy, yy = conics.unbind(-1)
    return torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2))


def test_antialiasing_fades_gaussians_by_the_root_of_the_ratio_of_determinants(device):
    *inputs, Ks = scene(device=device)
    _, _, meta = rasterization(*inputs, Ks, SIZE, SIZE, eps2d=EPS2D, rasterize_mode="antialiased")
    drawn = (meta["radii"] > 0).all(-1)
    blurred = torch.linalg.inv(matrices(meta["conics"][drawn]))
    sharp = blurred - EPS2D * torch.eye(2).to(blurred)
    opacities = inputs[3].expand(2, -1)[drawn]
    expected = opacities * (torch.linalg.det(sharp) / torch.linalg.det(blurred)).clamp_min(0).sqrt()
    torch.testing.assert_close(meta["opacities"][drawn], expected, rtol=1e-9, atol=1e-12)
    assert float((expected / opacities).min()) < 0.7  # some are well below a pixel


def test_an_antialiased_picture_is_the_classic_one_of_faded_gaussians():
    means, quats, scales, opacities, colors, viewmats, Ks = scene()
    one = viewmats[:1], Ks[:1], SIZE, SIZE
    image, alpha, meta = rasterization(means, quats, scales, opacities, colors, *one, rasterize_mode="antialiased")
    faded = meta["opacities"][0]
    plain, plain_alpha, _ = rasterization(means, quats, scales, faded, colors, *one)
    torch.testing.assert_close(image, plain, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(alpha, plain_alpha, rtol=1e-9, atol=1e-9)


def signs(like):
    """Weights of a loss, another one for each number."""
    return torch.sin(torch.arange(like.numel(), dtype=like.dtype, device=like.device)).view(like.shape)


def loss_of(render, alphas):
    return (render * signs(render)).sum() + (alphas * signs(alphas)).sum()


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_absolute_gradients_are_sums_over_pixels_of_magnitudes(device, dtype, mode):
    *inputs, Ks = scene(dtype, device, n=12)
    inputs[0].requires_grad_()
    size = 4
    Ks = Ks * torch.tensor([[size / SIZE], [size / SIZE], [1.0]]).to(Ks)
    arguments = (*inputs, Ks, size, size)
    render, alphas, meta = rasterization(*arguments, render_mode=mode, absgrad=True)
    meta["means2d"].retain_grad()
    loss_of(render, alphas).backward()

    expected = torch.zeros_like(meta["means2d"])
    render, alphas, plain = rasterization(*arguments, render_mode=mode, absgrad=True)  # one node would hide means2d
    by_pixel = (render * signs(render)).sum(-1) + (alphas * signs(alphas)).sum(-1)
    for c in range(2):
        for y in range(size):
            for x in range(size):
                (gradient,) = torch.autograd.grad(by_pixel[c, y, x], plain["means2d"], retain_graph=True)
                expected += gradient.abs()
    rounding = 1e-4 if dtype == torch.float32 else 1e-6
    assert (meta["means2d"].absgrad - expected).norm() <= rounding * expected.norm()
    assert bool((meta["means2d"].absgrad >= meta["means2d"].grad.abs() - rounding * expected.max()).all())


def test_without_a_gradient_nothing_is_recorded():
    *inputs, Ks = scene(n=5)
    _, _, meta = rasterization(*inputs, Ks, SIZE, SIZE, absgrad=True)
    assert not hasattr(meta["means2d"], "absgrad")


def test_an_orthographic_camera_shifts_and_scales_alone(device):
    """The picture does not depend on depth but for the order: J = diag(fx, fy) without slopes."""
    means, quats, scales, opacities, colors, viewmats, Ks = scene(device=device)
    _, _, meta = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, SIZE, SIZE, camera_model="ortho")
    drawn = (meta["radii"] > 0).all(-1)
    assert int(drawn.sum()) > 20
    at = means @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    expected = at[..., :2] * Ks[:, None, [0, 1], [0, 1]] + Ks[:, None, :2, 2]
    torch.testing.assert_close(meta["means2d"][drawn], expected[drawn], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(meta["depths"], at[..., 2], rtol=1e-9, atol=1e-9)

    factor = to_matrix(torch.nn.functional.normalize(quats, dim=1)) * scales[:, None]
    rows = viewmats[:, None, :2, :3] @ (factor @ factor.mT) @ viewmats[:, None, :2, :3].mT
    focal = Ks[:, None, [0, 1], [0, 1]]
    covariance = rows * focal[..., :, None] * focal[..., None, :] + EPS2D * torch.eye(2).to(rows)
    found = torch.linalg.inv(matrices(meta["conics"][drawn]))
    torch.testing.assert_close(found, covariance[drawn], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("option", [{"rasterize_mode": "smooth"}, {"camera_model": "fisheye"}])
def test_what_gsplat_does_not_know_either_or_we_do_not_build_is_refused(option, as_shipped):
    *inputs, Ks = scene(n=2)
    (name,) = option
    with pytest.raises(ValueError, match=name):
        rasterization(*inputs, Ks, SIZE, SIZE, **option)
