from types import SimpleNamespace

import pytest
import torch

from oasis_warp.bench.gpu_profile import KernelTime, add_up, kernel_times, short_name


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
