"""CUDA graphs of calls and the times of their kernels, and how these compare with what a GPU can do."""

from types import SimpleNamespace

import pytest
import torch

from oasis_warp.bench import roofline
from oasis_warp.bench.counts import count, count_mesh
from oasis_warp.bench.cuda import KernelTime, NotCaptured, add_up, capture, first_cause, kernel_times, short_name
from oasis_warp.bench.roofline import MESH_KERNELS, PICTURE_KERNELS, Ceilings, Work, assess
from oasis_warp.bench.scenes import hand_scenes
from oasis_warp.bench.timing import synchronise, time_groups


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
