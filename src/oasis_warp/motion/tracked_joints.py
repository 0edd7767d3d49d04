"""Hands as WebXR and OpenXR track them: the place and direction of 25 joints, or 26 with the palm."""

import torch
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import PosedHand, Side
from oasis_warp.hand.webxr_rig import TO_WEBXR, webxr_rig
from oasis_warp.motion.motion import angles_of_bones

N_JOINTS = 25
"""Of WebXR (www.w3.org/TR/webxr-hand-input-1, XRHandJoint); OpenXR's XrHandJointEXT has the palm before them."""
HALF_TURN = (1.0, -1.0, -1.0)
"""Diagonal of the turn from y up and z to the viewer to y down and z forward."""


def read_tracked(
    hand: HandModel, rest: PosedHand, side: Side, quats: Tensor, places: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Angles, orientations and translations, as `Motion` has them.

    Directions alone make the angles: those of the joints against the wrist's. So bones of another length do not matter.

    Args:
        hand: The model of this `side`.
        rest: Its shape at rest.
        side: Of the hand that was tracked.
        quats: Directions of the joints in the room, x, y, z, w as WebXR and OpenXR write them, [T, 25 or 26, 4].
        places: Of the joints in the room [m], [T, 25 or 26, 3].

    Raises:
        ValueError: another shape.
    """
    for name, part, size in (("orientations", quats, 4), ("positions", places, 3)):
        if part is not None and (part.dim() != 3 or part.shape[1] not in (25, 26) or part.shape[2] != size):
            raise ValueError(f"{name} of shape [T, 25 or 26, {size}] are expected, not {list(part.shape)}")
    if places is not None and len(places) != len(quats):
        raise ValueError(f"as many positions as orientations are expected, not {len(places)} for {len(quats)}")
    if bool((quats.norm(dim=-1) < 1e-6).any()):
        raise ValueError("orientations that are not zero are expected; leave out frames that were not tracked")
    room = rotation.to_matrix(quats[..., [3, 0, 1, 2]])[:, -N_JOINTS:]
    rig = webxr_rig(hand, rest, side)
    bind, to_file = rig.bind[:, :3, :3].double(), torch.tensor(TO_WEBXR[side]).double()
    posed = bind[0] @ room[:, :1].mT @ room  # as if the wrist were at rest
    of_joints = to_file.T @ posed @ bind.mT @ to_file
    turns = torch.stack([of_joints[:, rig.bones.index(bone)] for bone in range(16)], 1)
    to_world = torch.diag(bind.new_tensor(HALF_TURN))
    wrist = to_world @ room[:, 0] @ bind[0].T @ to_file
    angles = angles_of_bones(hand, turns)
    if places is None:
        return angles, wrist, None
    at = places[:, -N_JOINTS] @ to_world
    return angles, wrist, at - (wrist @ rest.joints[0].double())
