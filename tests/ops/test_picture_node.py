"""`rasterization` by one node of autograd: what the operators draw apart, to the bit."""

import gc
import weakref
from copy import deepcopy

import pytest
import torch

from oasis_kernels.constants import Rules
from oasis_kernels.rasterize import projection_native, tiles_cuda
from oasis_warp.ops import rasterization
from oasis_warp.ops._runtime import picture_node
from oasis_warp.ops._runtime.picture_call import ORDERS

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
