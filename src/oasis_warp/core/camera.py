"""Pinhole cameras: projection, crops, mirror images, and orbits around a posed hand."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.types import Camera


def project(camera: Camera, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N"]]:
    """Pixel coordinates and camera depths [m] of world points; points must lie in front of the camera."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    image = local @ camera.K.T
    return image[:, :2] / image[:, 2:], local[:, 2]


def camera_center(viewmat: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 3"]:
    """Where in the world the camera is [m]."""
    return -(viewmat[..., :3, :3].mT @ viewmat[..., :3, 3:])[..., 0]


ORBIT_FIELD_OF_VIEW = math.radians(30)
ORBIT_MARGIN = 1.08
"""Distance of the camera, in units of the distance at which the hand's bounding sphere just fills the picture."""
LEAST_IN_PICTURE = 0.1
"""Sine of the least angle between the view and an up direction that can be followed."""


def crop_camera(camera: Camera, left: float, top: float, side: float, size: int) -> Camera:
    """The camera of the square that starts at (`left`, `top`) [px], `side` wide, resampled to `size` pixels."""
    scale = size / side
    K = camera.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    K[:2] *= scale
    return Camera(camera.viewmat, K, size, size)


def orbit_camera(
    vertices: Float[Tensor, "V 3"],
    azimuth: float,
    elevation: float = 0.0,
    size: int = 256,
    *,
    up: Float[Tensor, "3"] | None = None,
) -> Camera:
    """A camera that looks at the middle of `vertices` from any side and frames all of them.

    At `azimuth` 0 and `elevation` 0 [rad] it looks along the world's z axis with y down, as the camera of a fitted
    photo does; a growing azimuth moves it to the left around the hand, a growing elevation above it. Left and above
    are those of somebody who holds their head so that `up` points up.

    Args:
        vertices: What to look at [m].
        azimuth: Angle around the part of `up` that lies in the picture [rad].
        elevation: Angle above [rad].
        size: Side of the picture [px].
        up: A direction of any length, such as that from the arm to the fingers; up in the picture if it is None or
            points almost along the view.
    """
    center = (vertices.amin(0) + vertices.amax(0)) / 2
    radius = (vertices - center).norm(dim=-1).amax()
    ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
    pan = torch.tensor([[ca, 0, sa], [0, 1, 0], [-sa, 0, ca]], dtype=torch.float64)
    tilt = torch.tensor([[1, 0, 0], [0, ce, se], [0, -se, ce]], dtype=torch.float64)
    roll = _roll_to(up)
    axes = (roll @ pan @ tilt @ roll.T).to(vertices)  # columns: the camera's x, y, z in the world
    position = center - axes[:, 2] * radius * (ORBIT_MARGIN / math.sin(ORBIT_FIELD_OF_VIEW / 2))
    viewmat = torch.eye(4, dtype=vertices.dtype, device=vertices.device)
    viewmat[:3, :3] = axes.T
    viewmat[:3, 3] = -axes.T @ position
    focal = size / 2 / math.tan(ORBIT_FIELD_OF_VIEW / 2)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=vertices.dtype)
    return Camera(viewmat, K.to(vertices.device), size, size)


def _roll_to(up: Float[Tensor, "3"] | None) -> Float[Tensor, "3 3"]:
    """The rotation in the picture that turns its up to that of `up`."""
    x, y, z = (0.0, -1.0, 0.0) if up is None else up.tolist()
    in_picture = math.hypot(x, y)
    if in_picture <= LEAST_IN_PICTURE * math.hypot(x, y, z):
        return torch.eye(3, dtype=torch.float64)
    c, s = -y / in_picture, x / in_picture
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
