"""Scenes for the rasterizer: ordinary clouds and every condition that breaks an obvious float32 implementation."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from oasis_warp.certify.case import LONG_NEEDLES, STIFF, Bounds, Case, Sampler
from oasis_warp.core.rotation import to_matrix

NEAR = float(np.float32(0.01))
"""Default near plane."""
SIZES = ((1, 1), (1, 9), (11, 1), (5, 4), (16, 16), (17, 15), (31, 33), (37, 29), (65, 63), (257, 2))
"""Width and height: single pixels and rows, sizes that are no multiple of a tile, strip or vector."""
COUNTS = (0, 1, 2, 7, 20, 60, 150, 300)
CHANNELS = (1, 2, 3, 3, 3, 3, 4, 5, 8, 16, 32)
MODES = ("RGB", "RGB", "RGB", "D", "ED", "RGB+D", "RGB+ED")
WORK = 60_000
"""Most pixels times Gaussians of a scene, over all its cameras: what the dense reference does in some 20 ms."""
EYES = ((0.3, -0.2, -3.0), (2.1, 0.4, -2.2), (-1.0, 1.5, 2.6))
FAINT = 0.02
"""Alpha is 1 - T, and T has the rounding of 1."""
SAFE = 1e-3
"""Distance from a kink that no finite difference reaches."""
DEPTH_TIE = 2e-6
"""Relative difference of two depths below which rounding may swap them, unless they are equal."""


@dataclasses.dataclass
class Cloud:
    """The Gaussians and the camera settings of a condition."""

    means: Tensor
    scales: Tensor
    opacities: Tensor
    bounds: Bounds = STIFF
    focal: float = 1.1
    """In widths or heights of the image, whichever is larger."""
    frontal: bool = False
    """Whether cameras look along z from the world's origin; they look at it from `EYES` otherwise."""
    quat_norm: float = 2.0
    eps2d: float | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to the world, cameras included."""
    planes: tuple[float, float] | None = None
    covars: bool = False
    """Whether covariances are given instead of quaternions and scales."""
    no_gradient: float = 0.0
    """Floor for gradients of positions and shapes: those of an image without structure are rounding."""


def ball(rng: Sampler, n: int, **options) -> Cloud:
    """Small Gaussians about the origin."""
    means, scales = rng.uniform(n, 3, low=-0.9, high=0.9), rng.uniform(n, 3, low=0.04, high=0.2)
    return Cloud(means, scales, rng.uniform(n, low=0.05, high=0.99), **options)


def frontal(
    rng: Sampler, n: int, scales: tuple[float, float, float], spread=(1.0, 1.0, 0.6), distance: float = 3.0,
    opacities: Tensor | None = None, **options,
) -> Cloud:  # fmt: skip
    """Gaussians of nearly one shape before a camera at the origin."""
    means = rng.uniform(n, 3, low=-1.0) * torch.tensor(spread) + torch.tensor([0.0, 0.0, distance])
    sizes = torch.tensor(scales, dtype=torch.float64) * rng.uniform(n, 3, low=0.7)
    if opacities is None:
        opacities = rng.uniform(n, low=0.3, high=0.9)
    return Cloud(means, sizes, opacities, frontal=True, **options)


def at_near_plane(rng: Sampler, n: int) -> Cloud:
    """Centres on the near plane, which are drawn, and beside it."""
    cloud = frontal(rng, n, (1e-3, 0.8e-3, 0.6e-3), spread=(0.008, 0.008, 0.02), distance=0.0301)
    cloud.means[: n // 4, 2] = NEAR
    return cloud


def in_camera_plane(rng: Sampler, n: int) -> Cloud:
    """A third of the centres at depth 0."""
    cloud = frontal(rng, n, (0.2, 0.15, 0.1))
    cloud.means[: n // 3, 2] = 0.0
    return cloud


def nearly_opaque_front(rng: Sampler, n: int) -> Cloud:
    """Three layers after which hardly any transmittance is left, and more behind them."""
    opacities = rng.uniform(n, low=0.4, high=0.8)
    opacities[:3] = torch.tensor([0.9, 0.95, 0.9])[:n]
    cloud = frontal(rng, n, (0.4, 0.3, 0.25), spread=(0.1, 0.1, 0.0), opacities=opacities)
    cloud.means[:, 2] += 0.1 * torch.arange(n)
    return cloud


def faint_layers(rng: Sampler, n: int) -> Cloud:
    """Opacities at and above the cut-off, 1500 layers if the scene may be large."""
    n = 1500 if n > 60 else n
    return frontal(rng, n, (0.5, 0.4, 0.3), spread=(0.2, 0.2, 0.8), opacities=rng.uniform(n, low=0.004, high=0.02))


def equal_depths(rng: Sampler, n: int) -> Cloud:
    """All Gaussians in one plane: their order is that of the list."""
    cloud = frontal(rng, n, (0.2, 0.15, 0.1), opacities=rng.uniform(n, low=0.5, high=0.9))
    cloud.means[:, 2] = rng.pick((3.0, 2.5))
    return cloud


def duplicates(rng: Sampler, n: int) -> Cloud:
    """Every Gaussian twice."""
    cloud, half = frontal(rng, n, (0.2, 0.15, 0.1)), n // 2
    for tensor in (cloud.means, cloud.scales, cloud.opacities):
        tensor[half : 2 * half] = tensor[:half]
    return cloud


def huge(rng: Sampler, n: int) -> Cloud:
    """Boxes whose corners are no 32-bit integers."""
    n = min(n, 7)
    return frontal(rng, n, (1e12, 1e9, 1e10), opacities=rng.uniform(n, low=0.02, high=0.3), no_gradient=1e-10)


CONDITIONS: dict[str, Callable[[Sampler, int], Cloud]] = {
    "ordinary": lambda rng, n: ball(rng, n, bounds=Bounds()),
    "needles": lambda rng, n: frontal(rng, n, (0.8, 1e-3, 1.1e-3), bounds=LONG_NEEDLES),
    # 2 images long; 570 px in the widest
    "needles longer than the image": lambda rng, n: frontal(rng, n, (6.0, 1e-4, 1.1e-4), bounds=LONG_NEEDLES),
    "pancakes": lambda rng, n: frontal(rng, n, (0.2, 0.15, rng.pick((1e-6, 0.0)))),
    "lines": lambda rng, n: frontal(rng, n, (0.2, 0.0, 0.0)),
    "points": lambda rng, n: frontal(rng, n, (0.0, 0.0, 0.0)),
    "smaller than a pixel": lambda rng, n: frontal(rng, n, (1e-3, 0.8e-3, 0.6e-3)),
    "larger than the image": lambda rng, n: frontal(
        rng, n, (40.0, 30.0, 25.0), opacities=rng.uniform(n, low=0.02, high=0.3)
    ),
    "larger than integers": huge,
    "at the near plane": at_near_plane,
    "in the plane of the camera": in_camera_plane,
    "partly behind the camera": lambda rng, n: frontal(rng, n, (0.15, 0.1, 0.08), spread=(1.0, 1.0, 4.0), distance=0.0),
    "all behind the camera": lambda rng, n: frontal(rng, n, (0.3, 0.2, 0.1), distance=-3.0),
    "beyond the clamp of the Jacobian": lambda rng, n: frontal(
        rng, n, (0.8, 0.6, 0.5), spread=(3.0, 3.0, 0.5), distance=1.2
    ),
    "wide angle": lambda rng, n: frontal(rng, n, (0.5, 0.4, 0.3), focal=rng.pick((0.02, 0.2))),
    "telephoto": lambda rng, n: frontal(
        rng, n, (0.05, 0.04, 0.03), spread=(0.4, 0.4, 0.5), distance=1000.0, focal=600.0, bounds=LONG_NEEDLES
    ),
    "far from the origin of the world": lambda rng, n: ball(rng, n, offset=(1000.0, -500.0, 2000.0)),
    "opaque stack": lambda rng, n: frontal(
        rng, n, (0.3, 0.2, 0.1), spread=(0.05, 0.05, 0.8), opacities=torch.ones(n).double()
    ),
    # sigma is below 1e-3 in every pixel: the cap acts, and only colours may get a gradient through it.
    "opaque and wide": lambda rng, n: frontal(rng, n, (200.0, 150.0, 100.0), opacities=torch.ones(n).double()),
    "nearly opaque front": nearly_opaque_front,
    "thousands of faint layers": faint_layers,
    "opacities at the cut-off": lambda rng, n: frontal(
        rng, n, (0.3, 0.2, 0.1), opacities=torch.linspace(0.0, 0.012, n, dtype=torch.float64)
    ),
    "equal depths": equal_depths,
    "duplicates": duplicates,
    "quaternions of any norm": lambda rng, n: dataclasses.replace(
        ball(rng, n), quat_norm=rng.pick((1e-12, 1e-3, 1e3, 1e12))
    ),
    "narrow low-pass": lambda rng, n: frontal(rng, n, (0.2, 0.15, 0.1), eps2d=rng.pick((0.0, 0.02))),
    "tight planes": lambda rng, n: ball(rng, n, planes=(2.5, 3.4)),
    "covariances": lambda rng, n: ball(rng, n, covars=True),
    "transparent": lambda rng, n: frontal(
        rng, n, (0.2, 0.15, 0.1), opacities=rng.uniform(n, low=0.1, high=0.9) * rng.integers(2, n)
    ),
}


def look_from(eye: tuple[float, float, float]) -> Tensor:
    """World-to-camera matrix of a camera that looks to the origin, y down."""
    position = torch.tensor(eye, dtype=torch.float64)
    z = -position / position.norm()
    x = torch.linalg.cross(z, torch.tensor([0.1, -1.0, 0.2], dtype=torch.float64))
    x = x / x.norm()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return viewmat


def cameras(rng: Sampler, cloud: Cloud, n: int) -> Tensor:
    """World-to-camera matrices [n, 4, 4]."""
    if not cloud.frontal:
        return torch.stack([look_from(eye) for eye in EYES[:n]])
    # Shifted sideways only: depths stay those of the condition.
    viewmats = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    viewmats[1:, :2, 3] = 0.1 * cloud.means[:, 2].abs().mean().nan_to_num() * rng.normal(n - 1, 2)
    return viewmats


@dataclasses.dataclass(frozen=True)
class Choices:
    """What a caller may fix of a scene; None leaves it to the seed."""

    n: int | None = None
    size: tuple[int, int] | None = None
    n_cameras: int | None = None
    channels: int | None = None
    mode: str | None = None
    sh_degree: int | None = None
    """None also stands for colours without harmonics."""
    spread: float = 1.0
    """Factor of the scales."""


def rasterization_case(name: str, seed: int, **choices) -> Case:
    """A scene under the condition `name`; `choices` are fields of `Choices`."""
    rng, fixed = Sampler(seed), Choices(**choices)
    width, height = fixed.size or rng.pick(SIZES)
    n_cameras = fixed.n_cameras or rng.pick((1, 1, 2, 3))
    n = fixed.n
    if n is None:
        n = rng.pick([count for count in COUNTS if count * width * height * n_cameras <= WORK])
    cloud = CONDITIONS[name](rng, n)
    n = len(cloud.means)
    channels, mode = fixed.channels or rng.pick(CHANNELS), fixed.mode or rng.pick(MODES)
    sh_degree = fixed.sh_degree
    if rng.pick((False,) * 4 + (True,)) and sh_degree is None:
        sh_degree = rng.pick((0, 1, 2, 3))
    per_camera, has_background = rng.pick((False, True)), rng.pick((True, True, False))
    viewmats, offset = cameras(rng, cloud, n_cameras), torch.tensor(cloud.offset, dtype=torch.float64)
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ offset
    focal = cloud.focal * max(width, height)
    K = torch.tensor([[focal, 0, 0.52 * width], [0, 1.07 * focal, 0.47 * height], [0, 0, 1]], dtype=torch.float64)
    quats = rng.normal(n, 4)
    floats = {
        "means": (cloud.means + offset).float().double(),
        "quats": cloud.quat_norm * quats / quats.norm(dim=-1, keepdim=True),
        "scales": fixed.spread * cloud.scales,
        "opacities": cloud.opacities,
        "colors": rng.uniform(*([n_cameras] if per_camera else []), n, channels),
        "viewmats": viewmats,
        "Ks": K.repeat(n_cameras, 1, 1),
        "backgrounds": rng.uniform(n_cameras, channels),
    }
    others = {"width": width, "height": height, "render_mode": mode}
    if cloud.eps2d is not None:
        others["eps2d"] = cloud.eps2d
    if sh_degree is not None:
        # As many coefficients as a degree more would have: those beyond `sh_degree` are not read.
        floats["colors"] = 0.3 * rng.normal(*([n_cameras] if per_camera else []), n, (sh_degree + 2) ** 2, 3)
        floats["backgrounds"] = rng.uniform(n_cameras, 3)
        others["sh_degree"] = sh_degree
    floats["opacities"] = without_near_ties(floats["means"], viewmats.float().double(), cloud.opacities)
    if cloud.covars:
        half = to_matrix(floats.pop("quats")) * floats.pop("scales")[:, None]
        twist = 1e-3 * rng.normal(n, 3, 3)  # of which the antisymmetric part must not count
        floats["covars"] = half @ half.mT + twist - twist.mT
        others |= {"quats": None, "scales": None}
    if cloud.planes:
        others |= {"near_plane": cloud.planes[0], "far_plane": cloud.planes[1]}
    if not has_background:
        del floats["backgrounds"]
    differentiable = tuple(key for key in floats if key != "Ks")
    floors = dict.fromkeys(("means", "quats", "scales", "viewmats"), cloud.no_gradient) | {"alphas": FAINT}
    return Case(name, seed, floats, differentiable, others, bounds_of(name, cloud, mode), floors)


def bounds_of(name: str, cloud: Cloud, mode: str) -> Bounds:
    """The bounds of a condition in a render mode."""
    if name in ("telephoto", "equal depths", "duplicates") and "ED" in mode:
        # An expected depth changes by differences of depths: of 1000 m, which float32 holds to 6e-5, or of equal ones.
        return dataclasses.replace(cloud.bounds, gradients=5e-3)
    return cloud.bounds


def without_near_ties(means: Tensor, viewmats: Tensor, opacities: Tensor) -> Tensor:
    """Opacities, 0 for Gaussians whose depth in any camera is that of another but for rounding, or a plane's."""
    opacities = opacities.clone()
    for viewmat in viewmats:
        z = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
        order = z.argsort(stable=True)
        gap = z[order].diff().abs()
        close = (gap > 0) & (gap < DEPTH_TIE * z[order][1:].abs())
        opacities[order[1:][close]] = 0.0
        opacities[(z != NEAR) & ((z - NEAR).abs() < DEPTH_TIE * NEAR)] = 0.0
    return opacities


def is_smooth(case: Case) -> bool:
    """Whether a small step swaps no two layers and passes no end of the Jacobian's clamp."""
    width, height = case.others["width"], case.others["height"]
    for viewmat, K in zip(case.floats["viewmats"], case.floats["Ks"], strict=True):
        x, y, z = (case.floats["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)
        if bool((z.sort().values.diff() < SAFE).any()):
            return False
        for slope, size, focal, center in ((x / z, width, K[0, 0], K[0, 2]), (y / z, height, K[1, 1], K[1, 2])):
            for end in (-center - 0.15 * size, size - center + 0.15 * size):
                if bool(((slope - end / focal).abs() < SAFE).any()):
                    return False
    return True
