"""Compile every operator into one graph, forward and backward; one JSON line each. Run by test_compile.py.

A process of its own, because the shape checks of the test run are Python that torch.compile cannot look through.
"""

import json
import traceback

import torch

from oasis_warp import ops


def spherical_harmonics():
    g = torch.Generator().manual_seed(0)
    directions, coefficients = torch.randn(5, 3, generator=g), torch.randn(5, 16, 3, generator=g)
    return lambda d, c: ops.spherical_harmonics(3, d, c), [directions, coefficients]


CASES = [spherical_harmonics]


def gradients(call, inputs):
    leaves = [t.clone().requires_grad_() for t in inputs]
    outputs = call(*leaves)
    outputs = [outputs] if isinstance(outputs, torch.Tensor) else list(outputs)
    total = sum(((k + 1) * out).square().sum() for k, out in enumerate(outputs) if out.requires_grad)
    return [out.detach() for out in outputs], torch.autograd.grad(total, leaves)


def check(case):
    call, inputs = case()
    torch._dynamo.reset()
    eager = gradients(call, inputs)
    compiled = gradients(torch.compile(call, fullgraph=True, backend="aot_eager"), inputs)
    for a, b in zip([*eager[0], *eager[1]], [*compiled[0], *compiled[1]], strict=True):
        assert torch.equal(a, b), "compiled and eager differ"


def main():
    for case in CASES:
        try:
            check(case)
            error = ""
        except Exception:
            error = traceback.format_exc()
        print(json.dumps({"operator": case.__name__, "error": error}), flush=True)


if __name__ == "__main__":
    main()
