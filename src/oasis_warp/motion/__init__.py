"""Motions of hands, from files of other programs and from recorded videos, as joint angles of the hand model."""

from oasis_warp.motion.motion import Motion, jitter, resample, smooth
from oasis_warp.motion.motion_file import read_motion

__all__ = ["Motion", "jitter", "read_motion", "resample", "smooth"]
