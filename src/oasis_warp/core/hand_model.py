"""`HandModel`: the skinned, shape-adjustable surface that every stage shares. Data only; `oasis_warp.hand` loads it."""

from dataclasses import dataclass, fields, replace
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

PALM_SIDE, BACK_SIDE, FLANK_SIDE = 0, 1, 2
"""Values of `HandModel.region`."""

TIP_JOINTS = (15, 3, 6, 12, 9)
"""Last joints of thumb, index, middle, ring and little finger, whose bones end at the tips."""
KNUCKLES = [5, 9, 13, 17]
"""Rows of the 21 landmarks that are the knuckles of index, middle, ring and little finger."""


MANO_SHAPES = 10
"""Shape coefficients of MANO's files."""

Joints = TypeVar("Joints", int, np.ndarray, Tensor)


class ModelOrigin(NamedTuple):
    """How another hand was brought into the triangulation of the bundled one; float64 on the CPU."""

    rest_angles: Float[Tensor, "16 3"]
    """Angles of the bundled hand whose bones point as this one's at rest [rad]."""
    landmark_offsets: Float[Tensor, "21 3"]
    """From `keypoint_index`'s joints and tips at rest to where the landmark network sees them [m]."""
    wrist: Float[Tensor, "3"]
    """Where its own files have the wrist, which is the origin here [m]."""


@dataclass(frozen=True)
class HandModel:
    """A right hand at rest: metres, wrist at the origin, fingers to -x, palm to -y, thumb to +z.

    Joints follow MANO: wrist, then three each of index, middle, little, ring, thumb.
    """

    name: str
    template: Float[Tensor, "V 3"]
    """Vertices of the mean hand [m]."""
    faces: Int[Tensor, "F 3"]
    """Corners, counter-clockwise seen from outside; the surface is open at the wrist."""
    weights: Float[Tensor, "V 16"]
    """Skinning weights; rows sum to one."""
    shape_basis: Float[Tensor, "V 3 S"]
    """Vertex displacement per standard deviation of each shape coefficient [m]."""
    shape_names: tuple[str, ...]
    joints: Float[Tensor, "16 3"]
    joint_basis: Float[Tensor, "16 3 S"]
    tips: Float[Tensor, "5 3"]
    """Ends of the distal bones, thumb to little [m]."""
    tip_basis: Float[Tensor, "5 3 S"]
    parents: tuple[int, ...]
    """Parent joint of each joint; -1 for the wrist."""
    joint_names: tuple[str, ...]
    pose_axes: Float[Tensor, "16 3 3"]
    """Rows: unit axes of flexion (positive closes), abduction (positive to the thumb) and twist."""
    pose_limits: Float[Tensor, "16 3 2"]
    """Lowest and highest angle about each axis, relative to rest [rad]."""
    rest_bend: Float[Tensor, "16"]
    """Flexion that the rest pose already has [rad]: anatomical angle = angle + rest_bend."""
    keypoint_index: Int[Tensor, "21"]
    """Rows of concat(joints, tips) that are the 21 landmarks, in landmark order."""
    corrective_basis: Float[Tensor, "V 3 C"]
    """Displacement of the rest surface by each pose corrective at full strength [m]; C is 0, 30 or 135."""
    uv: Float[Tensor, "U 2"]
    uv_faces: Int[Tensor, "F 3"]
    rim: Int[Tensor, "R"]
    """Vertices of the open wrist, in order."""
    segment: Int[Tensor, "V"]
    """Joint with the largest weight."""
    region: Int[Tensor, "V"]
    """0 palm, 1 back, 2 flank."""
    bone_t: Float[Tensor, "V"]
    """Position along the bone of `segment`: 0 at the joint, 1 at the next."""
    bone_theta: Float[Tensor, "V"]
    """Angle of the normal about that bone [rad]: 0 back, +-pi palm."""
    nail: Float[Tensor, "V"]
    """1 on a nail, 0 off it."""
    licence: str
    origin: ModelOrigin | None = None
    """None for the bundled hand."""

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "HandModel":
        """The same hand on another device, its real numbers in another precision; indices stay int64."""
        moved = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                there = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
                if there is not value:
                    moved[field.name] = there
        return replace(self, **moved) if moved else self  # what is kept of a model is found again


def finger_of(joint: Joints) -> Joints:
    """The finger of a joint, or of the bone that it moves: 1 to 5 in the order of joints, 0 for the palm."""
    return (joint + 2) // 3
