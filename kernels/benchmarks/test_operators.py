"""Every operator against the same in torch and against its generic kernels, as benchmarks that can be compared.

    pytest kernels/benchmarks                                   a group an operator and pass; (x) is over the fastest
    pytest kernels/benchmarks --benchmark-autosave              kept in .benchmarks
    pytest kernels/benchmarks --benchmark-compare               against the last one kept
    pytest kernels/benchmarks -k "rasterization and not torch"

`oasis bench kernels` measures the same without pytest, interleaved, with a yardstick. Results are checked before they
are timed: a wrong answer fails. BENCH_DEVICE (cpu), BENCH_SIZE (256), BENCH_GAUSSIANS (20000) and BENCH_THREADS (1) in
the environment say on what.
"""

import os

import pytest
import torch

from oasis_warp.bench import speed
from oasis_warp.bench.knobs import timed_pass
from oasis_warp.bench.operators import OPERATORS, exact
from oasis_warp.bench.scenes import GaussianScene, hand_scenes, surfels
from oasis_warp.bench.timing import synchronise

DEVICE = torch.device(os.environ.get("BENCH_DEVICE", "cpu"))
SIZE = int(os.environ.get("BENCH_SIZE", "256"))
GAUSSIANS = int(os.environ.get("BENCH_GAUSSIANS", "20000"))
THREADS = int(os.environ.get("BENCH_THREADS", "1"))
VALUES, GRADIENTS = 5e-6, 5e-5
"""Largest relative errors of ours; torch's depth buffer and gradients in float32 are worse."""
CASES = [
    pytest.param(name, pass_, backend, id=f"{name}-{pass_.replace(' + ', '_and_')}-{backend}")
    for name, operator in OPERATORS.items()
    for pass_ in operator.passes
    for backend in speed.backends(operator, DEVICE)
]


@pytest.fixture(scope="session")
def scenes():
    return surfels(GAUSSIANS, SIZE).to(device=DEVICE), hand_scenes(SIZE)[1].to(device=DEVICE)


@pytest.fixture(scope="session")
def truths(scenes):
    """Exact results, computed when they are first asked for."""
    found = {}

    def of(name):
        if name not in found:
            found[name] = exact(OPERATORS[name], scenes[0] if OPERATORS[name].scene is GaussianScene else scenes[1])
        return found[name]

    return of


@pytest.mark.parametrize(("name", "pass_", "backend"), CASES)
def test_operator(benchmark, scenes, truths, name, pass_, backend):
    operator = OPERATORS[name]
    scene = scenes[0] if operator.scene is GaussianScene else scenes[1]
    truth = truths(name)
    timed = timed_pass(operator, scene, speed.backends(operator, DEVICE)[backend], pass_, truth, THREADS)
    benchmark.group = f"{name}, {pass_}"

    def call():
        timed.run()
        synchronise()

    with timed.ready():
        found = timed.run()
        value_error, gradient_error = truth.value_error(found.values), truth.gradient_error(found.gradients)
        if backend != "torch":
            assert value_error <= VALUES
            assert gradient_error is None or gradient_error <= GRADIENTS
        benchmark.extra_info.update(rel_l2=value_error, gradient_rel_l2=gradient_error, threads=THREADS, size=SIZE)
        benchmark(call)
