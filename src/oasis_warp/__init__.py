"""One photo of a hand in, an animatable 3D Gaussian avatar out."""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from oasis_warp.avatar.sky import environment_light as environment_light
    from oasis_warp.avatar.sky import studio_light as studio_light
    from oasis_warp.core.config import EditConfig as EditConfig
    from oasis_warp.core.config import ReconstructConfig as ReconstructConfig
    from oasis_warp.core.errors import InputError as InputError
    from oasis_warp.core.types import Camera as Camera
    from oasis_warp.core.types import Gaussians as Gaussians
    from oasis_warp.core.types import HandPose as HandPose
    from oasis_warp.core.types import Photo as Photo
    from oasis_warp.data.environment_map import read_environment as read_environment
    from oasis_warp.data.photo import read_photo as read_photo
    from oasis_warp.editing import edit as edit
    from oasis_warp.hand_avatar import Avatar as Avatar
    from oasis_warp.ops import depth_map as depth_map
    from oasis_warp.ops import depth_visibility as depth_visibility
    from oasis_warp.ops import face_rotations as face_rotations
    from oasis_warp.ops import pose_on_mesh as pose_on_mesh
    from oasis_warp.ops import pose_on_mesh_covars as pose_on_mesh_covars
    from oasis_warp.ops import rasterization as rasterization
    from oasis_warp.ops import skin as skin
    from oasis_warp.ops import spherical_harmonics as spherical_harmonics
    from oasis_warp.reconstruction import reconstruct as reconstruct
    from oasis_warp.reconstruction import reconstruct_same_hand as reconstruct_same_hand

# A name is imported when it is first used: torch and Warp take seconds, and `oasis --help` needs neither.
_HOMES = {
    "Avatar": "hand_avatar",
    "Camera": "core.types",
    "EditConfig": "core.config",
    "Gaussians": "core.types",
    "HandPose": "core.types",
    "InputError": "core.errors",
    "Photo": "core.types",
    "ReconstructConfig": "core.config",
    "depth_map": "ops",
    "depth_visibility": "ops",
    "edit": "editing",
    "environment_light": "avatar.sky",
    "face_rotations": "ops",
    "pose_on_mesh": "ops",
    "pose_on_mesh_covars": "ops",
    "rasterization": "ops",
    "read_environment": "data.environment_map",
    "read_photo": "data.photo",
    "reconstruct": "reconstruction",
    "reconstruct_same_hand": "reconstruction",
    "skin": "ops",
    "spherical_harmonics": "ops",
    "studio_light": "avatar.sky",
}
__all__ = [
    "Avatar", "Camera", "EditConfig", "Gaussians", "HandPose", "InputError", "Photo", "ReconstructConfig", "depth_map",
    "depth_visibility", "edit", "environment_light", "face_rotations", "pose_on_mesh", "pose_on_mesh_covars",
    "rasterization", "read_environment", "read_photo", "reconstruct", "reconstruct_same_hand", "skin",
    "spherical_harmonics", "studio_light",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
