"""Pinhole projection."""

from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.types import Camera


def project(camera: Camera, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N"]]:
    """Pixel coordinates and camera depths [m] of world points; points must lie in front of the camera."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    image = local @ camera.K.T
    return image[:, :2] / image[:, 2:], local[:, 2]
