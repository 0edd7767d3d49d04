"""Read motions: JSON and npz with joint angles, MANO's parameters or tracked joints, BVH, and videos."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.mirror import mirror_hand, mirror_points
from oasis_warp.core.types import PosedHand, Side
from oasis_warp.hand_avatar import Avatar
from oasis_warp.motion.bvh import hand_angles, read_bvh
from oasis_warp.motion.mano import GLOBALS, KEYS, PLACES, POSES, read_mano
from oasis_warp.motion.motion import Motion
from oasis_warp.motion.tracked_joints import read_tracked

VIDEO_SUFFIXES = (".mp4", ".mov", ".webm", ".mkv", ".avi")
MOTION_SUFFIXES = (".json", ".npz", ".bvh", *VIDEO_SUFFIXES)
USUAL_FPS = 30.0
MOST_FRAMES = 100_000
MOST_BYTES = 1 << 28
"""Of a file with motions: hours of one."""
LARGEST_ANGLE = 2 * np.pi
"""Beyond it angles are degrees, taken for radians."""
TRACKED = ("orientations", "positions")
READ = {"angles", "fps", "side", *KEYS, *TRACKED}


def read_motion(path: Path | str, avatar: Avatar, *, progress: Progress = silent) -> Motion:
    """The motion of a file for a hand; docs/viewing.md lists what files may hold.

    Args:
        path: File; its ending says what it is.
        avatar: Who will move so: its side says which of two hands is read, and its bones lie where tracked ones do.
        progress: Of a video.

    Raises:
        InputError: no such file, not a motion, or a video that shows no such hand.
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in MOTION_SUFFIXES:
        raise InputError(f"{path}: expected a motion in {', '.join(MOTION_SUFFIXES)}; rename or convert the file.")
    if kind in VIDEO_SUFFIXES:
        from oasis_warp.motion.recording import follow_video  # with the estimator's networks, which nothing else needs

        return follow_video(path, avatar, progress=progress)
    try:
        if (size := path.stat().st_size) > MOST_BYTES:
            raise InputError(f"{path}: expected at most {MOST_BYTES >> 20} MB, got {size >> 20} MB; cut the file.")
        if kind == ".bvh":
            skeleton = read_bvh(path.read_text(encoding="utf-8", errors="replace"))
            motion = Motion(hand_angles(*avatar.parts[:2], skeleton, avatar.side), skeleton.fps)
        else:
            motion = _from_numbers(_read_json(path) if kind == ".json" else _read_npz(path), avatar)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, zipfile.BadZipFile, RecursionError, OverflowError, EOFError) as error:
        raise InputError(f"{path}: not a motion ({_first_line(error)}); see docs/viewing.md for what is.") from error
    return _checked(path, motion)


def _checked(path: Path, motion: Motion) -> Motion:
    """The motion in single precision.

    Raises:
        InputError: it is empty, too long, too fast, or not finite.
    """
    angles, fps = motion.angles, motion.fps
    if angles.dim() != 3 or angles.shape[1:] != (15, 3) or not 1 <= len(angles) <= MOST_FRAMES:
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


def _read_npz(path: Path) -> dict[str, Any]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        return {name: stored[name] for name in READ & set(stored.files)}
