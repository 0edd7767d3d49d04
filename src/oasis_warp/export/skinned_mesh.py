"""The avatar's surface as files of skinned meshes hold it: at rest, on WebXR's joints, in their axes."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import PosedHand
from oasis_warp.export.surface_mesh import Topology, at_mesh, mesh_normals, mesh_points, topology
from oasis_warp.hand.skinning import correctives_per_joint
from oasis_warp.hand.webxr_rig import TO_WEBXR, Rig, webxr_rig
from oasis_warp.hand_avatar import Avatar

INFLUENCES = 8
"""Joints that move a vertex, the stronger ones first; none of the bundled hand's vertices has more than 7."""


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
    """Displacements before skinning, at full strength [m]."""
    corrective_names: tuple[str, ...]


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
    parts = ("bend", "bend squared") if correctives_per_joint(hand) == 2 else [f"turn{k}" for k in range(9)]
    return SkinnedMesh(
        hand, rest, rig, mesh, points, mesh_normals(points, mesh),
        joints=torch.where(weights > 0, joint_of_bone[strongest.indices], 0),
        weights=weights,
        correctives=at_mesh(hand.corrective_basis, mesh).permute(2, 0, 1) @ to_file.T,
        corrective_names=tuple(f"{name} {part}" for name in hand.joint_names[1:] for part in parts),
    )  # fmt: skip
