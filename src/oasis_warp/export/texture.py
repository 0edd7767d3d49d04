"""The avatar's colours as a texture of its mesh."""

from typing import cast

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from oasis_warp.core import rotation
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.data.pictures import to_uint8
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import check_finite
from oasis_warp.export.surface_mesh import CAP_CORNER, rim_cap_center
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map

SIZE = 1024
"""Side of the texture [px]: a pixel is .33 mm of skin, as wide as the standard deviations of detailed Gaussians."""
NEAREST = 16
"""Gaussians that a pixel is mixed of, the nearest ones: half a step of 255 from what four times as many give."""
POINTS = 1 << 14
"""Pixels that are mixed at a time, so that memory stays below 100 MB."""
MARGIN = 16
"""Width of the seam around the charts that has their colours [px], for four halvings of the texture."""


@torch.no_grad()
def bake_texture(request: ExportRequest, light: str, size: int) -> UInt8[Tensor, "S S 3"]:
    """Colours of the skin at every pixel of the texture, sRGB; the first row is v = 1.

    A pixel is the mean of the Gaussians around it, weighted by their opacity and their density there at rest: what one
    sees who looks at the skin from everywhere.

    Args:
        request: Whose skin, and in what pose light falls on it.
        light: "baked" or "none".
        size: Side [px].

    Raises:
        InputError: a value is not finite.
    """
    avatar = request.avatar
    skin = avatar.gaussians
    if light == "none":
        colors = avatar.in_even_light().gaussians.colors
    else:
        colors = avatar.pose(request.pose or avatar.source_pose).colors
    check_finite((skin.scales, skin.quats, skin.opacities, colors))
    points, inside = texel_points(avatar, size)
    mixed = Mixture(skin, avatar.rest.vertices, avatar.hand.faces, colors)
    picture = mixed(rim_cap_center(avatar.hand, avatar.rest.vertices)[0][None]).expand(size, size, 3).clone()
    picture[inside] = mixed(points)
    around, nearest = cast(
        tuple[np.ndarray, np.ndarray], ndimage.distance_transform_edt(~inside.numpy(), return_indices=True)
    )
    picture = torch.where(torch.from_numpy(around <= MARGIN)[..., None], picture[tuple(nearest)], picture)
    corner = round(2 * (1 - CAP_CORNER[1]) * size)
    picture[:corner, :corner] = picture[-1, -1]  # of the cap, as all that belongs to no chart
    return to_uint8(picture)


def encoded(picture: UInt8[Tensor, "S S 3"]) -> bytes:
    """The picture as PNG."""
    pixels = cv2.cvtColor(picture.numpy(), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".png", pixels, (cv2.IMWRITE_PNG_COMPRESSION, 9))[1].tobytes()


def texel_points(avatar: Avatar, size: int) -> tuple[Float[Tensor, "M 3"], Tensor]:
    """Points of the right-handed surface at rest [m] under the pixels of its texture, and which pixels have one."""
    hand = avatar.hand
    flat = torch.stack([hand.uv[:, 0], 1 - hand.uv[:, 1], torch.ones(len(hand.uv))], 1)
    scale = torch.diag(torch.tensor([float(size), float(size), 1.0]))
    seen = depth_map(flat, hand.uv_faces, torch.eye(4), scale, size, size, outputs=("face_ids", "barycentrics"))
    inside = seen.face_ids >= 0
    corners = avatar.rest.vertices[hand.faces[seen.face_ids[inside].long()]]
    return (corners * seen.barycentrics[inside][..., None]).sum(1), inside


class Mixture:
    """Colours of Gaussians at rest, as a function of points."""

    def __init__(self, skin: CanonicalGaussians, vertices: Tensor, faces: Tensor, colors: Tensor):
        on_faces = (vertices[faces[skin.face_index]] * skin.barycentrics[..., None]).sum(1)
        self.centers = torch.cat([vertices[skin.vertex_index] + skin.offsets, on_faces])
        self.inverse = rotation.to_matrix(skin.quats).mT / skin.scales[..., None]
        """From an offset to standard deviations along the Gaussian's axes."""
        self.opacities, self.colors = skin.opacities, colors
        self._tree = cKDTree(self.centers.numpy())

    def __call__(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """The mean colours there."""
        return torch.cat([self._mixed(part) for part in points.split(POINTS)])

    def _mixed(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        near = torch.from_numpy(self._tree.query(points.numpy(), NEAREST)[1])
        away = (self.inverse[near] @ (points[:, None] - self.centers[near])[..., None])[..., 0]
        shares = torch.softmax(self.opacities[near].clamp_min(1e-6).log() - away.square().sum(-1) / 2, 1)
        return (shares[..., None] * self.colors[near]).sum(1)
