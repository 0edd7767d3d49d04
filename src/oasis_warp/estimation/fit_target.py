"""What a photo says about one hand, in the form the fit takes it."""

from dataclasses import dataclass

import numpy as np

from oasis_warp.estimation.landmarks import BONES, box_size
from oasis_warp.hand.kinematics import unit


@dataclass(frozen=True)
class Evidence:
    """What the photo says about one hand, already mirrored into a right one."""

    xy: np.ndarray
    """Landmarks, [21, 2] px."""
    directions: np.ndarray | None
    """Unit directions of the 20 bones in the camera's frame, from the world points."""
    pixels_per_metre: float | None
    """Scale of the world points in the picture."""
    bone_length: float | None
    """Sum of the world bones' lengths [m]."""
    size: tuple[int, int]
    """Width and height of the photo."""
    focal: float | None
    """Focal length where it is known [px]."""

    @property
    def box(self) -> float:
        """Longer side of the landmarks' box [px]."""
        return box_size(self.xy)


def evidence_of(
    xy: np.ndarray, world: np.ndarray | None, size: tuple[int, int], focal: float | None = None
) -> Evidence:
    """Evidence from landmarks [px] and world points [m] of a right hand in a photo of `size` (width, height)."""
    if world is None:
        return Evidence(xy, None, None, None, size, focal)
    bones = world[BONES[:, 1]] - world[BONES[:, 0]]
    length = float(np.linalg.norm(bones, axis=1).sum())
    return Evidence(xy, unit(bones), pixels_per_metre(xy, world), length, size, focal)


def pixels_per_metre(xy: np.ndarray, world: np.ndarray) -> float:
    """Scale of the world points in the picture; foreshortening does not change it."""
    flat, seen = world[:, :2] - world[:, :2].mean(0), xy - xy.mean(0)
    return float(np.sqrt((seen**2).sum() / max((flat**2).sum(), 1e-12)))
