"""What a writer is asked for."""

from typing import Literal, NamedTuple

from oasis_warp.core.types import HandPose, Photo
from oasis_warp.hand_avatar import Avatar

Light = Literal["baked", "none"]


class ExportRequest(NamedTuple):
    """An avatar, and how it is to look in the file."""

    avatar: Avatar
    """In its own light."""
    pose: HandPose | None = None
    """None: what suits the format, see docs/export.md."""
    light: Light | None = None
    """"baked": colours as the avatar is drawn in its light; "none": as in even light, for engines that light it.
    None: "baked" for Gaussians, "none" for meshes."""
    photo: Photo | None = None
    """To show beside the hand, where a format has a place for it."""
