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


def gaussians(n=6):
    g = torch.Generator().manual_seed(1)
    means = torch.randn(n, 3, generator=g) * 0.3
    quats, scales = torch.randn(n, 4, generator=g), torch.rand(n, 3, generator=g) * 0.2 + 0.05
    return means, quats, scales, torch.rand(n, generator=g) * 0.8 + 0.1


def camera():
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0
    return viewmat, torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])


def rasterization():
    viewmat, K = camera()

    def draw(means, quats, scales, opacities, colors, backgrounds, viewmats):
        image, alphas, meta = ops.rasterization(
            means, quats, scales, opacities, colors, viewmats, K[None], 17, 15, backgrounds=backgrounds,
            render_mode="RGB+ED",
        )  # fmt: skip
        return image, alphas, meta["means2d"]

    g = torch.Generator().manual_seed(2)
    return draw, [*gaussians(), torch.rand(6, 3, generator=g), torch.rand(1, 3, generator=g), viewmat[None]]


def rasterization_of_harmonics_and_covariances():
    viewmat, K = camera()
    means, _, scales, opacities = gaussians()

    def draw(means, variances, opacities, coefficients):
        covars = torch.diag_embed(variances)
        image, alphas, _ = ops.rasterization(
            means, None, None, opacities, coefficients, viewmat[None], K[None], 17, 15, covars=covars, sh_degree=1
        )
        return image, alphas

    coefficients = torch.rand(6, 4, 3, generator=torch.Generator().manual_seed(3))
    return draw, [means, scales.square(), opacities, coefficients]


CASES = [spherical_harmonics, rasterization, rasterization_of_harmonics_and_covariances]


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
