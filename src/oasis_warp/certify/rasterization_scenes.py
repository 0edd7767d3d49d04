"""Scenes for the rasterizer: ordinary clouds and every condition that breaks an obvious float32 implementation."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from oasis_warp.certify.case import LONG_NEEDLES, STIFF, Bounds, Case, Draw
from oasis_warp.core.rotation import to_matrix

NEAR = float(np.float32(0.01))
"""Near plane by default [m]."""
SIZES = ((1, 1), (1, 9), (11, 1), (5, 4), (16, 16), (17, 15), (31, 33), (37, 29), (65, 63), (257, 2))
"""Width and height: single pixels and rows, sizes that are no multiple of a tile, strip or vector."""
COUNTS = (0, 1, 2, 7, 20, 60, 150, 300)
CHANNELS = (1, 2, 3, 3, 3, 3, 4, 5, 8, 16, 32)
MODES = ("RGB", "RGB", "RGB", "D", "ED", "RGB+D", "RGB+ED")
WORK = 60_000
"""Most pixels times Gaussians of a scene, over all its cameras: what the dense twin does in some 20 ms."""
EYES = ((0.3, -0.2, -3.0), (2.1, 0.4, -2.2), (-1.0, 1.5, 2.6))
FAINT = 0.02
"""Alpha is 1 - T, and T has the rounding of 1."""
SAFE = 1e-3
"""Distance from a kink that no finite difference reaches."""
DEPTH_TIE = 2e-6
"""Relative difference of two depths below which rounding may swap them, unless they are equal."""


@dataclasses.dataclass
class Cloud:
    """What a condition decides; the rest of a scene is drawn round it."""

    means: Tensor
    scales: Tensor
    opacities: Tensor
    bounds: Bounds = STIFF
    focal: float = 1.1
    """In widths or heights of the image, whichever is larger."""
    eye: tuple[float, float, float] | None = None
    """World origin of a camera that looks along z; several cameras round the origin when None."""
    quat_norm: float = 2.0
    eps2d: float | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to the world, cameras included."""
    planes: tuple[float, float] | None = None
    covars: bool = False
    """Whether covariances are given, not quaternions and scales."""
    no_gradient: float = 0.0
    """What counts as zero in a gradient of places and shapes: that of an image without structure is rounding."""


Condition = Callable[[Draw, int], Cloud]
CONDITIONS: dict[str, Condition] = {}


def condition(name: str) -> Callable[[Condition], Condition]:
    """Enter a function into `CONDITIONS`."""

    def enter(function: Condition) -> Condition:
        CONDITIONS[name] = function
        return function

    return enter


def frontal(
    draw: Draw, n: int, scales: tuple[float, float, float], spread=(1.0, 1.0, 0.6), distance: float = 3.0,
    opacities: Tensor | None = None, **options,
) -> Cloud:  # fmt: skip
    """Gaussians of nearly one shape before a camera at the origin."""
    means = draw.uniform(n, 3, low=-1.0) * torch.tensor(spread) + torch.tensor([0.0, 0.0, distance])
    sizes = torch.tensor(scales, dtype=torch.float64) * draw.uniform(n, 3, low=0.7)
    if opacities is None:
        opacities = draw.uniform(n, low=0.3, high=0.9)
    return Cloud(means, sizes, opacities, eye=(0.0, 0.0, 0.0), **options)


@condition("ordinary")
def _(draw: Draw, n: int) -> Cloud:
    means, scales = draw.uniform(n, 3, low=-0.9, high=0.9), draw.uniform(n, 3, low=0.04, high=0.2)
    return Cloud(means, scales, draw.uniform(n, low=0.05, high=0.99), Bounds())


@condition("needles")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.8, 1e-3, 1.1e-3), bounds=LONG_NEEDLES)


@condition("needles longer than the image")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (6.0, 1e-4, 1.1e-4), bounds=LONG_NEEDLES)  # 2 images long; 570 px in the widest


@condition("pancakes")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.2, 0.15, draw.pick((1e-6, 0.0))))


@condition("lines")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.2, 0.0, 0.0))


@condition("points")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.0, 0.0, 0.0))


@condition("smaller than a pixel")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (1e-3, 0.8e-3, 0.6e-3))


@condition("larger than the image")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (40.0, 30.0, 25.0), opacities=draw.uniform(n, low=0.02, high=0.3))


@condition("larger than integers")
def _(draw: Draw, n: int) -> Cloud:
    n = min(n, 7)
    return frontal(draw, n, (1e12, 1e9, 1e10), opacities=draw.uniform(n, low=0.02, high=0.3), no_gradient=1e-10)


@condition("at the near plane")
def _(draw: Draw, n: int) -> Cloud:
    cloud = frontal(draw, n, (1e-3, 0.8e-3, 0.6e-3), spread=(0.008, 0.008, 0.02), distance=0.0301)
    cloud.means[: n // 4, 2] = NEAR  # a centre on the plane is drawn
    return cloud


@condition("in the plane of the camera")
def _(draw: Draw, n: int) -> Cloud:
    cloud = frontal(draw, n, (0.2, 0.15, 0.1))
    cloud.means[: n // 3, 2] = 0.0
    return cloud


@condition("partly behind the camera")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.15, 0.1, 0.08), spread=(1.0, 1.0, 4.0), distance=0.0)


@condition("all behind the camera")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.3, 0.2, 0.1), distance=-3.0)


@condition("beyond the clamp of the Jacobian")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.8, 0.6, 0.5), spread=(3.0, 3.0, 0.5), distance=1.2)


@condition("wide angle")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.5, 0.4, 0.3), focal=draw.pick((0.02, 0.2)))


@condition("telephoto")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.05, 0.04, 0.03), spread=(0.4, 0.4, 0.5), distance=1000.0, focal=600.0,
                   bounds=LONG_NEEDLES)  # fmt: skip


@condition("far from the origin of the world")
def _(draw: Draw, n: int) -> Cloud:
    means, scales = draw.uniform(n, 3, low=-0.9, high=0.9), draw.uniform(n, 3, low=0.04, high=0.2)
    return Cloud(means, scales, draw.uniform(n, low=0.05, high=0.99), offset=(1000.0, -500.0, 2000.0))


@condition("opaque stack")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.3, 0.2, 0.1), spread=(0.05, 0.05, 0.8), opacities=torch.ones(n).double())


@condition("opaque and wide")
def _(draw: Draw, n: int) -> Cloud:
    # sigma is below 1e-3 in every pixel: the cap acts, and only colours may get a gradient through it.
    return frontal(draw, n, (200.0, 150.0, 100.0), opacities=torch.ones(n).double())


@condition("nearly opaque front")
def _(draw: Draw, n: int) -> Cloud:
    opacities = draw.uniform(n, low=0.4, high=0.8)
    opacities[:3] = torch.tensor([0.9, 0.95, 0.9])[:n]
    cloud = frontal(draw, n, (0.4, 0.3, 0.25), spread=(0.1, 0.1, 0.0), opacities=opacities)
    cloud.means[:, 2] += 0.1 * torch.arange(n)
    return cloud


@condition("thousands of faint layers")
def _(draw: Draw, n: int) -> Cloud:
    n = 1500 if n > 60 else n
    return frontal(draw, n, (0.5, 0.4, 0.3), spread=(0.2, 0.2, 0.8), opacities=draw.uniform(n, low=0.004, high=0.02))


@condition("opacities at the cut-off")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.3, 0.2, 0.1), opacities=torch.linspace(0.0, 0.012, n, dtype=torch.float64))


@condition("equal depths")
def _(draw: Draw, n: int) -> Cloud:
    cloud = frontal(draw, n, (0.2, 0.15, 0.1), opacities=draw.uniform(n, low=0.5, high=0.9))
    cloud.means[:, 2] = draw.pick((3.0, 2.5))
    return cloud


@condition("duplicates")
def _(draw: Draw, n: int) -> Cloud:
    cloud = frontal(draw, n, (0.2, 0.15, 0.1))
    half = n // 2
    for tensor in (cloud.means, cloud.scales, cloud.opacities):
        tensor[half : 2 * half] = tensor[:half]
    return cloud


@condition("quaternions of any norm")
def _(draw: Draw, n: int) -> Cloud:
    means, scales = draw.uniform(n, 3, low=-0.9, high=0.9), draw.uniform(n, 3, low=0.04, high=0.2)
    return Cloud(means, scales, draw.uniform(n, low=0.05, high=0.99), quat_norm=draw.pick((1e-12, 1e-3, 1e3, 1e12)))


@condition("narrow low-pass")
def _(draw: Draw, n: int) -> Cloud:
    return frontal(draw, n, (0.2, 0.15, 0.1), eps2d=draw.pick((0.0, 0.02)))


@condition("tight planes")
def _(draw: Draw, n: int) -> Cloud:
    means, scales = draw.uniform(n, 3, low=-0.9, high=0.9), draw.uniform(n, 3, low=0.04, high=0.2)
    return Cloud(means, scales, draw.uniform(n, low=0.05, high=0.99), planes=(2.5, 3.4))


@condition("covariances")
def _(draw: Draw, n: int) -> Cloud:
    means, scales = draw.uniform(n, 3, low=-0.9, high=0.9), draw.uniform(n, 3, low=0.04, high=0.2)
    return Cloud(means, scales, draw.uniform(n, low=0.05, high=0.99), covars=True)


@condition("transparent")
def _(draw: Draw, n: int) -> Cloud:
    opacities = draw.uniform(n, low=0.1, high=0.9) * draw.integers(2, n)
    return frontal(draw, n, (0.2, 0.15, 0.1), opacities=opacities)


def look_from(eye: tuple[float, float, float]) -> Tensor:
    """World-to-camera matrix of a camera that looks to the origin, y down."""
    place = torch.tensor(eye, dtype=torch.float64)
    z = -place / place.norm()
    x = torch.linalg.cross(z, torch.tensor([0.1, -1.0, 0.2], dtype=torch.float64))
    x = x / x.norm()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ place
    return viewmat


def rasterization_case(
    name: str,
    seed: int,
    n: int | None = None,
    size: tuple[int, int] | None = None,
    n_cameras: int | None = None,
    channels: int | None = None,
    mode: str | None = None,
    sh_degree: int | None = None,
    spread: float = 1.0,
) -> Case:
    """A scene under the condition `name`; what is None is drawn; `spread` scales the Gaussians."""
    draw = Draw(seed)
    width, height = draw.pick(SIZES) if size is None else size
    n_cameras = draw.pick((1, 1, 2, 3)) if n_cameras is None else n_cameras
    if n is None:
        n = draw.pick([count for count in COUNTS if count * width * height * n_cameras <= WORK])
    cloud = CONDITIONS[name](draw, n)
    cloud.scales *= spread
    channels = draw.pick(CHANNELS) if channels is None else channels
    mode = draw.pick(MODES) if mode is None else mode
    if draw.pick((False,) * 4 + (True,)) and sh_degree is None:
        sh_degree = draw.pick((0, 1, 2, 3))
    return finish(name, seed, draw, cloud, (width, height), n_cameras, channels, mode, sh_degree)


def finish(
    name: str,
    seed: int,
    draw: Draw,
    cloud: Cloud,
    size: tuple[int, int],
    n_cameras: int,
    channels: int,
    mode: str,
    sh_degree: int | None,
) -> Case:
    """Cameras, rotations and colours for a cloud."""
    width, height = size
    n = len(cloud.means)
    per_camera, has_background = draw.pick((False, True)), draw.pick((True, True, False))
    if cloud.eye is None:
        viewmats = torch.stack([look_from(eye) for eye in EYES[:n_cameras]])
    else:
        # Shifted sideways only: depths stay those of the condition.
        viewmats = torch.eye(4, dtype=torch.float64).repeat(n_cameras, 1, 1)
        viewmats[1:, :2, 3] = 0.1 * cloud.means[:, 2].abs().mean().nan_to_num() * draw.normal(n_cameras - 1, 2)
    offset = torch.tensor(cloud.offset, dtype=torch.float64)
    means = (cloud.means + offset).float().double()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ offset
    focal = cloud.focal * max(width, height)
    K = torch.tensor([[focal, 0, 0.52 * width], [0, 1.07 * focal, 0.47 * height], [0, 0, 1]], dtype=torch.float64)
    quats = draw.normal(n, 4)
    floats = {
        "means": means,
        "quats": cloud.quat_norm * quats / quats.norm(dim=-1, keepdim=True),
        "scales": cloud.scales,
        "opacities": cloud.opacities,
        "colors": draw.uniform(*([n_cameras] if per_camera else []), n, channels),
        "viewmats": viewmats,
        "Ks": K.repeat(n_cameras, 1, 1),
        "backgrounds": draw.uniform(n_cameras, channels),
    }
    others = {"width": width, "height": height, "render_mode": mode}
    if cloud.eps2d is not None:
        others["eps2d"] = cloud.eps2d
    if sh_degree is not None:
        # As many coefficients as a degree more would have: those beyond `sh_degree` are not read.
        floats["colors"] = 0.3 * draw.normal(*([n_cameras] if per_camera else []), n, (sh_degree + 2) ** 2, 3)
        floats["backgrounds"] = draw.uniform(n_cameras, 3)
        others["sh_degree"] = sh_degree
    floats["opacities"] = without_near_ties(floats["means"], viewmats.float().double(), cloud.opacities)
    bounds = cloud.bounds
    if name in ("telephoto", "equal depths", "duplicates") and "ED" in mode:
        # An expected depth changes by differences of depths: of 1000 m, which float32 holds to 6e-5, or of equal ones.
        bounds = dataclasses.replace(bounds, gradients=5e-3)
    if cloud.covars:
        half = to_matrix(floats.pop("quats")) * floats.pop("scales")[:, None]
        twist = 1e-3 * draw.normal(n, 3, 3)  # of which the antisymmetric part must not count
        floats["covars"] = half @ half.mT + twist - twist.mT
        others |= {"quats": None, "scales": None}
    if cloud.planes:
        others |= {"near_plane": cloud.planes[0], "far_plane": cloud.planes[1]}
    if not has_background:
        del floats["backgrounds"]
    wanted = [key for key in floats if key != "Ks"]
    floors = dict.fromkeys(("means", "quats", "scales", "viewmats"), cloud.no_gradient) | {"alphas": FAINT}
    return Case(name, seed, floats, tuple(wanted), others, bounds, floors)


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
        for place, size, focal, centre in ((x / z, width, K[0, 0], K[0, 2]), (y / z, height, K[1, 1], K[1, 2])):
            for end in (-centre - 0.15 * size, size - centre + 0.15 * size):
                if bool(((place - end / focal).abs() < SAFE).any()):
                    return False
    return True
