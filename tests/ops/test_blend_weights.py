"""Blend weights against the rasterizer and its reference, and `rasterization` by one node of autograd."""

import gc
import weakref
from copy import deepcopy

import pytest
import torch
from rasterization_scenes import ordinary_scene
from test_strips import Guards

from oasis_kernels.constants import Rules
from oasis_kernels.rasterize import projection_native, tiles_cuda
from oasis_warp.core.types import Camera
from oasis_warp.ops import blend_colors, blend_weights, rasterization, stack_weights
from oasis_warp.ops._runtime import blend_strips, picture_node, weigh
from oasis_warp.ops._runtime.picture_call import ORDERS
from oasis_warp.reference import rasterization as reference


def weights_and_image(device, dtype, **options):
    scene = ordinary_scene(seed=5, device=device, dtype=dtype)
    weights = blend_weights(*scene.gaussians, scene.viewmats[0], scene.Ks[0], scene.width, scene.height, **options)
    image, alphas, _ = rasterization(
        *scene.gaussians, scene.colors, scene.viewmats[:1], scene.Ks[:1], scene.width, scene.height
    )
    return scene, weights, image[0], alphas[0]


def test_weights_times_colors_is_the_rasterized_image(device, dtype):
    scene, weights, image, alphas = weights_and_image(device, dtype)
    rounding = 10 * torch.finfo(dtype).eps  # another order of the same sums
    assert torch.allclose(blend_colors(weights, scene.colors), image, rtol=0, atol=rounding)
    assert torch.allclose(weights.alphas, alphas, rtol=0, atol=rounding)


def test_weights_equal_those_of_the_dense_reference(device):
    scene, weights, *_ = weights_and_image(device, torch.float64)
    camera = Camera(scene.viewmats[0].cpu(), scene.Ks[0].cpu(), scene.width, scene.height)
    splats = reference.project(reference.Gaussians(*(g.cpu() for g in scene.gaussians)), camera)
    expected = torch.zeros(scene.width * scene.height, len(scene.means), dtype=torch.float64)
    expected[:, splats.index] = reference.blend(reference.dense_layers(splats, camera))[0]
    assert torch.allclose(weights.matrix.to_dense().cpu(), expected, rtol=0, atol=1e-12)


def test_the_transpose_is_the_matrix_transposed(device):
    _, weights, *_ = weights_and_image(device, torch.float32)
    assert torch.equal(weights.matrix.to_dense().T, weights.transpose.to_dense())


def test_indices_are_sorted_so_that_torch_accepts_the_matrices(device):
    _, weights, *_ = weights_and_image(device, torch.float32)
    for m in (weights.matrix, weights.transpose):
        torch.sparse_csr_tensor(m.crow_indices(), m.col_indices(), m.values(), m.shape, check_invariants=True)


def test_gradient_by_the_colors_is_that_of_the_rasterizer(device):
    scene, weights, *_ = weights_and_image(device, torch.float64)
    colors = scene.colors.clone().requires_grad_()
    g = torch.randn(scene.height, scene.width, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    g = g.to(device)
    (mine,) = torch.autograd.grad(blend_colors(weights, colors), colors, g)
    image, *_ = rasterization(*scene.gaussians, colors, scene.viewmats[:1], scene.Ks[:1], scene.width, scene.height)
    (theirs,) = torch.autograd.grad(image, colors, g[None])
    assert torch.allclose(mine, theirs, rtol=0, atol=1e-12)


def test_tile_size_changes_no_bit(device):
    _, a, *_ = weights_and_image(device, torch.float32, tile_size=5)
    _, b, *_ = weights_and_image(device, torch.float32, tile_size=32)
    # On CUDA lanes of one and of several pixels are unrolled apart, and their multiply-adds fused apart.
    atol = 0 if device.type == "cpu" else 1e-6
    torch.testing.assert_close(a.matrix.to_dense(), b.matrix.to_dense(), rtol=0, atol=atol)


def test_no_gaussians_give_an_empty_matrix(device):
    def empty(*s):
        return torch.zeros(*s, device=device)

    K = torch.tensor([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]], device=device)
    weights = blend_weights(empty(0, 3), empty(0, 4), empty(0, 3), empty(0), torch.eye(4, device=device), K, 8, 6)
    assert weights.matrix.shape == (48, 0) and weights.transpose.shape == (0, 48)
    assert torch.equal(blend_colors(weights, empty(0, 3)), empty(6, 8, 3))


def test_colors_of_another_count_are_refused(device, as_shipped):
    scene, weights, *_ = weights_and_image(device, torch.float32)
    with pytest.raises(ValueError, match=r"colors: expected shape \[60, D\], got \[59, 3\]"):
        blend_colors(weights, scene.colors[:-1])


def test_a_batch_of_cameras_is_refused(device, as_shipped):
    scene, *_ = weights_and_image(device, torch.float32)
    with pytest.raises(ValueError, match=r"viewmat: expected shape \[4, 4\]"):
        blend_weights(*scene.gaussians, scene.viewmats, scene.Ks[0], 8, 8)


def test_threads_and_strips_change_no_bit_of_float32_weights(with_threads):
    scene = ordinary_scene(seed=6, n=5000, width=90, height=140, size=(0.01, 0.05))

    def weights(tile_size=16):
        w = blend_weights(*scene.gaussians, scene.viewmats[0], scene.Ks[0], 90, 140, tile_size=tile_size)
        matrices = w.matrix, w.transpose
        return [w.alphas, *(part for m in matrices for part in (m.crow_indices(), m.col_indices(), m.values()))]

    alone = with_threads(1, weights)
    for other in (with_threads(3, weights), with_threads(2, weights, 1)):
        assert all(torch.equal(a, b) for a, b in zip(alone, other, strict=True))


@pytest.mark.parametrize("size", [(1, 1), (257, 2), (65, 63)])
@pytest.mark.parametrize("name", ["ordinary", "all culled", "larger than the image"])
def test_nothing_is_written_past_a_buffer_of_float32_weights(name, size, monkeypatch):
    scene = ordinary_scene(seed=7, n=40, width=size[0], height=size[1])
    if name == "all culled":
        scene = scene.with_(opacities=torch.zeros(40))
    if name == "larger than the image":
        scene = scene.with_(scales=40 * scene.scales)
    expected = blend_weights(*scene.gaussians, scene.viewmats[0], scene.Ks[0], *size)
    guards = Guards()
    with monkeypatch.context() as patch:
        for module in (blend_strips, weigh):
            patch.setattr(module, "torch", guards)
            patch.setattr(module, "opaque_elements", guards.opaque_elements)
        patch.setattr(blend_strips, "opaque_buffer", guards.opaque_buffer)
        got = blend_weights(*scene.gaussians, scene.viewmats[0], scene.Ks[0], *size)
    guards.check()
    assert torch.equal(got.alphas, expected.alphas)
    assert torch.equal(got.matrix.to_dense(), expected.matrix.to_dense())
    assert torch.equal(got.transpose.to_dense(), expected.transpose.to_dense())


@pytest.fixture
def views(device):
    """Three pictures of the same 60 Gaussians, 24 pixels wide."""
    random = torch.Generator().manual_seed(3)
    means = torch.randn(60, 3, generator=random) * 0.1 + torch.tensor([0.0, 0.0, 1.0])
    quats = torch.nn.functional.normalize(torch.randn(60, 4, generator=random), dim=-1)
    scales, opacities = torch.rand(60, 3, generator=random) * 0.02 + 0.005, torch.rand(60, generator=random)
    pictures = []
    for k in range(3):
        K = torch.tensor([[30.0 + 5 * k, 0.0, 12.0], [0.0, 30.0 + 5 * k, 8.0], [0.0, 0.0, 1.0]])
        parts = (means + 0.02 * k, quats, scales, opacities, torch.eye(4), K)
        pictures.append(blend_weights(*(part.to(device) for part in parts), 24, 16))
    return pictures


def test_stacked_pictures_are_the_pictures_below_each_other(views, device):
    random = torch.Generator().manual_seed(1)
    colors = [torch.rand(60, 3, generator=random).to(device) for _ in views]
    stacked = stack_weights(views)
    apart = torch.cat([blend_colors(view, own) for view, own in zip(views, colors, strict=True)])
    off = 0.0 if device.type == "cpu" else 1e-6  # a GPU adds in orders of its own
    torch.testing.assert_close(blend_colors(stacked, torch.cat(colors)), apart, atol=off, rtol=0)
    assert torch.equal(stacked.alphas, torch.cat([view.alphas for view in views]))


def test_gradients_of_stacked_pictures_are_theirs(views, device):
    random = torch.Generator().manual_seed(2)
    colors = torch.rand(3, 60, 3, generator=random).to(device).requires_grad_(True)
    wanted = torch.randn(48, 24, 3, generator=random).to(device)
    (together,) = torch.autograd.grad((blend_colors(stack_weights(views), colors.flatten(0, 1)) * wanted).sum(), colors)
    apart = []
    for view, own, part in zip(views, colors, wanted.split(16), strict=True):
        apart += torch.autograd.grad((blend_colors(view, own) * part).sum(), own)
    torch.testing.assert_close(together, torch.stack(apart))
    dense = stack_weights(views).matrix.to_dense()
    assert torch.equal(stack_weights(views).transpose.to_dense(), dense.T)


def one_gaussian(device, width, height):
    parts = [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0, 0.0]], [[0.01] * 3], [1.0]
    gaussian = [torch.tensor(part, device=device) for part in parts]
    K = torch.diag(torch.tensor([30.0, 30.0, 1.0], device=device))
    return blend_weights(*gaussian, torch.eye(4, device=device), K, width, height)


def test_pictures_of_different_gaussians_stack(views, device):
    stacked = stack_weights([one_gaussian(device, 24, 8), views[0]])
    assert stacked.matrix.shape == (24 * (8 + 16), 61)


def test_one_picture_is_stacked_as_it_is(views):
    assert stack_weights(views[:1]) is views[0]


def test_pictures_that_do_not_stack_are_refused(views, device):
    with pytest.raises(ValueError, match="expected pictures 24 pixels wide, got 32"):
        stack_weights([views[0], one_gaussian(device, 32, 16)])
    with pytest.raises(ValueError, match="at least one"):
        stack_weights([])


WIDTH, HEIGHT = 61, 43


def test_parameters_are_given_in_the_order_of_the_kernels():
    """A parameter that is added to a kernel would shift all that follow."""
    kernels = {
        "project_gaussians": projection_native.cuda_project,
        "project_gaussians_backward": projection_native.cuda_project_backward,
        "count_pairs": tiles_cuda.count_pairs(), "place_tiles": tiles_cuda.place_tiles(),
        "fill_tiles": tiles_cuda.fill_tiles(), "sort_long_lists": tiles_cuda.sort_long_lists(),
        "blend": tiles_cuda.blend(3, 4, Rules()), "gather": tiles_cuda.gather(3, True, True),
        "blend_backward": tiles_cuda.blend_backward(3, 4, True, True, Rules()),
    }  # fmt: skip
    assert {name: " ".join(kernel.parameters) for name, kernel in kernels.items()} == ORDERS


def scene(n, n_cameras, channels, shared=True, seed=0, size=0.004):
    """Gaussians, cameras and backgrounds as keyword arguments."""
    random = torch.Generator("cuda").manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=random, device="cuda")

    viewmats = torch.eye(4, device="cuda").repeat(n_cameras, 1, 1)
    viewmats[:, 2, 3] = 0.5
    viewmats[:, 0, 3] = torch.linspace(-0.02, 0.02, n_cameras)
    K = torch.tensor([[130.0, 0, WIDTH / 2], [0, 125, HEIGHT / 2], [0, 0, 1]], device="cuda")
    return {
        "means": (uniform(n, 3) - 0.5) * 0.2, "quats": uniform(n, 4) + 0.1, "scales": uniform(n, 3) * size + 5e-4,
        "opacities": uniform(n) * 0.9 + 0.05, "colors": uniform(*(() if shared else (n_cameras,)), n, channels),
        "viewmats": viewmats, "Ks": K.repeat(n_cameras, 1, 1), "backgrounds": uniform(n_cameras, channels),
    }  # fmt: skip


def results(given, wanted, **options):
    """Images, alpha, what meta holds, and the gradients of the `wanted` tensors."""
    given = {name: t.detach().clone().requires_grad_(name in wanted) for name, t in given.items()}
    image, alphas, meta = rasterization(**given, width=WIDTH, height=HEIGHT, **options)
    read = [meta[name].detach() for name in ("means2d", "depths", "conics", "radii", "opacities")]
    out = [image.detach(), alphas.detach(), *read]
    if wanted:
        places = meta["means2d"].requires_grad
        if places:
            meta["means2d"].retain_grad()
        weights = torch.linspace(-1, 1, image.numel(), device="cuda").view_as(image)
        ((image * weights).sum() + alphas.square().sum()).backward()
        out += [given[name].grad for name in sorted(wanted) if given[name].grad is not None]
        out += [meta["means2d"].grad] if places else []
    return out


ALL = {"means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"}
MODES = "RGB", "D", "ED", "RGB+D", "RGB+ED"


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("n", "n_cameras", "channels", "shared", "wanted", "options"),
    [
        *((700, c, d, shared, ALL, {"render_mode": mode}) for mode in MODES for c, d, shared in
          ((1, 3, True), (3, 3, True), (3, 5, False))),
        (700, 1, 3, True, set(), {}), (700, 1, 3, True, {"colors"}, {}), (700, 2, 3, True, {"opacities"}, {}),
        (700, 2, 3, True, {"viewmats"}, {"camera_model": "ortho"}), (700, 1, 3, True, {"backgrounds"}, {}),
        (1, 1, 3, True, ALL, {}), (40_000, 2, 3, True, ALL, {}),  # lists that are too long to be sorted in one go
        (700, 1, 32, True, ALL, {"render_mode": "RGB+ED", "validate": False}),
    ],
)  # fmt: skip
def test_one_node_gives_the_bits_of_the_operators(n, n_cameras, channels, shared, wanted, options, monkeypatch):
    given = scene(n, n_cameras, channels, shared)
    together = results(given, wanted, **options)
    again = results(given, wanted, **options)
    monkeypatch.setattr(picture_node, "plan_for", lambda *_: None)
    apart = results(given, wanted, **options)
    assert len(together) == len(apart)
    assert all(map(torch.equal, together, apart)) and all(map(torch.equal, together, again))


@pytest.mark.gpu
def test_more_pairs_than_the_last_call_had_are_drawn_all(monkeypatch):
    few, many = scene(3000, 1, 3, size=1e-4), scene(3000, 1, 3, size=0.1)
    drawn = [results(given, {"means"}) for given in (few, many, few, many)]
    monkeypatch.setattr(picture_node, "plan_for", lambda *_: None)
    apart = [results(given, {"means"}) for given in (few, many)] * 2
    assert all(all(map(torch.equal, a, b)) for a, b in zip(drawn, apart, strict=True))


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("name", "value"),
    [("means", float("nan")), ("quats", 0.0), ("opacities", 2.0), ("colors", float("inf")), ("backgrounds", 1e16),
     ("viewmats", float("nan")), ("Ks", 0.0)],
)  # fmt: skip
def test_bad_values_are_refused_by_name(name, value, as_shipped):
    given = scene(300, 1, 3)
    rasterization(**given, width=WIDTH, height=HEIGHT)
    given[name].view(len(given[name]), -1)[0] = value
    with pytest.raises(ValueError, match=f"^{name}: "):
        rasterization(**given, width=WIDTH, height=HEIGHT)


@pytest.mark.gpu
def test_what_meta_holds_has_gradients_of_its_own(monkeypatch):
    def gradients():
        given = scene(300, 2, 3)
        leaves = [given[name].requires_grad_() for name in ("means", "viewmats", "opacities")]
        meta = rasterization(**given, width=WIDTH, height=HEIGHT)[2]
        loss = meta["means2d"].square().sum() + meta["depths"].sum() + meta["opacities"].square().sum()
        return torch.autograd.grad(loss, leaves)

    together = gradients()
    monkeypatch.setattr(picture_node, "plan_for", lambda *_: None)
    for mine, theirs in zip(together, gradients(), strict=True):
        torch.testing.assert_close(mine, theirs)


@pytest.mark.gpu
def test_what_one_node_cannot_give_is_refused():
    given = scene(300, 1, 3)
    means = given["means"].requires_grad_()
    image, _, meta = rasterization(**given, width=WIDTH, height=HEIGHT)
    (gradient,) = torch.autograd.grad(image.sum(), means, create_graph=True)
    with pytest.raises(RuntimeError, match="expected one derivative"):
        gradient.sum().backward()
    image, _, meta = rasterization(**given, width=WIDTH, height=HEIGHT)
    meta["means2d"].register_hook(lambda gradient: None)
    with pytest.raises(RuntimeError, match=r"expected retain_grad\(\), got a hook"):
        image.sum().backward()
    image, _, meta = rasterization(**given, width=WIDTH, height=HEIGHT)
    with torch.no_grad():
        means += 1
    with pytest.raises(RuntimeError, match="changed in place before the first look"):
        meta["means2d"].sum().backward()


@pytest.mark.gpu
def test_a_picture_is_freed_without_garbage_collection():
    """A cycle of references would keep the memory of every step until Python looks for garbage."""
    given = scene(300, 1, 3)
    given["means"].requires_grad_()
    gc.disable()
    try:
        image, alphas, meta = rasterization(**given, width=WIDTH, height=HEIGHT)
        gone = weakref.ref(meta["means2d"]), weakref.ref(meta), weakref.ref(image)
        image.sum().backward()
        del image, alphas, meta
        assert [ref() for ref in gone] == [None] * 3
    finally:
        gc.enable()


@pytest.mark.gpu
def test_meta_is_a_dictionary_of_tensors_to_whoever_reads_it():
    def read(reader):
        return reader(rasterization(**scene(300, 1, 3), width=WIDTH, height=HEIGHT)[2])

    want = read(lambda meta: {name: meta[name] for name in meta})
    assert isinstance(want["means2d"], torch.Tensor) and want["radii"].shape == (1, 300, 2)
    for reader in (dict, deepcopy, lambda meta: dict(**meta), lambda meta: dict(meta.items()), lambda meta: meta | {},
                   lambda meta: {name: meta.get(name) for name in meta}, lambda meta: meta.copy()):  # fmt: skip
        got = read(reader)
        assert list(got) == list(want)
        assert all(torch.equal(got[k], v) if isinstance(v, torch.Tensor) else got[k] == v for k, v in want.items())
