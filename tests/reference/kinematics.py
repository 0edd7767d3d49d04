"""Bone transforms joint by joint in torch: the twin of `ops.bone_transforms`."""

import torch
from torch import Tensor

from oasis_warp.core.rotation import from_axis_angle


def joint_rotations(angles: Tensor, axes: Tensor) -> Tensor:
    """Local rotations of all joints, the first one's the identity: the matrix product flexion @ abduction @ twist."""
    flexion, abduction, twist = (from_axis_angle(axes[1:, k], angles[:, k]) for k in range(3))
    first = torch.eye(3, dtype=angles.dtype, device=angles.device)[None]
    return torch.cat([first, flexion @ abduction @ twist])


def bone_transforms(angles: Tensor, orientation: Tensor, translation: Tensor, joints: Tensor, axes: Tensor, parents):
    """Transforms [J, 3, 4] and bends [2 (J - 1)] of one pose."""
    local = joint_rotations(angles, axes)
    rotations, origins = [orientation], [orientation @ joints[0] + translation]
    for j in range(1, len(parents)):
        parent = parents[j]
        rotations.append(rotations[parent] @ local[j])
        origins.append(rotations[parent] @ (joints[j] - joints[parent]) + origins[parent])
    rotation = torch.stack(rotations)
    shift = torch.stack(origins) - (rotation @ joints[..., None])[..., 0]
    c = 1 - torch.cos(angles[:, 0])
    return torch.cat([rotation, shift[..., None]], -1), torch.stack([c, c * c], -1).flatten()
