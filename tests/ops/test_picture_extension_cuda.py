"""The optional C++ node of pictures on CUDA: the bits of Python's node, for all kinds of calls."""

import threading

import pytest
import torch
from test_blend_weights import ALL as EVERYTHING
from test_blend_weights import HEIGHT, WIDTH, scene

from oasis_warp.ops import rasterization
from oasis_warp.ops._runtime import picture_extension, picture_node
from oasis_warp.ops._runtime.pair_counts import watch_overflow
from oasis_warp.ops._runtime.plans import Plans


@pytest.fixture
def on_and_off(extension, monkeypatch):
    """What a function returns with the C++ node, and with Python's."""

    def both(function):
        found = []
        for off in (False, True):
            with monkeypatch.context() as patch:
                patch.setattr(picture_node, "_plans", Plans())
                if off:
                    patch.setattr(picture_extension, "loaded", lambda: None)
                found.append(function())
                tables = [plan.table for plan in picture_node._plans.plans.values()]
                assert not off or not any(tables)
                assert off or any(tables)
        return found

    return both


def equal(some, others):
    return len(some) == len(others) and all(map(torch.equal, some, others))


SHOTS = [
    *(dict(zip(("n_cameras", "channels", "shared", "wanted"), kind, strict=True)) for kind in (
        (1, 3, True, EVERYTHING), (3, 3, True, EVERYTHING), (3, 4, False, EVERYTHING), (1, 3, True, set()),
        (1, 3, True, {"colors"}), (2, 3, True, {"opacities"}), (1, 3, True, {"backgrounds"}), (1, 3, False, {"colors"}),
        (2, 3, True, {"viewmats"}), (1, 3, True, {"means", "quats"}), (1, 32, True, EVERYTHING),
        (1, 1, True, EVERYTHING),
    )),
    {"n": 40_000, "n_cameras": 2, "wanted": EVERYTHING}, {"n": 1, "wanted": EVERYTHING},
    {"wanted": EVERYTHING, "options": {"camera_model": "ortho", "tile_size": 8, "radius_clip": 1.0}},
    {"wanted": EVERYTHING, "options": {"validate": False}}, {"wanted": EVERYTHING - {"backgrounds"}, "without": True},
]  # fmt: skip


@pytest.mark.gpu
@pytest.mark.parametrize("shot", SHOTS)
def test_the_bits_are_those_of_pythons_node(shot, on_and_off):
    given = scene(shot.get("n", 700), shot.get("n_cameras", 1), shot.get("channels", 3), shot.get("shared", True))
    if shot.get("without"):
        del given["backgrounds"]

    def drawn():
        options = shot.get("options", {})
        return [gradients_of(given, shot["wanted"], retain, **options) for retain in (False, False, True, False)]

    for mine, theirs in zip(*on_and_off(drawn), strict=True):
        assert equal(mine, theirs)


def gradients_of(given, wanted, retain=False, **options):
    """Images, alpha and gradients; with `retain`, that by means2d too."""
    given = {name: t.detach().clone().requires_grad_(name in wanted) for name, t in given.items()}
    image, alphas, meta = rasterization(**given, width=WIDTH, height=HEIGHT, **options)
    out = [image.detach(), alphas.detach()]
    if not wanted:
        return out
    if retain and meta["means2d"].requires_grad:
        meta["means2d"].retain_grad()
    weights = torch.linspace(-1, 1, image.numel(), device="cuda").view_as(image)
    ((image * weights).sum() + alphas.square().sum()).backward()
    out += [given[name].grad for name in sorted(wanted)]
    return out + ([meta["means2d"].grad] if retain and meta["means2d"].requires_grad else [])


@pytest.mark.gpu
def test_covariances_and_arguments_that_are_not_contiguous_give_the_same_bits(on_and_off):
    given = scene(700, 1, 3)
    factors = torch.randn(700, 3, 3, generator=torch.Generator("cuda").manual_seed(1), device="cuda") * 0.003

    def drawn():
        found = []
        for _ in range(2):
            leaves = [t.detach().clone().requires_grad_() for t in (factors, given["means"], given["colors"])]
            covars, means, colors = leaves[0] @ leaves[0].mT, leaves[1].T.contiguous().T, leaves[2].T.contiguous().T
            others = {name: given[name] for name in ("opacities", "viewmats", "Ks")} | {"covars": covars}
            image, *_ = rasterization(means, None, None, colors=colors, width=WIDTH, height=HEIGHT, **others)
            found += [image.detach(), *torch.autograd.grad(image.square().sum(), leaves)]
        return found

    assert equal(*on_and_off(drawn))


@pytest.mark.gpu
def test_more_pairs_and_longer_lists_than_expected_give_the_same_bits(on_and_off):
    sizes = [(3000, 1e-4), (3000, 0.1), (3000, 1e-4), (3000, 0.1)]

    def drawn():
        return [t for n, size in sizes for t in gradients_of(scene(n, 1, 3, size=size), {"means", "colors"})]

    assert equal(*on_and_off(drawn))


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("name", "value"), [("means", float("nan")), ("opacities", 2.0), ("backgrounds", 1e16), ("Ks", 0.0)]
)
def test_bad_values_are_refused_by_name_on_cuda(name, value, extension, as_shipped):
    given = scene(300, 1, 3)
    given[name].view(len(given[name]), -1)[0] = value
    for wanted in (False, True):
        given["colors"].requires_grad_(wanted)
        with pytest.raises(ValueError, match=f"^{name}: "):
            rasterization(**given, width=WIDTH, height=HEIGHT)


@pytest.mark.gpu
def test_errors_of_python_reach_the_caller_from_autograds_thread(extension):
    given = scene(300, 1, 3)
    means = given["means"].requires_grad_()
    for _ in range(2):
        rasterization(**given, width=WIDTH, height=HEIGHT)[0].sum().backward()
    image, _, meta = rasterization(**given, width=WIDTH, height=HEIGHT)
    meta["means2d"].register_hook(lambda gradient: None)
    with pytest.raises(RuntimeError, match=r"expected retain_grad\(\), got a hook"):
        image.sum().backward()
    image, *_ = rasterization(**given, width=WIDTH, height=HEIGHT)
    (gradient,) = torch.autograd.grad(image.sum(), means, create_graph=True)
    with pytest.raises(RuntimeError, match="expected one derivative"):
        gradient.sum().backward()


@pytest.mark.gpu
def test_streams_and_threads_give_the_same_bits(on_and_off):
    given = scene(3000, 1, 3)

    def drawn():
        found, failures = {}, []

        def work(k):
            try:
                with torch.cuda.stream(torch.cuda.Stream()):
                    for _ in range(10):
                        found[k] = gradients_of(given, EVERYTHING)
                    torch.cuda.current_stream().synchronize()
            except Exception as error:
                failures.append(error)

        torch.cuda.synchronize()
        threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not failures, failures
        gradients_of(given, EVERYTHING)  # a plan of this thread, for `on_and_off` to look at
        return [t for k in range(4) for t in found[k]]

    assert equal(*on_and_off(drawn))


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:.torch.jit.script_method:DeprecationWarning")  # which torch.compile itself uses
def test_graphs_and_compiled_calls_go_round_the_node(extension, as_shipped):
    given = scene(300, 1, 3)
    expected = rasterization(**given, width=WIDTH, height=HEIGHT, validate=False)[0]

    def draw(means):
        return rasterization(**{**given, "means": means}, width=WIDTH, height=HEIGHT, validate=False)[0] * 1

    assert torch.equal(torch.compile(draw)(given["means"]), expected)
    with watch_overflow() as overflow:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            image = draw(given["means"])
        graph.replay()
        torch.cuda.synchronize()
    assert not overflow.happened() and torch.equal(image, expected)
