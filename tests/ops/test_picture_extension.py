"""The optional C++ node of pictures on the CPU: kernels are not run, but what they are given is looked at."""

import ctypes
import gc
import threading
import weakref
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp
from rasterization_scenes import ordinary_scene
from torch.utils import cpp_extension

from oasis_warp.cli import doctor
from oasis_warp.ops._runtime import picture_extension, picture_node, picture_plan, picture_preparation
from oasis_warp.ops._runtime.launch import start
from oasis_warp.ops._runtime.picture_call import Options, Scene
from oasis_warp.ops._runtime.picture_plan import Plan
from oasis_warp.ops._runtime.plans import CudaLaunch, Plans

STREAM = 7


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache without the node."""
    monkeypatch.setenv("OASIS_WARP_CACHE", str(tmp_path))
    monkeypatch.delenv(picture_extension.VARIABLE, raising=False)
    picture_extension._load.cache_clear()
    yield tmp_path
    picture_extension._load.cache_clear()


def test_nothing_is_built_unasked(cache):
    assert picture_extension.loaded() is None
    assert not picture_extension.is_built() and not list(cache.iterdir())


def test_processes_that_start_meanwhile_take_no_build_for_old_kernels(cache, monkeypatch):
    """Warp warned of `wp_...` folders of an earlier version, which in tests with warnings as errors failed them all."""
    seen = []

    def load(*args, build_directory, **options):
        seen.extend(path.name for path in cache.iterdir())
        raise RuntimeError("stopped")

    monkeypatch.setattr(cpp_extension, "load", load)
    with pytest.raises(picture_extension.NotBuiltError, match="stopped"):
        picture_extension.build()
    assert len(seen) == 1 and not seen[0].startswith("wp_")


def test_without_a_compiler_a_sentence_says_so_and_python_goes_on(cache, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setenv(picture_extension.VARIABLE, "1")
    with pytest.warns(RuntimeWarning, match=r"^The C\+\+ node for rasterization cannot be used \(.*no-such-compiler"):
        assert picture_extension.loaded() is None
    assert not list(cache.iterdir())


def test_a_value_of_the_variable_that_means_nothing_is_refused(cache, monkeypatch):
    monkeypatch.setenv(picture_extension.VARIABLE, "yes")
    with pytest.raises(ValueError, match="OASIS_WARP_EXTENSION: expected 0, 1 or nothing, got 'yes'"):
        picture_extension.loaded()


def test_the_doctor_says_whether_it_is_there_and_why_it_cannot_be(cache, monkeypatch):
    assert doctor.check_extension(build=False).startswith("not built (optional)")
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(doctor.FaultError, match="could not be built: .*no-such-compiler"):
        doctor.check_extension(build=True)


def test_another_source_torch_or_python_has_another_folder(cache, monkeypatch):
    here = picture_extension.extension_folder()
    monkeypatch.setattr(torch, "__version__", "2.6.0")
    assert picture_extension.extension_folder() != here
    monkeypatch.setattr(picture_extension, "SOURCES", picture_extension.SOURCES[:1])
    assert picture_extension.extension_folder().parent == here.parent == cache


class Bounds(ctypes.Structure):
    _fields_ = (("threads", ctypes.c_longlong * 5), ("size", ctypes.c_size_t))


class Launcher:
    """Stands in for Warp's launcher: writes down what kernels are given, and reports what it is told to."""

    def __init__(self):
        self.calls, self.kernels, self.launches = [], [], {}
        self.pairs, self.longest, self.bad, self.failing = 10, 5, 0, ""
        kind = ctypes.CFUNCTYPE(
            ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 5,
            ctypes.POINTER(ctypes.c_void_p), ctypes.c_void_p, ctypes.c_void_p,
        )  # fmt: skip
        self.function = kind(self.launch)
        words = (ctypes.c_longlong * 3)()
        self.counters = SimpleNamespace(address=ctypes.addressof(words), values=words, wait=lambda device: None)

    def recorded(self, native, device):
        """`cuda_launch`, without Warp and CUDA."""
        key = native.kernel, threading.get_ident()
        if key not in self.launches:
            self.kernels.append(native)
            launch = SimpleNamespace(
                bounds=Bounds((native.block,), native.block), device=SimpleNamespace(context=1), kernel=native.kernel,
                hooks=SimpleNamespace(forward=len(self.kernels), forward_smem_bytes=64), max_blocks=0, grid_stride=True,
                block_dim=native.block, cluster_dim=1, params_addr=(ctypes.c_void_p * 2)(),
            )  # fmt: skip
            launch.set_dim = lambda size: setattr(launch, "bounds", Bounds((size,), size))
            launch.params_addr[0] = ctypes.addressof(launch.bounds)
            self.launches[key] = CudaLaunch(launch, native)
        return self.launches[key]

    def launch(self, context, kernel, size, blocks, block, stride, cluster, memory, arguments, stream, recording):
        native = self.kernels[kernel - 1]
        name = native.kernel.key
        words = (ctypes.c_longlong * len(native.parameters)).from_address(arguments[1])
        given = dict(zip(native.parameters, words, strict=True))
        threads = Bounds.from_address(arguments[0]).threads[0]
        self.calls.append((name, (context, size, threads, blocks, block, stride, cluster, memory, stream), given))
        if name == self.failing:
            return 1
        if name == "project_gaussians" and given["bad"]:
            ctypes.c_longlong.from_address(given["bad"]).value = self.bad
        if name == "place_tiles":
            (ctypes.c_longlong * 2).from_address(given["report"])[:] = self.pairs, self.longest
        return 0


@pytest.fixture
def launcher(monkeypatch):
    """Plans of CPU tensors whose kernels are not run."""
    start()
    launcher = Launcher()
    monkeypatch.setattr(wp._src.context.runtime.core, "wp_cuda_launch_kernel", launcher.function)
    monkeypatch.setattr(picture_preparation, "cuda_launch", launcher.recorded)
    monkeypatch.setattr(picture_preparation, "current_stream", lambda device: SimpleNamespace(device=device))
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr(Plan, "stream", lambda plan: STREAM)
    monkeypatch.setattr(picture_plan, "_polled", SimpleNamespace(counters=launcher.counters))
    monkeypatch.setattr(picture_plan, "fill_viewmats", lambda *_: None)
    monkeypatch.setattr(picture_plan, "remember", lambda *_: None)
    return launcher


def options_of(width=37, height=29, ortho=False):
    return Options(width, height, 0.01, 1e10, 0.0, 0.3, 16, "RGB", ortho)


def scene_of(cameras=1, shared=True, covars=False, backgrounds=True, channels=3, wanted=()):
    scene = ordinary_scene(0, n=60, cameras=cameras, channels=channels)
    colors = scene.colors if shared else scene.colors.expand(cameras, -1, -1).contiguous()
    shapes = (None, None, torch.eye(3).repeat(60, 1, 1)) if covars else (scene.quats, scene.scales, None)
    behind = scene.backgrounds if backgrounds else None
    tensors = Scene(scene.means, *shapes, scene.opacities, colors, scene.viewmats, scene.Ks, behind)
    for name in wanted:
        getattr(tensors, name).requires_grad_()
    return tensors


def draw(scene, validate=True, **options) -> Any:
    plan: Any = picture_node.plan_for(scene, options_of(**options))
    drawn = picture_node.draw(plan, scene, validate)
    return None if drawn is None else (*drawn[:2], drawn[2], plan)


ALLOCATED = (
    "image", "alphas", "keys", "tile_gaussians", "spare", "g_image", "g_alpha", "g_opacities", "g_colors", "g_means",
    "g_quats", "g_scales", "g_covars", "g_cameras", "tile_backgrounds",
)  # fmt: skip
"""Parameters whose memory each call allocates anew."""
PASSED = "g_covars2d", "g_means2d", "pair_records"
"""Parts of one allocation."""


def with_names(calls, plan):
    """`calls` without what differs between runs: memory that was allocated is told by name, and by when it came."""
    seen = defaultdict(dict)
    (first,) = (given["means2d"] for name, _, given in calls if name == "project_gaussians")
    workspace = first - plan._at["means2d"]
    kept = any(given.get("transmittance") for _, _, given in calls)
    end = workspace + (plan._size_with_kept if kept else plan._size)

    def named(name, word, given):
        if workspace <= word < end:
            return "workspace", word - workspace
        if word and name in PASSED:
            return "passed", word - (given["g_covars2d"] if given.get("g_covars2d") else given["pair_records"])
        return (name, seen[name].setdefault(word, len(seen[name]))) if word and name in ALLOCATED else word

    return [(name, how, {p: named(p, word, given) for p, word in given.items()}) for name, how, given in calls]


ALL = "means", "quats", "scales", "opacities", "colors", "backgrounds"
KINDS = [
    ({}, ALL), ({}, ("means",)), ({}, ("colors",)), ({}, ("opacities",)), ({}, ("backgrounds",)), ({}, ()),
    ({"backgrounds": False}, ("quats", "colors")), ({"cameras": 3}, ALL), ({"cameras": 3, "shared": False}, ALL),
    ({"shared": False}, ALL), ({"covars": True}, ("covars", "means")), ({"channels": 8}, ALL),
    ({}, ("viewmats", "means")),
]  # fmt: skip


@pytest.fixture
def by_python(monkeypatch):
    """Counts of pictures and adjoints that Python's node made, by name."""
    counts = defaultdict(int)

    def counted(name):
        method = getattr(Plan, name)

        def count(*arguments, **named):
            counts[name] += 1
            return method(*arguments, **named)

        monkeypatch.setattr(Plan, name, count)

    counted("draw")
    counted("draw_backward")
    return counts


def trace(launcher, scene, wanted, **options):
    """What kernels are given, forward and backward, and what comes back: shapes, and whether kernels wrote there."""
    launcher.calls.clear()
    image, alphas, _, plan = draw(scene, **options)
    leaves = [getattr(scene, name) for name in wanted]
    outputs = (image,) if wanted == ("colors",) else (image, alphas)
    incoming = [torch.ones(()).expand_as(output) for output in outputs]
    grads = torch.autograd.grad(outputs, leaves, incoming) if wanted else ()
    written = {parameter: word for _, _, given in launcher.calls for parameter, word in given.items()}
    names = "image", "alphas", *(f"g_{name}" for name in wanted)
    tensors = zip(names, (image, alphas, *grads), strict=True)
    results = [(t.shape, t.dtype, t.data_ptr() == written.get(name)) for name, t in tensors]
    return with_names(launcher.calls, plan), results


@pytest.mark.slow
@pytest.mark.parametrize("longest", [5, 3000, 100_000])  # sorted by blending, by a kernel, and with spare memory
@pytest.mark.parametrize(("kind", "wanted"), KINDS)
def test_kernels_are_given_what_pythons_node_gives_them(
    kind, wanted, longest, extension, launcher, by_python, monkeypatch
):
    launcher.longest = longest
    scene = scene_of(**kind, wanted=wanted)
    draw(scene)  # learns how long lists are
    trace(launcher, scene, wanted)  # leaves its adjoint to Python
    by_python.clear()
    calls, results = trace(launcher, scene, wanted)
    assert dict(by_python) == ({"draw_backward": 1} if "viewmats" in wanted else {})
    monkeypatch.setattr(picture_extension, "loaded", lambda: None)
    monkeypatch.setattr(picture_node, "_plans", Plans())
    draw(scene)
    expected_calls, expected = trace(launcher, scene, wanted)
    assert by_python["draw"] > 1
    assert [name for name, *_ in calls] == [name for name, *_ in expected_calls]
    for mine, theirs in zip(calls, expected_calls, strict=True):
        assert mine == theirs
    assert results == expected


@pytest.mark.slow
@pytest.mark.parametrize("kind", [{"render_mode": "RGB+D"}, {"channels": 5}])
def test_depths_and_padded_channels_are_left_to_python(kind, extension, launcher):
    options = options_of()._replace(render_mode=kind.get("render_mode", "RGB"))
    plan: Any = picture_node.plan_for(scene_of(channels=kind.get("channels", 3)), options)
    assert plan.table is None


@pytest.mark.slow
def test_more_pairs_than_expected_are_drawn_once_more_by_python_and_then_fit(extension, launcher, by_python):
    scene = scene_of(wanted=("means",))
    launcher.pairs = 4000
    draw(scene)
    assert by_python["draw"] == 1
    *_, plan = draw(scene)
    assert by_python["draw"] == 1 and plan.expected.pairs >= 4000
    assert launcher.calls[-1][2]["keys"] and launcher.calls[-2][2]["capacity"] == plan.expected.pairs


@pytest.mark.slow
def test_bad_values_are_told(extension, launcher, by_python):
    launcher.bad = 1
    assert draw(scene_of(wanted=("means",))) is None and draw(scene_of()) is None
    assert draw(scene_of(), validate=False) is not None and not by_python


@pytest.mark.slow
def test_a_kernel_that_is_not_launched_is_named(extension, launcher):
    launcher.failing = "fill_tiles"
    with pytest.raises(RuntimeError, match="^fill_tiles: "):
        draw(scene_of())
    launcher.failing = "blend_tiles_backward_3"
    scene = scene_of(wanted=("means",))
    image, *_ = draw(scene)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="^blend_tiles_backward_3: "):
            image.sum().backward(retain_graph=True)


@pytest.mark.slow
def test_tensors_of_another_kind_than_planned_are_refused(extension, launcher):
    scene = scene_of()
    plan: Any = picture_node.plan_for(scene, options_of())
    for other in (scene._replace(means=scene.means[:-1]), scene._replace(means=scene.means.double()),
                  scene._replace(backgrounds=None)):  # fmt: skip
        with pytest.raises(RuntimeError, match=r"^(means|backgrounds): expected (180|3) float32 numbers, as planned"):
            plan.table.draw(plan, STREAM, 10, 10, True, False, other)


def drawn_before(wanted=("means",)) -> Any:
    """A picture of a kind whose adjoint the C++ node knows, its meta and leaves."""
    scene = scene_of(wanted=wanted)
    draw(scene)[0].sum().backward()
    image, _, meta, _ = draw(scene)
    return image, meta, scene


@pytest.mark.slow
def test_what_is_rare_is_refused_or_given_as_by_python(extension, launcher):
    image, _, scene = drawn_before()
    (gradient,) = torch.autograd.grad(image.sum(), scene.means, create_graph=True)
    with pytest.raises(RuntimeError, match="expected one derivative"):
        gradient.sum().backward()
    image, meta, scene = drawn_before()
    meta["means2d"].register_hook(lambda gradient: None)
    with pytest.raises(RuntimeError, match=r"expected retain_grad\(\), got a hook"):
        image.sum().backward()
    image, meta, scene = drawn_before()
    meta["means2d"].retain_grad()
    image.sum().backward()
    assert meta["means2d"].grad.shape == (1, 60, 2)
    image, _, scene = drawn_before()
    with torch.no_grad():
        scene.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()
    image, _, scene = drawn_before()
    image.sum().backward()
    with pytest.raises(RuntimeError, match="second time"):
        image.sum().backward()


@pytest.mark.slow
def test_gradients_that_nobody_asks_for_are_none(extension, launcher, by_python):
    scene = scene_of(wanted=ALL)
    for names in (("colors",), ("means", "backgrounds"), ("quats",)):
        for _ in range(2):
            image, *_ = draw(scene)
            launcher.calls.clear()
            torch.autograd.grad(image.sum(), [getattr(scene, name) for name in names])
        given = {name: word for _, _, call in launcher.calls for name, word in call.items()}
        asked = {name for name in ("means", "quats", "scales", "colors") if given.get(f"g_{name}")}
        assert asked == set(names) - {"backgrounds"} and bool(given["tile_backgrounds"]) == ("backgrounds" in names)
    assert by_python["draw"] == 0


@pytest.mark.slow
def test_a_picture_and_its_plan_are_freed_without_garbage_collection(extension, launcher):
    gc.disable()
    try:
        image, meta, _ = drawn_before()
        gone = [weakref.ref(image), weakref.ref(meta), weakref.ref(meta["means2d"]), weakref.ref(meta._call[0])]
        image.sum().backward()
        picture_node._plans.plans.clear()
        del image, meta
        assert [ref() for ref in gone] == [None] * 4
    finally:
        gc.enable()


@pytest.mark.slow
def test_threads_draw_and_differentiate_at_once(extension, launcher):
    failures = []

    def work():
        try:
            for _ in range(20):
                image, _, scene = drawn_before(ALL)
                image.sum().backward()
                assert scene.quats.grad.shape == (60, 4)
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
