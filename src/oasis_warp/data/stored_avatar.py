"""What an avatar file holds: the nouns of an avatar as named tensors and a header, and back."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, CanonicalGaussians, HandLight, HandPose, Side


class StoredAvatar(NamedTuple):
    """An avatar without its hand model; `hand_avatar.Avatar` explains each part."""

    side: Side
    shape: Float[Tensor, "S"]
    surface_offsets: Float[Tensor, "V 3"]
    gaussians: CanonicalGaussians
    source_pose: HandPose
    source_camera: Camera
    light: HandLight | None
    invented: Float[Tensor, "V"] | None


def to_tensors(avatar: StoredAvatar) -> dict[str, Tensor]:
    """The tensors by their names in the file."""
    camera = avatar.source_camera
    single = {"shape": avatar.shape, "surface_offsets": avatar.surface_offsets, "invented": avatar.invented}
    grouped = {
        "gaussians": avatar.gaussians._asdict(),
        "source_pose": avatar.source_pose._asdict(),
        "source_camera": {"viewmat": camera.viewmat, "K": camera.K},
        "light": {} if avatar.light is None else avatar.light._asdict(),
    }
    named = single | {f"{group}.{name}": value for group, parts in grouped.items() for name, value in parts.items()}
    return {name: value for name, value in named.items() if value is not None}


def to_header(avatar: StoredAvatar, hand: HandModel) -> dict[str, Any]:
    """The header's keys that differ between avatars."""
    camera = avatar.source_camera
    return {
        "side": avatar.side,
        "hand_model": hand.name,
        "hand_licence": hand.licence,
        "source_camera": {"width": camera.width, "height": camera.height},
    }


def from_file(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> StoredAvatar:
    """The inverse of `to_tensors` and `to_header`."""

    def group(prefix: str) -> dict[str, Tensor]:
        return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}

    return StoredAvatar(
        side=header["side"],
        shape=tensors["shape"],
        surface_offsets=tensors["surface_offsets"],
        gaussians=CanonicalGaussians(**group("gaussians.")),
        source_pose=HandPose(**group("source_pose.")),
        source_camera=Camera(**group("source_camera."), **header["source_camera"]),
        light=HandLight(**light) if (light := group("light.")) else None,
        invented=tensors.get("invented"),
    )
