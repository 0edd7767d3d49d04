"""Avatars of fits, and their pictures beside the photo."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.config import BLACK
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit, HandLight, HandPose, Render
from oasis_warp.hand_avatar import Avatar


def make_avatar(
    fit: HandFit,
    offsets: Float[Tensor, "V 3"],
    crop: HandCrop,
    gaussians: CanonicalGaussians,
    light: HandLight | None = None,
    invented: Float[Tensor, "V"] | None = None,
    *,
    hand: HandModel | None = None,
) -> Avatar:
    """The hand of `fit` with the looks of `gaussians` in `light`; `offsets` and `crop` are those of its making.

    `hand` is the model of the fit, the bundled one by default.
    """
    return Avatar(
        side=fit.side,
        shape=fit.shape.to(crop.image),
        surface_offsets=offsets.to(crop.image),
        gaussians=gaussians,
        source_pose=fit.pose,
        source_camera=mirror_camera(crop.camera) if fit.side == "left" else crop.camera,
        light=light,
        invented=invented,
        hand=hand,
    )


@torch.no_grad()
def draw_as_photo(avatar: Avatar, crop: HandCrop, pose: HandPose) -> Render:
    """`avatar` in the `pose` and camera of a photo, over black; a left hand is mirrored, as in its crop."""
    left = avatar.side == "left"
    drawn = avatar.render(mirror_camera(crop.camera) if left else crop.camera, pose, BLACK)
    return Render(drawn.image.flip(1), drawn.alpha.flip(1)) if left else drawn
