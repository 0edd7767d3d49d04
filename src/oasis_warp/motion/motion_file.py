"""Read motions: JSON and npz with joint angles, MANO's parameters or tracked joints, BVH, and videos.

Hands as WebXR and OpenXR track them are the place and direction of 25 joints, or 26 with the palm. MANO's parameters
are axis-angles, rotation matrices, or coefficients of principal components. Its hands lie as ours at rest, have the
same joints in the same order, and turn about the same points; rotations count from MANO's mean hand, which is taken for
our rest pose.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.mirror import mirror_hand, mirror_points
from oasis_warp.core.pickle_reader import read_npz
from oasis_warp.core.types import PosedHand, Side
from oasis_warp.hand import mano
from oasis_warp.hand.template import MANO_DIR
from oasis_warp.hand.webxr_rig import TO_WEBXR, webxr_rig
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion.bvh import hand_angles, read_bvh
from oasis_warp.motion.motion import Motion, angles_of_bones, joint_angles

N_JOINTS = 25
"""Joints of WebXR (www.w3.org/TR/webxr-hand-input-1, XRHandJoint); OpenXR's XrHandJointEXT has the palm before them."""
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
        side: Side of the hand that was tracked.
        quats: Directions of the joints in the room, x, y, z, w as WebXR and OpenXR write them, [T, 25 or 26, 4].
        places: Places of the joints in the room [m], [T, 25 or 26, 3].

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
    rotations = torch.stack([of_joints[:, rig.bones.index(bone)] for bone in range(16)], 1)
    to_world = torch.diag(bind.new_tensor(HALF_TURN))
    wrist = to_world @ room[:, 0] @ bind[0].T @ to_file
    angles = angles_of_bones(hand, rotations)
    if places is None:
        return angles, wrist, None
    at = places[:, -N_JOINTS] @ to_world
    return angles, wrist, at - (wrist @ rest.joints[0].double())


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
        side: Side of the hand that the parameters describe.
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
    if not pose.numel():
        raise ValueError("one frame or more is expected")
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


VIDEO_SUFFIXES = (".mp4", ".mov", ".webm", ".mkv", ".avi")
MOTION_SUFFIXES = (".json", ".npz", ".bvh", *VIDEO_SUFFIXES)
USUAL_FPS = 30.0
MAX_FRAMES = 100_000
MAX_BYTES = 1 << 28
"""Largest file with motions: hours of one."""
LARGEST_ANGLE = 2 * np.pi
"""Beyond it angles are degrees, taken for radians."""
TRACKED = ("orientations", "positions")
READ = {"angles", "fps", "side", *KEYS, *TRACKED}


def read_motion(path: Path | str, avatar: Avatar, *, progress: Progress = silent) -> Motion:
    """The motion of a file for a hand; docs/viewing.md lists what files may hold.

    Args:
        path: File; its ending says what it is.
        avatar: Who will move so: its side says which of two hands is read, and its bones lie where tracked ones do.
        progress: Called as a video is read.

    Raises:
        InputError: no such file, not a motion, or a video that shows no such hand.
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in MOTION_SUFFIXES:
        raise InputError(f"{path}: expected a motion in {', '.join(MOTION_SUFFIXES)}; rename or convert the file.")
    if kind in VIDEO_SUFFIXES:
        from oasis_warp.motion.recording import follow_video  # with the estimator's networks, which nothing else needs

        return follow_video(path, avatar, progress=progress)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: cannot be read (a folder, a device or a pipe); give a file.")
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise InputError(f"{path}: expected at most {MAX_BYTES >> 20} MB, got {size >> 20} MB; cut the file.")
        if kind == ".bvh":
            skeleton = read_bvh(path.read_text(encoding="utf-8", errors="replace"))
            motion = Motion(hand_angles(*avatar.parts[:2], skeleton, avatar.side), skeleton.fps)
        else:
            motion = _from_numbers(_read_json(path) if kind == ".json" else read_npz(path, READ), avatar)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: not a motion ({_first_line(error)}); see docs/viewing.md for what is.") from error
    return _checked(path, motion)


def _checked(path: Path, motion: Motion) -> Motion:
    """The motion in single precision.

    Raises:
        InputError: it is empty, too long, too fast, or not finite.
    """
    angles, fps = motion.angles, motion.fps
    if angles.dim() != 3 or angles.shape[1:] != (15, 3) or not 1 <= len(angles) <= MAX_FRAMES:
        raise InputError(f"{path}: expected angles of shape [T, 15, 3], got {list(angles.shape)}; change the file.")
    if not bool(angles.isfinite().all()) or float(angles.abs().max()) > LARGEST_ANGLE:
        raise InputError(f"{path}: expected angles in radians, up to {LARGEST_ANGLE:.2f}; change the file.")
    if not 1 <= fps <= 1000:
        raise InputError(f"{path}: expected 1 to 1000 frames a second, got {fps:g}; change its `fps`.")
    for name, part, size in (("orientation", motion.orientations, (3, 3)), ("place", motion.translations, (3,))):
        if part is not None and (part.shape != (len(angles), *size) or not bool(part.isfinite().all())):
            raise InputError(f"{path}: expected a finite {name} of the wrist for each of {len(angles)} frames; add it.")
    return Motion(*(part.float() if isinstance(part, Tensor) else part for part in motion))


def _from_numbers(stored: dict[str, Any], avatar: Avatar) -> Motion:
    """The motion of a file's parts.

    Raises:
        ValueError, TypeError: they are none.
    """
    stored = stored[avatar.side] | {"side": avatar.side} if isinstance(stored.get(avatar.side), dict) else stored
    side = str(stored.get("side", avatar.side))
    if side not in ("left", "right"):
        raise ValueError(f"the side left or right is expected, not {shortened(side)}")
    if isinstance(stored.get("as_mano"), dict):  # of `oasis export -o hand.json`
        stored = stored["as_mano"]

    def get(*names: str) -> Tensor | None:
        name = next((name for name in names if stored.get(name) is not None), None)
        return None if name is None else torch.from_numpy(np.asarray(stored[name], dtype=np.float64))

    fps, hand, rest = get("fps"), *_sided(avatar, side)
    rate = USUAL_FPS if fps is None else float(fps)
    if (angles := get("angles")) is not None:
        return Motion(angles, rate, get(*GLOBALS), get(*PLACES))
    if get(*POSES) is not None:
        ours = "rest_joints" in stored and "betas" not in stored  # of `oasis export` with the bundled hand
        angles, wrist, places = read_mano(get, hand, rest, side, ours=ours)
        return Motion(angles, rate, wrist, places)
    if (quats := get("orientations")) is not None:
        angles, wrist, places = read_tracked(hand, rest, side, quats, get("positions"))
        return Motion(angles, rate, wrist, places)
    raise ValueError("`angles`, `hand_pose` or `orientations` are expected in it")


def _sided(avatar: Avatar, side: Side):
    hand, rest = avatar.parts[:2]
    if side == avatar.side:
        return hand, rest
    return mirror_hand(hand), PosedHand(*map(mirror_points, rest))


def _first_line(error: Exception) -> str:
    return shortened(str(error).splitlines()[0], 150) if str(error) else type(error).__name__


def _read_json(path: Path) -> dict[str, Any]:
    stored = json.loads(path.read_bytes())
    if not isinstance(stored, dict):
        raise ValueError(f"a JSON object, not a {type(stored).__name__}, is wanted")
    return stored
