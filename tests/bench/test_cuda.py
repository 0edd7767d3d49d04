"""CUDA graphs of calls, and the times of their kernels."""

from types import SimpleNamespace

import pytest
import torch

from oasis_warp.bench.cuda import KernelTime, NotCaptured, add_up, capture, first_cause, kernel_times, short_name
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
