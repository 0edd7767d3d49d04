import itertools

import pytest
import torch
from torch.nn.functional import normalize

from oasis_warp.avatar import sky
from oasis_warp.avatar.vertex_light import Lighting, vertex_light, vertex_light_in_steps
from oasis_warp.core.types import HandLight
from oasis_warp.ops.vertex_light import Coarse, InPhoto, Rules, light_vertices


@pytest.fixture
def scene(hand, device):
    """Light with all that a photo adds to it, and three surfaces: one as in the photo, one near it."""
    random, n = torch.Generator().manual_seed(0), len(hand.template)
    facing = normalize(torch.randn(n, 3, generator=random), dim=1)
    near = normalize(facing + 0.2 * torch.randn(n, 3, generator=random), dim=1)
    far = normalize(torch.randn(n, 3, generator=random), dim=1)
    harmonics = 0.3 * torch.randn(9, 3, generator=random)
    harmonics[0] = 1
    light = HandLight(
        harmonics, torch.tensor([[0.2, 0.1, 0.05], [1.6, 1.5, 1.4]]), torch.ones(3),
        shade=0.5 + torch.rand(n, 3, generator=random), facing=facing, albedo=torch.tensor([0.5, 0.35, 0.3]),
        doubt=torch.rand(n, generator=random),
    )  # fmt: skip
    exposure = torch.rand(3, n, 4, generator=random) * torch.rand(3, n, 1, generator=random)
    on = Lighting(torch.stack([facing, near, far]), exposure, torch.rand(3, n, generator=random))
    seen = (exposure[1, :, 0] - 0.2 * torch.rand(n, generator=random)).clamp_min(0)
    seen[::2] = 1
    viewed = torch.tensor([[1.0, 0.3], [0.6, 0.0], [0.0, 1.0]])
    there = HandLight(*(None if part is None else part.to(device) for part in light))
    on = Lighting(*(None if part is None else part.to(device) for part in on))
    return there, on, seen.to(device), viewed.to(device)


def test_one_kernel_gives_what_many_steps_give_with_any_part_left_out(scene):
    """Each part has a branch of its own in the kernel; the steps are those of gradients."""
    light, on, seen, viewed = scene
    lights = [light, light._replace(shade=None, doubt=None), light._replace(harmonics=light.harmonics[:4]),
              light._replace(facing=None, shade=None), light._replace(albedo=None)]  # fmt: skip
    for own, closeness, was, share in itertools.product(lights, (on.closeness, None), (seen, None), (viewed, None)):
        there = on._replace(closeness=closeness, exposure=None if own.albedo is None else on.exposure)
        expected = vertex_light_in_steps(own, there, was, share)
        torch.testing.assert_close(vertex_light(own, there, was, share), expected, atol=1e-5, rtol=1e-5)
    stays = vertex_light(light, on, seen)[..., 3:]
    assert float(stays[0].max()) == 1 and float(stays[0].min()) < 0.1 and 0 < float(stays[1, :, 0].mean()) < 0.5


def test_shade_depends_on_the_whole_surface_alone(scene):
    """A mean over a batch, or over threads' parts of it, would mix surfaces."""
    light, on, seen, _ = scene
    together = vertex_light(light, on, seen)
    for k in range(3):
        alone = vertex_light(light, Lighting(*(part[k] for part in on)), seen)
        assert torch.equal(alone, together[k])


def test_gradients_take_the_steps(scene):
    light, on, seen, viewed = scene
    given = on._replace(normals=on.normals.clone().requires_grad_())
    out = vertex_light(light, given, seen, viewed)
    (gradient,) = torch.autograd.grad(out.sum(), given.normals)
    assert bool(gradient.isfinite().all()) and float(gradient.abs().max()) > 0
    torch.testing.assert_close(out.detach(), vertex_light(light, on, seen, viewed), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("given", ["viewed", "shade", "albedo"])
def test_a_gradient_by_the_view_or_the_light_alone_takes_the_steps_too(scene, given):
    """A camera whose pose alone is sought got no gradient of colours, without a word."""
    light, on, seen, viewed = scene
    leaf = (viewed if given == "viewed" else getattr(light, given)).clone().requires_grad_()
    if given == "viewed":
        viewed = leaf
    else:
        light = light._replace(**{given: leaf})
    out = vertex_light(light, on, seen, viewed)
    (gradient,) = torch.autograd.grad(out.sum(), leaf)
    assert bool(gradient.isfinite().all()) and float(gradient.abs().max()) > 0


def test_weak_shade_goes_with_the_deep_shade_of_the_light(scene):
    """The noise of a deep shadow stayed on bright skin, as a scab, when the finger that cast it had moved."""
    light, *_ = scene
    n = len(light.facing)
    dark = torch.arange(n, device=light.facing.device) % 2 == 0
    light = light._replace(shade=torch.where(dark[:, None], 0.2, 0.9).expand(n, 3).contiguous(), doubt=None)
    moved = light.facing.clone()
    moved[n // 3 :] *= -1  # most of the hand faces elsewhere, so that deep shade ends on all of it
    stays = vertex_light(light, Lighting(torch.stack([light.facing, moved]), None), None)[..., 3:]
    assert float(stays[0].min()) > 0.99
    deep, weak = stays[1, : n // 3].unbind(-1)
    assert float(deep.max()) == 0 and float(weak[dark[: n // 3]].max()) == 0
    assert float(weak[~dark[: n // 3]].min()) > 0.99


def test_dark_light_and_no_surface_are_no_special_case(scene, device):
    """log(0) is not finite."""
    light, on, seen, _ = scene
    dark = light._replace(harmonics=torch.zeros_like(light.harmonics), limits=torch.zeros_like(light.limits))
    assert not vertex_light(dark, on, seen)[..., :3].any()
    mesh, rules = sky.sky_mesh(torch.device(device)), Rules(2.2, *[(0.0, 0.0, 0.0)] * 3, *[float(k) for k in range(12)])
    coarse = Coarse(mesh.vertices, mesh.nearby, mesh.corners)
    photo = InPhoto(light.facing, light.shade, light.doubt, None)
    none = light_vertices(on.normals[:0], light.harmonics, light.limits, rules, coarse, photo=photo)
    assert none.shape == (0, on.normals.shape[1], 5)
