"""The avatar's surface as files of skinned meshes hold it: at rest, on WebXR's joints, in their axes."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import PosedHand
from oasis_warp.export.surface_mesh import Topology, at_mesh, mesh_normals, mesh_points, topology
from oasis_warp.hand.skinning import corrective_coefficients, correctives_per_joint
from oasis_warp.hand.webxr_rig import TO_WEBXR, Rig, webxr_rig
from oasis_warp.hand_avatar import Avatar

INFLUENCES = 8
"""Joints that move a vertex, the stronger ones first; none of the bundled hand's vertices has more than 7."""
MIN_CORRECTIVE = 1e-9
"""Displacement [m] for which a corrective that moves nothing is taken."""


class SkinnedMesh(NamedTuple):
    """A mesh of W vertices in metres, the wrist at the origin, y up, fingers to -z; at rest."""

    hand: HandModel
    """Of the avatar's side, in its own axes."""
    rest: PosedHand
    rig: Rig
    mesh: Topology
    points: Float[Tensor, "W 3"]
    normals: Float[Tensor, "W 3"]
    joints: Int[Tensor, "W I"]
    """Of the rig."""
    weights: Float[Tensor, "W I"]
    correctives: Float[Tensor, "C W 3"]
    """Displacements before skinning, at weight 1 [m]."""
    corrective_names: tuple[str, ...]
    strengths: Float[Tensor, "C"]
    """Coefficients of `hand.skinning.corrective_coefficients` at weight 1."""

    def corrective_weights(self, angles: Float[Tensor, "*B 15 3"]) -> Float[Tensor, "*B C"]:
        """Of the correctives at joint `angles` [rad]; 0 to 1 within the limits of a hand with two for each joint."""
        return corrective_coefficients(self.hand, angles.to(self.strengths)) / self.strengths


@torch.no_grad()
def skinned_mesh(avatar: Avatar) -> SkinnedMesh:
    """The mesh of an avatar."""
    hand, rest = avatar.parts[:2]
    rig, mesh = webxr_rig(hand, rest, avatar.side), topology(avatar)
    to_file = torch.tensor(TO_WEBXR[avatar.side]).to(rest.vertices)
    points = mesh_points(rest.vertices, hand, mesh) @ to_file.T
    joint_of_bone = torch.tensor([rig.bones.index(bone) for bone in range(len(hand.parents))])  # the first, no tip
    strongest = at_mesh(hand.weights, mesh).topk(INFLUENCES, dim=1)
    weights = strongest.values / strongest.values.sum(1, keepdim=True)
    correctives = at_mesh(hand.corrective_basis, mesh).permute(2, 0, 1) @ to_file.T
    whole = correctives_per_joint(hand) == 9
    parts = [f"turn{k}" for k in range(9)] if whole else ("bend", "bend squared")
    if whole:  # rotations may be negative; a metre at weight 1 suits bytes, see skinned_gltf
        strengths = 1 / correctives.abs().amax((1, 2)).clamp_min(MIN_CORRECTIVE)
    else:
        strengths = torch.stack([corrective_coefficients(hand, end) for end in hand.pose_limits[1:].unbind(-1)]).amax(0)
    return SkinnedMesh(
        hand, rest, rig, mesh, points, mesh_normals(points, mesh),
        joints=torch.where(weights > 0, joint_of_bone[strongest.indices], 0),
        weights=weights,
        correctives=correctives * strengths[:, None, None],
        corrective_names=tuple(f"{name} {part}" for name in hand.joint_names[1:] for part in parts),
        strengths=strengths,
    )  # fmt: skip
