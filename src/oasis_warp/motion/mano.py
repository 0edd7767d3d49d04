"""MANO's parameters as motions: axis-angles, rotation matrices, or coefficients of principal components.

MANO's hands lie as ours at rest, have the same joints in the same order, and turn about the same points. Rotations
count from MANO's mean hand, which is taken for our rest pose.
"""

import os
from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_points
from oasis_warp.core.types import PosedHand, Side
from oasis_warp.hand import mano
from oasis_warp.hand.template import MANO_DIR
from oasis_warp.motion.motion import joint_angles

POSES, GLOBALS, PLACES = ("hand_pose", "poses", "pose", "thetas"), ("global_orient", "root_orient"), ("transl", "trans")
"""Names that files have for the rotations of the fingers, also with the wrist's before them, of the wrist, and for
where the hand is."""
COMPONENTS, MEAN = ("hands_components", "components"), ("hands_mean", "mean")
KEYS = (*POSES, *GLOBALS, *PLACES, *COMPONENTS, *MEAN)
WRIST = (0.0957, 0.0064, 0.0062)
"""Where the file of MANO's right hand has the mean wrist, about which `global_orient` turns [m]."""

Get = Callable[..., Tensor | None]
"""Gives the first of some keys that a file has, as float64."""


def read_mano(
    get: Get, hand: HandModel, rest: PosedHand, side: Side, *, ours: bool
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Angles, orientations and translations, as `Motion` has them.

    Args:
        get: The file's parts.
        hand: The model of the file's `side`.
        rest: Its shape at rest.
        side: Of the hand that the parameters describe.
        ours: Whether `transl` is that of our frame, about whose origin the wrist turns, and not that of smplx.

    Raises:
        InputError: coefficients of components need the user's files of MANO, and those cannot be read.
        ValueError: a part has another shape.
    """
    pose, wrist, places = get(*POSES), get(*GLOBALS), get(*PLACES)
    assert pose is not None, "the caller has looked"
    components = get(*COMPONENTS)
    pose = pose[None] if pose.shape in ((45,), (48,), (15, 3), (15, 3, 3)) else pose
    frames = len(pose)
    if pose.shape[1:] != (15, 3, 3):
        pose = pose.reshape(frames, -1)
        if pose.shape[1] == 48:
            wrist, pose = pose[:, :3] if wrist is None else wrist, pose[:, 3:]
        mean = get(*MEAN)
        if components is None and pose.shape[1] < 45 and (folder := os.environ.get(MANO_DIR)):
            model = mano.read_mano(folder, side)
            components = torch.from_numpy(model.pose_components)
            mean = torch.from_numpy(model.pose_mean) if mean is None else mean
        if components is not None:
            if components.dim() != 2 or components.shape[1] != 45 or len(components) < pose.shape[1]:
                raise ValueError(f"components [N, 45] for {pose.shape[1]} coefficients are expected")
            pose = pose @ components[: pose.shape[1]]
        if pose.shape[1] != 45:
            hint = f"; coefficients need `hands_components`, or MANO's files in {MANO_DIR}" * (pose.shape[1] < 45)
            raise ValueError(f"45 numbers a frame are expected, not {pose.shape[1]}{hint}")
        if mean is not None and mean.numel() != 45:
            raise ValueError(f"a mean of 45 numbers is expected, not {mean.numel()}")
        pose = rotation.from_vector((pose if mean is None else pose + mean.reshape(-1)).view(frames, 15, 3))
    for name, part, sizes in ((GLOBALS[0], wrist, (3, 9)), (PLACES[0], places, (3,))):
        if part is not None and part.numel() not in [size * frames for size in sizes]:
            raise ValueError(f"`{name}` for each of {frames} frames is expected, not of shape {list(part.shape)}")
    if wrist is not None:
        wrist = wrist.reshape(-1, 3, 3) if wrist.numel() == 9 * frames else rotation.from_vector(wrist.reshape(-1, 3))
    if places is not None:
        places = places.reshape(-1, 3)
        if not ours and wrist is not None:
            places = places + _wrist(hand, rest, side) - wrist @ rest.joints[0].double()
    return joint_angles(hand, pose), wrist, places


def _wrist(hand: HandModel, rest: PosedHand, side: Side) -> Tensor:
    """Where MANO has the wrist at rest: of an avatar that was made with MANO its own, else that of the mean hand."""
    at, moved = torch.tensor(WRIST, dtype=torch.float64), 0.0
    if hand.origin is not None:  # of the right hand; the shape moves it
        at, moved = hand.origin.wrist.double(), rest.joints[0].double()
    return (mirror_points(at) if side == "left" else at) + moved
