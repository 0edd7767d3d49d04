"""Tiles and strips: the vector kernels of the CPU against the generic ones, and what they do to memory."""

import pytest
import torch
from rasterization_scenes import CONDITIONS, OPTIONS, frontal_scene, intrinsics, ordinary_scene, stiff_scene
from test_rasterization import INPUTS, draw

from oasis_kernels.constants import Rules
from oasis_warp.ops import blending
from oasis_warp.ops._runtime import blend_strips, blend_tiles
from oasis_warp.ops._runtime.blend_tiles import MAX_PAIRS, bin_to_tiles, opaque_elements
from oasis_warp.ops._runtime.records import Frame, GradientFlags, Splats
from oasis_warp.ops._runtime.rules import using
from oasis_warp.ops.projection import project
from oasis_warp.reference import rasterization as reference

SIZES = [(1, 1), (16, 16), (257, 2), (2, 65), (65, 63)]


VALUE_ERROR, GRADIENT_ERROR = 5e-6, 5e-5
"""Rel-L2 of a careful float32 rasterizer against float64 is below 1e-6 in values and 2e-5 in gradients."""


def rel(a, b):
    scale = b.norm()
    return float((a.double().cpu() - b).norm() / scale) if scale > 0 else float(a.abs().max())


def values_and_gradients(scene, keep=None, **options):
    """Image, alpha and the gradients of a randomly signed sum over them; pixels not in `keep` do not count."""
    inputs = {name: getattr(scene, name).detach().clone().requires_grad_() for name in INPUTS}
    image, alphas = draw(scene.with_(**inputs), **options)
    g = torch.Generator().manual_seed(0)
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
    return ~reference.rasterization(*scene.gaussians, scene.colors, *views, dense=True, **options).fragile


def generically(monkeypatch, function, *args, **options):
    """Call `function` while float32 on the CPU is drawn by the kernels of CUDA and float64."""
    with monkeypatch.context() as patch:
        patch.setattr(blending, "has_vectors", lambda like: False)
        return function(*args, **options)


def assert_same_picture(scene, monkeypatch, value_error=None, gradient_error=None, **options):
    keep = sound_pixels(scene.to(torch.float64))
    strips = values_and_gradients(scene, keep=keep, **options)
    generic = generically(monkeypatch, values_and_gradients, scene, keep=keep, **options)
    for got, want in zip(strips[:2], generic[:2], strict=True):
        seen = keep[..., None].to(got)
        assert rel(got * seen, (want * seen).double()) <= (value_error or VALUE_ERROR)
    for name, got, want in zip(INPUTS, strips[2], generic[2], strict=True):
        assert rel(got, want.double()) <= (gradient_error or GRADIENT_ERROR), name


def projected(scene):
    options = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3}
    return project(*scene.gaussians, scene.viewmats, scene.Ks, scene.width, scene.height, **options)


# The same picture as the generic kernels'


@pytest.mark.parametrize("tile_size", [1, 7, 16, 40])
def test_strips_of_any_size_draw_what_tiles_draw(tile_size, monkeypatch):
    assert_same_picture(ordinary_scene(1, n=200), monkeypatch, tile_size=tile_size)


@pytest.mark.parametrize("channels", [1, 3, 4, 8])
def test_any_number_of_channels_is_drawn_as_tiles_draw_it(channels, monkeypatch):
    assert_same_picture(ordinary_scene(2, channels=channels), monkeypatch)


@pytest.mark.parametrize("size", SIZES)
def test_images_that_end_in_mid_vector_are_drawn_as_tiles_draw_them(size, monkeypatch):
    assert_same_picture(ordinary_scene(3, width=size[0], height=size[1]), monkeypatch)


@pytest.mark.parametrize("name", CONDITIONS)
def test_stiff_scenes_are_drawn_as_tiles_draw_them(name, monkeypatch):
    assert_same_picture(stiff_scene(name).to(torch.float32), monkeypatch, 1e-5, 1e-4)


def test_a_loss_on_alpha_alone_gives_the_gradients_that_tiles_give(monkeypatch):
    scene = ordinary_scene(4)

    def gradients():
        leaves = [t.clone().requires_grad_() for t in (*scene.gaussians, scene.colors, scene.backgrounds)]
        _, alphas = draw(scene.with_(**dict(zip(
            ("means", "quats", "scales", "opacities", "colors", "backgrounds"), leaves, strict=True))))  # fmt: skip
        return torch.autograd.grad((alphas * alphas).sum(), leaves, materialize_grads=True)

    strips, generic = gradients(), generically(monkeypatch, gradients)
    assert not strips[4].any() and not strips[5].any()
    for got, want in zip(strips[:4], generic[:4], strict=True):
        assert rel(got, want.double()) <= GRADIENT_ERROR


@pytest.mark.parametrize("rules", [
    Rules(alpha_min=4 / 255), Rules(alpha_min=0.5 / 255), Rules(transmittance_stop=1e-2),
])  # fmt: skip
def test_other_rules_reach_both_kinds_of_kernels(rules, monkeypatch):
    scene = ordinary_scene(5, n=150).with_(backgrounds=None)
    usual = draw(scene)[0]
    with using(rules):
        strips = draw(scene)[0]
        generic = generically(monkeypatch, draw, scene)[0]
    assert rel(strips, generic.double()) <= 1e-3, "decisions that hang on rounding differ"
    assert rel(usual, generic.double()) >= 1e-3, "the rule should matter here"


def test_each_degree_of_the_exponential_has_its_error(monkeypatch):
    scene = ordinary_scene(6)
    exact = draw(scene.to(torch.float64))[0]
    errors = []
    for degree in (3, 4, 5):
        with using(Rules(exp_degree=degree)):
            errors.append(rel(draw(scene)[0], exact))
    assert errors[0] > 4 * errors[1] > 16 * errors[2], errors


# The same bits


# Lists


@pytest.mark.parametrize("n", [20, 5000])  # lists below and above the length from which they are sorted by digits
@pytest.mark.parametrize("distinct", [True, False])
def test_lists_hold_each_strips_gaussians_by_depth_and_then_by_index(n, distinct):
    scene = ordinary_scene(11, n=n, width=80, height=70, size=(0.01, 0.05))
    if not distinct:
        means = scene.means.clone()
        means[:, 2] = (means[:, 2] * 4).round() / 4
        scene = scene.with_(means=means, viewmats=torch.eye(4).repeat(2, 1, 1))
        scene.means[:, 2] += 3
    p = projected(scene)
    cut = blend_strips.cut_strips(2, n, 80, 70, 8)
    splats = Splats(
        p.records, scene.opacities.expand(2, n).contiguous(), scene.colors.expand(2, n, 3).contiguous(),
        scene.backgrounds,
    )  # fmt: skip
    _, _, lists = blend_strips.draw(splats, Frame(80, 70, 8), True)
    assert lists is not None
    ids = opaque_elements(lists.ids)
    boxes, depths = p.tables().boxes.view(-1, 4), p.tables().sort_depths.view(-1)
    x0, y0, x1, y1 = boxes.unbind(1)
    for s in range(cut.n_strips):
        camera, rest = divmod(s, cut.across * cut.down)
        top, left = rest // cut.across * cut.strip_height, rest % cut.across * cut.strip_width
        inside = (x0 < x1) & (y0 < y1) & (x1 > left) & (x0 < left + cut.strip_width)
        inside &= (y1 > top) & (y0 < top + cut.strip_height)
        inside &= torch.arange(2 * n) // n == camera
        members = inside.nonzero()[:, 0]
        expected = members[torch.argsort(depths[members], stable=True)]
        assert torch.equal(ids[lists.starts[s] : lists.starts[s + 1]].long(), expected)


def test_more_pairs_than_can_be_numbered_are_refused_before_lists_are_made(monkeypatch):
    scene = frontal_scene(torch.tensor([[0.0, 0, 2]]).repeat(9, 1), 9.0, 0.5).to(torch.float32)
    monkeypatch.setattr(blend_tiles, "MAX_PAIRS", 100)
    with pytest.raises(ValueError, match="at most 100 pairs of a Gaussian and a tile, got 288"):
        draw(scene, tile_size=1)


# Memory


class Guards:
    """Stands in for torch in a module: its buffers lie between guard bytes, and hold garbage at first."""

    def __init__(self):
        self.raw = []

    def __getattr__(self, name):
        return getattr(torch, name)

    def _between(self, shape, dtype, fill):
        shape = shape[0] if len(shape) == 1 and isinstance(shape[0], tuple) else shape
        size = torch.Size(shape).numel() * torch.empty(0, dtype=dtype).element_size()
        raw = torch.full((size + 512,), 0xFF, dtype=torch.uint8)  # NaN, and numbers out of every range
        raw[256 : 256 + size] = fill
        self.raw.append((raw, size))
        return raw[256 : 256 + size].view(dtype).view(shape)

    def empty(self, *shape, dtype=torch.float32):
        return self._between(shape, dtype, 0xFF)

    def zeros(self, *shape, dtype=torch.float32):
        return self._between(shape, dtype, 0)

    def opaque_buffer(self, size, dtype, device):
        return self.empty(size + 1, dtype=dtype)  # told apart by `opaque_elements`

    def opaque_elements(self, buffer):
        return buffer[:-1]

    def check(self):
        assert len(self.raw) > 8
        for raw, size in self.raw:
            assert (raw[:256] == 0xFF).all() and (raw[256 + size :] == 0xFF).all(), "written past a buffer"


MEMORY_SCENES = {
    **{f"{w}x{h}": ordinary_scene(12, n=40, width=w, height=h) for w, h in SIZES},
    "larger than the image": stiff_scene("larger than the image").with_(width=33, height=17),
    "all culled": ordinary_scene(13, n=40).with_(opacities=torch.zeros(40)),
    "none": ordinary_scene(14, n=0),
    "one": ordinary_scene(15, n=1),
    "17 of many layers": frontal_scene([[0.0, 0, 2]] * 17, 1.0, 0.9, 19, 3),
}


@pytest.mark.parametrize("name", MEMORY_SCENES)
@pytest.mark.parametrize("channels", [1, 3, 8])
@pytest.mark.parametrize("tile_size", [1, 16])
def test_nothing_is_written_past_a_buffer_nor_read_from_there(name, channels, tile_size, monkeypatch):
    scene = MEMORY_SCENES[name].to(torch.float32)
    p = projected(scene)
    n_cameras, n = p.depths.shape
    g = torch.Generator().manual_seed(0)
    colors = torch.rand(n_cameras, n, channels, generator=g)
    backgrounds = torch.rand(n_cameras, channels, generator=g)
    opacities = scene.opacities.expand(n_cameras, n).contiguous()
    g_image = torch.rand(n_cameras, scene.height, scene.width, channels, generator=g)
    g_alpha = torch.rand(n_cameras, scene.height, scene.width, 1, generator=g)
    frame, flags = Frame(scene.width, scene.height, tile_size), GradientFlags(True, True, True)

    def run(copy):
        splats = Splats(*map(copy, (p.records, opacities, colors, backgrounds)))
        *plain, nothing = blend_strips.draw(splats, frame, False)
        *drawn, saved = blend_strips.draw(splats, frame, True)
        assert nothing is None and saved is not None
        back = blend_strips.draw_backward(copy(g_image), copy(g_alpha), splats, frame, saved, flags)
        return [*plain, *drawn, *back]

    expected = run(lambda t: t)
    guards = Guards()

    def guarded(tensor):
        copy = guards.empty(*tensor.shape, dtype=tensor.dtype)
        copy.copy_(tensor)
        return copy

    with monkeypatch.context() as patch:
        patch.setattr(blend_strips, "torch", guards)
        patch.setattr(blend_strips, "opaque_buffer", guards.opaque_buffer)
        patch.setattr(blend_strips, "opaque_elements", guards.opaque_elements)
        got = run(guarded)
    guards.check()
    assert all(torch.equal(a, b) for a, b in zip(got, expected, strict=True))
    assert all(torch.isfinite(t).all() for t in got)


def test_two_pictures_before_their_gradients_keep_apart():
    a, b = ordinary_scene(16), ordinary_scene(17)
    alone = [values_and_gradients(scene)[2][0] for scene in (a, b)]
    leaves = [scene.means.clone().requires_grad_() for scene in (a, b)]
    losses = []
    for scene, means in zip((a, b), leaves, strict=True):
        g = torch.Generator().manual_seed(0)
        outs = draw(scene.with_(means=means))
        losses.append(sum((o * (torch.randint(0, 2, o.shape, generator=g).to(o) * 2 - 1)).sum() for o in outs))
    for loss, means, expected in zip(losses, leaves, alone, strict=True):
        assert torch.equal(torch.autograd.grad(loss, means)[0], expected)


@pytest.mark.slow
def test_more_pairs_than_can_be_counted_are_refused_with_their_number():
    n, size = 2**19 + 1, 64
    K, eye = intrinsics(50.0, 50.0, 32.0, 32.0).float()[None], torch.eye(4)[None]
    means = torch.zeros(n, 3)
    means[:, 2] = 2
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    projection = project(means, quats, torch.full((n, 3), 9.0), torch.full((n,), 0.5), eye, K, size, size, **OPTIONS)
    with pytest.raises(ValueError, match=f"at most {MAX_PAIRS} pairs of a Gaussian and a tile, got {n * 4096}"):
        bin_to_tiles(projection.tables().boxes, projection.tables().sort_depths, size, size, 1)


@pytest.mark.parametrize("name", ["larger than the image", "thousands of faint layers", "partly behind the camera"])
def test_lists_hold_each_tiles_gaussians_by_depth_and_then_by_index(name):
    scene = stiff_scene(name, 60)
    scene = scene.with_(means=torch.cat([scene.means, scene.means]))  # every depth is there twice
    twice = [torch.cat([t, t]) for t in scene.gaussians[1:]]
    cameras, Ks = scene.viewmats.repeat(2, 1, 1), scene.Ks.repeat(2, 1, 1)
    records = project(scene.means, *twice, cameras, Ks, scene.width, scene.height, **OPTIONS).tables()
    lists = bin_to_tiles(records.boxes, records.sort_depths, scene.width, scene.height, 7)
    gaussians, pairs = opaque_elements(lists.gaussians).long(), opaque_elements(lists.pairs)
    depths, n = records.sort_depths.view(-1), len(scene.means)
    x0, y0, x1, y1 = records.boxes.view(-1, 4).unbind(1)
    for tile in range(2 * lists.across * lists.down):
        camera, place = divmod(tile, lists.across * lists.down)
        top, left = place // lists.across * 7, place % lists.across * 7
        inside = (x0 < x1) & (y0 < y1) & (x1 > left) & (x0 < left + 7) & (y1 > top) & (y0 < top + 7)
        members = (inside & (torch.arange(2 * n) // n == camera)).nonzero()[:, 0]
        expected = members[torch.argsort(depths[members], stable=True)]
        assert torch.equal(gaussians[lists.starts[tile] : lists.starts[tile + 1]], expected)
    # A pair's number is its Gaussian's first plus its place among that Gaussian's tiles.
    place = pairs - lists.pair_starts[gaussians]
    assert place.min() >= 0 and (place < lists.pair_counts[gaussians]).all()
    assert torch.equal(pairs.sort().values, torch.arange(len(pairs)))
