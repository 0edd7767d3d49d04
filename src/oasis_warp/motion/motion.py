"""`Motion`, poses at a fixed rate: at other rates, without noise, how much they shake; and angles from rotations."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.core import rotation
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import euler_angles
from oasis_warp.core.types import HandPose

CUTOFF = 6.0
"""Cut-off of the low pass [Hz], the usual one for recorded human movement (Winter, Biomechanics and Motor Control of
Human Movement, 2009, section 3.4.4)."""
ORDER = 2
"""Order of the filter. It runs forwards and backwards, so that nothing lags behind."""


class Motion(NamedTuple):
    """Poses at a fixed rate."""

    angles: Float[Tensor, "T 15 3"]
    """As `HandPose.angles` [rad]."""
    fps: float
    orientations: Float[Tensor, "T 3 3"] | None = None
    """As `HandPose.orientation`, in a world with x right, y down and z forward; None where the wrist is not known."""
    translations: Float[Tensor, "T 3"] | None = None
    """As `HandPose.translation` [m]."""

    def poses(self, still: HandPose) -> list[HandPose]:
        """The pose in every frame, the wrist as in `still`."""
        return [still._replace(angles=angles) for angles in self.angles.to(still.angles)]


def resample(motion: Motion, fps: float) -> Motion:
    """The same motion at another rate, blended between its frames; its last frame is the last shown."""
    last = len(motion.angles) - 1
    count = max(1, round(len(motion.angles) / motion.fps * fps))
    at = (torch.arange(count, dtype=torch.float64) * (motion.fps / fps)).clamp_max(last)
    return at_frames(motion, at)._replace(fps=fps)


def at_frames(motion: Motion, at: Float[Tensor, "N"]) -> Motion:
    """The motion at frames that need not be whole numbers, within its length."""
    before = at.long()
    after, share = (before + 1).clamp_max(len(motion.angles) - 1), (at - before)

    def blend(values: Tensor) -> Tensor:
        return torch.lerp(values[before], values[after], share.to(values).view(-1, *[1] * (values.dim() - 1)))

    rotations = motion.orientations
    return Motion(
        blend(motion.angles),
        motion.fps,
        None if rotations is None else rotation.to_matrix(blend(_smooth_quats(rotations))),
        None if motion.translations is None else blend(motion.translations),
    )


def _smooth_quats(rotations: Float[Tensor, "T 3 3"]) -> Float[Tensor, "T 4"]:
    """Quaternions whose neighbours have the same sign."""
    quats = rotation.from_matrix(rotations)
    flips = torch.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0).to(quats)
    return quats * torch.cat([flips.new_ones(1), flips.cumprod(0)])[:, None]


def smooth(motion: Motion) -> Motion:
    """The motion through a Butterworth low pass at `CUTOFF`, forwards and backwards; short or slow ones stay."""
    if CUTOFF >= motion.fps / 2:
        return motion
    from scipy.signal import butter, sosfiltfilt  # 1 s, which most commands that draw do without

    sections = butter(ORDER, CUTOFF, fs=motion.fps, output="sos")
    length = len(motion.angles)
    reach = min(round(motion.fps), length - 1)

    def filtered(values: Tensor) -> Tensor:
        if reach < 1:
            return values
        passed = sosfiltfilt(sections, values.double().numpy(), axis=0, padlen=reach)
        return torch.from_numpy(np.ascontiguousarray(passed)).to(values)

    rotations, places = motion.orientations, motion.translations
    return motion._replace(
        angles=filtered(motion.angles),
        orientations=None
        if rotations is None
        else rotation.to_matrix(normalize(filtered(_smooth_quats(rotations)), dim=1)),
        translations=None if places is None else filtered(places),
    )


def jitter(points: Float[Tensor, "T P 3"], fps: float) -> float:
    """How much points shake: their mean acceleration [m/s^2], by second differences (Kanazawa et al. 2019)."""
    if len(points) < 3:
        return 0.0
    return float((points[2:] - 2 * points[1:-1] + points[:-2]).norm(dim=-1).mean()) * fps**2


def joint_angles(hand: HandModel, local: Float[Tensor, "T 15 3 3"]) -> Float[Tensor, "T 15 3"]:
    """Flexion, abduction and twist [rad] of bones 1 to 15, each turned by `local` in its parent's frame at rest."""
    axes = hand.pose_axes[1:].to(local)
    return euler_angles(axes @ local @ axes.mT)


def angles_of_bones(hand: HandModel, rotations: Float[Tensor, "T 16 3 3"]) -> Float[Tensor, "T 15 3"]:
    """Joint angles of bones at these world `rotations` from rest, clamped to the joints' limits.

    The bones of another skeleton are not quite ours: what no joint of the model can do is left out.
    """
    local = rotations[:, list(hand.parents[1:])].mT @ rotations[:, 1:]
    low, high = hand.pose_limits[1:].to(local).unbind(-1)
    return torch.minimum(torch.maximum(joint_angles(hand, local), low), high)
