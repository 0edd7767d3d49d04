"""Times on the host's clock and by CUDA graphs, and how these compare with what a GPU can do."""

import gc
import subprocess
import sys
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from oasis_warp.bench import roofline
from oasis_warp.bench import timing as timing_module
from oasis_warp.bench.roofline import MESH_KERNELS, PICTURE_KERNELS, Ceilings, Work, assess, count, count_mesh
from oasis_warp.bench.scenes import hand_scenes
from oasis_warp.bench.timing import (
    KernelTime,
    NotCaptured,
    Probe,
    Sample,
    Timed,
    Timing,
    add_up,
    capture,
    first_cause,
    host_clock,
    kernel_times,
    short_name,
    synchronise,
    time_groups,
    time_together,
)


def test_calls_take_turns_and_each_begins_a_round():
    log = []
    calls = [Timed(lambda name=name: log.append(name), 1) for name in "ab"]
    rounds = []
    timings = time_together(calls, repeats=2, after_round=rounds.append)
    assert "".join(log) == "aabb" + "aabb" + "bbaa"  # warm-up, then each twice a round: once to warm the caches
    assert rounds == [1, 2]
    assert [len(t.times_ms) for t in timings] == [2, 2]


def test_a_time_is_that_of_the_call_in_milliseconds():
    (timing,) = time_together([Timed(lambda: time.sleep(0.002), 1)], repeats=3)
    assert timing.fastest_ms >= 2
    assert timing.first_ms >= 2
    assert timing.median_ms < 200
    assert timing.cpu_ms < 1  # sleeping is no work


def test_every_call_has_its_threads_and_surroundings_and_they_are_not_timed():
    seen, before = [], torch.get_num_threads()

    @contextmanager
    def slow_to_prepare():
        time.sleep(0.01)
        seen.append("in")
        yield
        seen.append("out")

    call = Timed(lambda: seen.append(torch.get_num_threads()), threads=2, around=slow_to_prepare)
    (timing,) = time_together([call], repeats=2)
    assert seen[:4] == ["in", 2, 2, "out"]
    assert timing.fastest_ms < 5
    assert torch.get_num_threads() == before


def test_median_and_quartiles_are_those_of_the_times():
    times = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    timing = Timing(first_ms=99.0, times_ms=times, cpu_times_ms=times)
    assert (timing.median_ms, timing.iqr_ms, timing.fastest_ms) == (4.0, 4.0, 1.0)
    assert (Sample(times).median_ms, Sample(times).iqr_ms) == (4.0, 4.0)


def test_a_single_repeat_is_refused():
    with pytest.raises(ValueError, match="repeats: expected 2 or more, got 1"):
        time_together([], repeats=1)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells")
def test_peak_memory_is_what_a_call_holds_at_once():
    # In a process of its own: what other tests left of the heap decides whether freed memory goes back at once.
    code = """
import torch
from oasis_warp.bench.timing import peak_megabytes

def run():
    first = torch.ones(10 * 2**20)  # 40 MiB: from 32 on the C library gives freed memory back at once
    second = first + 1
    del first
    return second + 1

print(peak_megabytes(run, torch.device("cpu")))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    megabytes = float(done.stdout)
    assert 79 <= megabytes <= 92


def counting_clock(ms):
    """A clock by which every call takes `ms`, and the calls that it was asked to time."""
    groups = []

    def clock(run, times):
        groups.append(times)
        for _ in range(times):
            run()
        return ms * times

    return clock, groups


def test_probes_take_turns_and_each_begins_a_round(monkeypatch):
    monkeypatch.setattr(timing_module, "warm_up", lambda probe: 1e3 * timing_module.GROUP_SECONDS)
    log = []
    time_groups([Probe(lambda name=name: log.append(name), counting_clock(1.0)[0]) for name in "ab"], groups=3)
    assert "".join(log) == "aabb" + "bbaa" + "aabb"  # each once to fill the caches, then timed


def test_a_time_is_that_of_a_step(monkeypatch):
    monkeypatch.setattr(timing_module, "WARM_SECONDS", 0.0)
    clock, groups = counting_clock(ms=2.0)
    (sample,) = time_groups([Probe(lambda: None, clock, steps=10)], groups=4)
    assert sample.times_ms == pytest.approx((0.2,) * 4)
    assert sample.calls == 5  # of two milliseconds in ten
    assert groups[-4:] == [5] * 4
    assert sum(groups[:-4]) >= timing_module.WARM_CALLS


def test_slow_calls_are_timed_in_fewer_groups(monkeypatch):
    monkeypatch.setattr(timing_module, "LONGEST_WARM", 0.0)
    clock, _ = counting_clock(ms=500.0)
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9, seconds=4.0)
    assert (len(sample.times_ms), sample.calls) == (4, 1)  # each group with a call before it
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9, seconds=0.1)
    assert len(sample.times_ms) == 2
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9)
    assert len(sample.times_ms) == 9


def test_no_garbage_is_collected_while_the_clock_runs(monkeypatch):
    monkeypatch.setattr(timing_module, "LONGEST_WARM", 0.0)
    seen = []

    def clock(run, times):
        seen.append(gc.isenabled())
        return 1.0

    time_groups([Probe(lambda: None, clock)], groups=2)
    assert seen[-2:] == [False, False]
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_single_group_is_refused():
    with pytest.raises(ValueError, match="groups: expected 2 or more, got 1. Quartiles need some."):
        time_groups([], groups=1)


def test_the_host_clock_counts_every_call():
    calls = []
    assert host_clock(lambda: calls.append(1), 7) > 0
    assert len(calls) == 7


def test_the_reason_is_the_first_error_and_not_what_followed():
    try:
        try:
            raise RuntimeError("operation not permitted when stream is capturing\nSearch for it.")
        except RuntimeError:
            raise ValueError("capture failed")  # noqa: B904  as torch does
    except ValueError as error:
        assert first_cause(error) == "operation not permitted when stream is capturing"
    assert first_cause(KeyError()) == "KeyError"


@pytest.mark.gpu
def test_a_graph_holds_as_many_steps_as_asked_for():
    total = torch.zeros(1000, device="cuda")
    captured = capture(lambda: total.add_(1), calls=10, warm_calls=1)
    before = float(total[0])
    captured.graph.replay()
    synchronise()
    assert float(total[0]) == before + 10
    (sample,) = time_groups([captured.probe()], groups=3)
    assert 0 < sample.median_ms < 0.1


@pytest.mark.gpu
def test_what_waits_for_the_device_is_not_captured_and_work_goes_on_afterwards():
    one = torch.ones(3, device="cuda")
    stream = torch.cuda.current_stream()
    with pytest.raises(NotCaptured):
        capture(lambda: one.sum().item())
    assert torch.cuda.current_stream() == stream
    assert float((one + 1).sum()) == 6
    assert torch.equal(capture(lambda: one + 1).results, one + 1)


@pytest.mark.parametrize(
    ("name", "short"),
    [
        ("blend_tiles_3_57b640a0_cuda_kernel_forward", "blend_tiles_3"),
        ("skin_57b640a0_cuda_kernel_backward", "skin (adjoint)"),
        ("void at::native::vectorized_elementwise_kernel<4, at::native::FillFunctor<float>, x>(int, x)",
         "vectorized_elementwise_kernel"),
        ("void at::native::(anonymous namespace)::CatArrayBatchedCopy<float>(float*)", "CatArrayBatchedCopy"),
        ("Memcpy DtoD (Device -> Device)", "Memcpy DtoD"),
        ("sm90_xmma_gemm_f32f32", "sm90_xmma_gemm_f32f32"),
    ],
)  # fmt: skip
def test_kernels_are_called_what_their_authors_called_them(name, short):
    assert short_name(name) == short


def event(name, us, device=torch.autograd.DeviceType.CUDA):
    return SimpleNamespace(name=name, device_type=device, time_range=SimpleNamespace(elapsed_us=lambda: us))


def test_times_are_those_of_one_call_the_longest_first():
    host = event("aten::add", 99.0, torch.autograd.DeviceType.CPU)
    found = add_up([event("a", 2.0), host, event("b<int>", 5.0), event("b<float>", 7.0), event("a", 4.0)], calls=2)
    assert found == [KernelTime("b", 1.0, 6.0), KernelTime("a", 1.0, 3.0)]


@pytest.mark.gpu
def test_the_profiler_sees_the_kernels_of_torch():
    values = torch.ones(2**20, device="cuda")
    (time,) = kernel_times(lambda: values.add_(1), calls=5)
    assert time.launches == 1
    assert 0.5 < time.us < 500


ABOUT = {"device": "a GPU", "commit": "", "versions": ""}
CEILINGS = Ceilings(gb_s=4000.0, gflop_s=50_000.0)
MODELS = {"moves": lambda n: Work(8.0 * n, 1.0 * n), "thinks": lambda n: Work(8.0 * n, 1000.0 * n)}


def test_a_kernel_is_measured_by_the_nearer_ceiling():
    times = [KernelTime("moves", 1.0, 10.0), KernelTime("thinks", 2.0, 40.0)]
    moves, thinks = assess("case", times, MODELS, 10**6, CEILINGS, ABOUT)
    assert (moves.bytes, moves.flops, moves.bound) == (8e6, 1e6, "bytes")
    assert moves.floor_us == pytest.approx(2.0)  # 8 MB at 4 TB/s
    assert moves.gb_s == pytest.approx(800.0)
    assert moves.gflop_s == pytest.approx(100.0)
    assert moves.share == pytest.approx(0.2)
    assert thinks.bound == "flops"
    assert thinks.floor_us == pytest.approx(20.0)  # 1 GFLOP at 50 TFLOP/s
    assert thinks.share == pytest.approx(0.5)
    assert thinks.launches == 2


def test_a_kernel_without_a_formula_has_its_time_alone():
    (row,) = assess("case", [KernelTime("Memset", 1.0, 3.0)], MODELS, 10**6, CEILINGS, ABOUT)
    assert (row.us, row.bytes, row.gb_s, row.floor_us, row.share, row.bound) == (3.0, None, None, None, None, "")


def test_formulas_grow_with_the_scene():
    small, large = (hand_scenes(size)[0] for size in (64, 256))
    for name, model in PICTURE_KERNELS.items():
        one, other = model(count(small)), model(count(large))
        assert one.bytes > 0, name
        assert one.flops > 0, name
        assert other.bytes >= one.bytes, name
    counts = count_mesh(hand_scenes(64)[1])
    assert all(model(counts).bytes > 0 for model in MESH_KERNELS.values())


def test_gathering_and_projecting_in_one_moves_less_than_both():
    work = count(hand_scenes(128)[0])
    gather, project, fused = (
        PICTURE_KERNELS[name](work)
        for name in ("gather_records_3", "project_gaussians_backward", "gather_project_backward")
    )
    assert fused.bytes < gather.bytes + project.bytes
    assert fused.flops == gather.flops + project.flops


def test_drawing_512_pixels_costs_what_was_estimated():
    work = count(hand_scenes(512)[0])
    assert PICTURE_KERNELS["blend_tiles_3"](work).flops == pytest.approx(0.09e9, rel=0.3)
    assert PICTURE_KERNELS["blend_tiles_backward_3"](work).flops == pytest.approx(0.25e9, rel=0.3)
    assert PICTURE_KERNELS["project_gaussians"](work).bytes == 36_881 * 156


@pytest.mark.gpu
def test_the_kernels_of_a_gpu_have_formulas_and_stay_below_the_ceilings():
    rows = roofline.measure_roofline(torch.device("cuda"))
    assert rows
    for case in dict.fromkeys(row.case for row in rows):
        kernels = [row for row in rows if row.case == case]
        known = sum(row.us for row in kernels if row.floor_us is not None)
        assert known > 0.5 * sum(row.us for row in kernels), case
    assert all(row.share < 1.5 for row in rows if row.share is not None and row.us > 2)
    assert rows[0].ceiling_gb_s > 100
