"""Seeded scenes for the rasterizer's tests, and their projections, forward and backward.

All numbers are float32 numbers, so that both precisions see the same.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from oasis_warp.certify.rasterization_scenes import CONDITIONS as CONDITIONS_OF_CASES
from oasis_warp.certify.rasterization_scenes import rasterization_case
from oasis_warp.core.rotation import to_matrix
from oasis_warp.ops.projection import Projection, project


@dataclass(frozen=True)
class Scene:
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor
    width: int
    height: int

    @property
    def gaussians(self):
        return self.means, self.quats, self.scales, self.opacities

    @property
    def tensors(self):
        return {k: v for k, v in vars(self).items() if isinstance(v, Tensor)}

    def to(self, *args, **kwargs):
        return replace(self, **{k: v.to(*args, **kwargs) for k, v in self.tensors.items()})

    def with_(self, **changes):
        return replace(self, **changes)


def covariances(scene):
    """R S S R^T of a scene's quats and scales."""
    half = to_matrix(torch.nn.functional.normalize(scene.quats, dim=-1)) * scene.scales[:, None]
    return half @ half.mT


def look_from(eye, target=(0.0, 0.0, 0.0)):
    """World-to-camera matrix in float64, y down."""
    eye, target = torch.tensor(eye, dtype=torch.float64), torch.tensor(target, dtype=torch.float64)
    z = torch.nn.functional.normalize(target - eye, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.tensor([0.1, -1.0, 0.2], dtype=torch.float64)), dim=0)
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ eye
    return viewmat


def intrinsics(fx, fy, cx, cy):
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def ordinary_scene(
    seed=0, n=60, width=37, height=29, channels=3, cameras=2, device="cpu", dtype=torch.float32, size=(0.04, 0.2)
):
    """A cloud of unit size, about three units away, whose Gaussians overlap in many layers."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape, low=0.0, high=1.0):
        return torch.rand(*shape, generator=g, dtype=torch.float64) * (high - low) + low

    eyes = [(0.3, -0.2, -3.0), (2.1, 0.4, -2.2), (-1.0, 1.5, 2.6), (0.1, -2.9, 0.4)]
    focal = 1.1 * max(width, height)
    scene = Scene(
        means=uniform(n, 3, low=-0.9, high=0.9),
        quats=torch.randn(n, 4, generator=g, dtype=torch.float64) * 2,
        scales=uniform(n, 3, low=size[0], high=size[1]),
        opacities=uniform(n, low=0.05, high=0.99),
        colors=uniform(n, channels),
        viewmats=torch.stack([look_from(eye) for eye in eyes[:cameras]]),
        Ks=intrinsics(focal, 1.07 * focal, 0.52 * width, 0.47 * height).repeat(cameras, 1, 1),
        backgrounds=uniform(cameras, channels),
        width=width,
        height=height,
    )
    return scene.to(torch.float32).to(device=device, dtype=dtype)


def frontal_scene(means, scales, opacities, width=32, height=32, focal=40.0, quats=None, colors=None, seed=0):
    """Given Gaussians before a camera at the origin that looks along z; one number for scales is squeezed a little,
    because the gradient by the rotation of a sphere is nothing but rounding.
    """
    g = torch.Generator().manual_seed(seed)
    n = len(means)
    means = torch.as_tensor(means, dtype=torch.float64)
    scales = torch.tensor([scales, 0.8 * scales, 0.6 * scales]) if isinstance(scales, float) else scales
    random_quats = torch.randn(n, 4, generator=g, dtype=torch.float64)
    random_colors = torch.rand(n, 3, generator=g, dtype=torch.float64)
    scene = Scene(
        means=means,
        quats=random_quats if quats is None else torch.as_tensor(quats, dtype=torch.float64),
        scales=torch.as_tensor(scales, dtype=torch.float64).expand(n, 3).clone(),
        opacities=torch.as_tensor(opacities, dtype=torch.float64).expand(n).clone(),
        colors=random_colors if colors is None else torch.as_tensor(colors, dtype=torch.float64),
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=intrinsics(focal, focal, width / 2 + 0.3, height / 2 - 0.2)[None],
        backgrounds=torch.rand(1, 3, generator=g, dtype=torch.float64),
        width=width,
        height=height,
    )
    return scene.to(torch.float32).to(torch.float64)


def cloud(n, seed=0, spread=(1.0, 1.0, 0.6), centre=(0.0, 0.0, 3.0)):
    """Points in a box of half sides `spread` about `centre`."""
    g = torch.Generator().manual_seed(seed)
    uniform = torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5
    return 2 * uniform * torch.tensor(spread, dtype=torch.float64) + torch.tensor(centre, dtype=torch.float64)


CONDITIONS = tuple(name for name in CONDITIONS_OF_CASES if name != "covariances")


def stiff_scene(condition, n=40):
    """A scene under a condition that breaks an obvious float32 implementation."""
    floats = rasterization_case(condition, 0, n=n, size=(32, 32), n_cameras=1, channels=3, mode="RGB").floats
    names = "means", "quats", "scales", "opacities", "viewmats", "Ks"
    others = ordinary_scene(1, n=len(floats["means"]), cameras=1)
    return others.with_(**{name: floats[name] for name in names}, width=32, height=32).to(torch.float64)


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
