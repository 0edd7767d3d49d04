"""Projecting the seeded scenes, forward and backward, for the tests of projection."""

import torch

from oasis_warp.ops.projection import Projection, project

OPTIONS = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3}


def incoming(projection, seed=0):
    """Random gradients by means2d, covars2d and depths: float32 numbers, the same for either precision."""
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(out.shape, generator=g).to(out) for out in projection[:3]]


def run(scene, covars=None, by=("means", "quats", "scales", "covars", "viewmats"), seed=0, **options):
    """The projection of a scene, and gradients of a random sum over it."""
    shapes = {"quats": scene.quats, "scales": scene.scales} if covars is None else {"covars": covars}
    inputs = {"means": scene.means, **shapes, "viewmats": scene.viewmats}
    inputs = {k: v.detach().requires_grad_(k in by) for k, v in inputs.items()}
    out = project(
        inputs["means"], inputs.get("quats"), inputs.get("scales"), scene.opacities, inputs["viewmats"], scene.Ks,
        scene.width, scene.height, covars=inputs.get("covars"), **(OPTIONS | options),
    )  # fmt: skip
    asked = {k: v for k, v in inputs.items() if k in by}
    gradients = torch.autograd.grad(out[:3], list(asked.values()), incoming(out, seed))
    return Projection(*(t.detach() for t in out)), dict(zip(asked, gradients, strict=True))


def bits(result):
    projection, gradients = result
    return [*projection, *gradients.values()]


def assert_equal_bits(one, other):
    for a, b in zip(bits(one), bits(other), strict=True):
        assert torch.equal(a, b)
