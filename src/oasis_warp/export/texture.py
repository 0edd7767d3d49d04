"""Textures of the avatar's mesh: its colours, and normals and roughness, which engines ask for and are guessed."""

from typing import NamedTuple, cast

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize, pad

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.core import rotation
from oasis_warp.core.color import luminance
from oasis_warp.core.hand_model import HandModel
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


class Texels(NamedTuple):
    """Where the pixels of a texture lie on the hand; the first row is v = 1."""

    inside: Bool[Tensor, "S S"]
    """Those that have a place, M in all."""
    faces: Int[Tensor, "M"]
    barycentrics: Float[Tensor, "M 3"]

    def read(self, values: Float[Tensor, "V D"], hand: HandModel) -> Float[Tensor, "M D"]:
        """Values of the hand's vertices there."""
        return (values[hand.faces[self.faces]] * self.barycentrics[..., None]).sum(1)

    def fill_around(self, picture: Float[Tensor, "S S D"]) -> Float[Tensor, "S S D"]:
        """The picture with the values at the edges of charts `MARGIN` pixels around them."""
        around, nearest = cast(
            tuple[np.ndarray, np.ndarray], ndimage.distance_transform_edt(~self.inside.numpy(), return_indices=True)
        )
        return torch.where(torch.from_numpy(around <= MARGIN)[..., None], picture[tuple(nearest)], picture)


def bake_texture(request: ExportRequest, light: str, size: int) -> UInt8[Tensor, "S S 3"]:
    """The colours of `bake_colors` in 8 bits."""
    return to_uint8(bake_colors(request, light, size)[0])


@torch.no_grad()
def bake_colors(request: ExportRequest, light: str, size: int) -> tuple[Float[Tensor, "S S 3"], Texels]:
    """Colours of the skin at every pixel of the texture, sRGB, and the pixels' places.

    A pixel is the mean of the Gaussians around it, weighted by their opacity and their density there at rest: what one
    sees who looks at the skin from everywhere.

    Args:
        request: The avatar whose skin it is, and the pose in which light falls on it.
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
    texels = make_texels(avatar.hand, size)
    mixed = Mixture(skin, avatar.rest.vertices, avatar.hand.faces, colors)
    picture = mixed(rim_cap_center(avatar.hand, avatar.rest.vertices)[0][None]).expand(size, size, 3).clone()
    picture[texels.inside] = mixed(texels.read(avatar.rest.vertices, avatar.hand))
    picture = texels.fill_around(picture)
    corner = round(2 * (1 - CAP_CORNER[1]) * size)
    picture[:corner, :corner] = picture[-1, -1]  # of the cap, as all that belongs to no chart
    return picture, texels


def encoded(picture: UInt8[Tensor, "S S 3"]) -> bytes:
    """The picture as PNG."""
    pixels = cv2.cvtColor(picture.numpy(), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".png", pixels, (cv2.IMWRITE_PNG_COMPRESSION, 9))[1].tobytes()


def make_texels(hand: HandModel, size: int) -> Texels:
    """The pixels of a texture of `size` pixels a side."""
    flat = torch.stack([hand.uv[:, 0], 1 - hand.uv[:, 1], torch.ones(len(hand.uv))], 1)
    scale = torch.diag(torch.tensor([float(size), float(size), 1.0]))
    seen = depth_map(flat, hand.uv_faces, torch.eye(4), scale, size, size, outputs=("face_ids", "barycentrics"))
    inside = seen.face_ids >= 0
    return Texels(inside, seen.face_ids[inside].long(), seen.barycentrics[inside])


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


DEPTH = 0.41e-3
"""Height [m] of skin that is e times as bright as what is around: least squares over the slopes of twenty synthetic
people, from their true albedo (docs/export.md says what it is worth)."""
FINE, COARSE = 0.4e-3, 4e-3
"""Standard deviations between which detail counts as relief [m]: a pixel, and the breadth of a fold with its flanks."""
MIN_LUMINANCE = 0.02
"""Luminance that darker pixels count with in the logarithm, so that ink and dirt are not deep holes."""
SKIN, PALM, PALM_TIP, NAIL = 0.56, 0.04, -0.06, 0.32
"""GGX roughness of skin, what the palm and its finger tips add, and that of nails: the means of the synthetic world, by
which `synthetic.skin_texture` draws its gloss."""


@torch.no_grad()
def bake_material(request: ExportRequest, size: int) -> dict[str, bytes]:
    """The textures of a mesh as PNG by name: "skin", and unless light is baked into it "normal" and "roughness".

    Normals are unit vectors n as (n + 1) / 2 along the directions of u, of v (which points up), and out of the skin.
    The roughness is green; blue, which glTF has for metal, is 0.

    Args:
        request: The avatar whose skin it is, and the light; none if it does not say.
        size: Side [px].

    Raises:
        InputError: a value is not finite.
    """
    light = request.light or "none"
    colors, texels = bake_colors(request, light, size)
    pictures = {"skin": colors}
    if light == "none":
        maps = material_maps(request.avatar, colors, texels)
        rough = pad(maps[..., 3:], (1, 1))
        pictures |= {"normal": maps[..., :3], "roughness": rough}
    return {name: encoded(to_uint8(picture)) for name, picture in pictures.items()}


def material_maps(avatar: Avatar, colors: Float[Tensor, "S S 3"], texels: Texels) -> Float[Tensor, "S S 4"]:
    """Normals guessed from the detail of the albedo, as colours, and the roughness of skin and nails.

    Dark is deep (Langer and Buelthoff 2000): height is `DEPTH` times the logarithm of the luminance, without what is
    finer than `FINE` or coarser than `COARSE`. What the photo's light shades is not in it.

    Args:
        avatar: The avatar whose skin it is.
        colors: Albedo, sRGB.
        texels: Texels of the colours' size.
    """
    slopes = relief_slopes(avatar, colors, texels)
    flat = torch.tensor([0.0, 0.0, 1.0]).expand(len(slopes), 3).clone()
    flat[:, :2] = -DEPTH * slopes
    normals = torch.tensor([0.0, 0.0, 1.0]).expand_as(colors).clone()
    normals[texels.inside] = normalize(flat, dim=-1)
    regions = label_regions(avatar.hand)
    skin = SKIN + regions.palm * (PALM + PALM_TIP * regions.finger_tip)
    of_vertices = torch.lerp(skin, torch.full_like(skin, NAIL), regions.nail)
    roughness = torch.full(texels.inside.shape, SKIN)
    roughness[texels.inside] = texels.read(of_vertices[:, None], avatar.hand)[:, 0]
    return texels.fill_around(torch.cat([(1 + normals) / 2, roughness[..., None]], -1))


def relief_slopes(avatar: Avatar, colors: Float[Tensor, "S S 3"], texels: Texels) -> Float[Tensor, "M 2"]:
    """Change of the detail of log luminance along the skin, in the directions of u and v [1/m]."""
    inside, size = texels.inside.numpy(), len(colors)
    hand = avatar.hand
    corners, uv = avatar.rest.vertices[hand.faces[texels.faces]], hand.uv[hand.uv_faces[texels.faces]]
    edges, steps = (part[:, 1:] - part[:, :1] for part in (corners, uv))
    along = torch.linalg.solve(steps, edges)  # rows: metres for a whole texture in u, in v
    breadth = float(along.norm(dim=-1).median()) / size
    detail = np.log(luminance(colors).clamp_min(MIN_LUMINANCE).numpy())
    band = _blurred(detail, inside, FINE / breadth) - _blurred(detail, inside, COARSE / breadth)
    rows, columns = (torch.from_numpy(part[inside]) * size for part in np.gradient(band))
    across = along[:, 0].norm(dim=-1)
    of_u = columns / across
    lean = (along[:, 1] * along[:, 0]).sum(-1) / across
    upright = (along[:, 1].square().sum(-1) - lean.square()).clamp_min(1e-12).sqrt()
    return torch.stack([of_u, (-rows - lean * of_u) / upright], -1).to(colors)


def _blurred(values: np.ndarray, inside: np.ndarray, sigma: float) -> np.ndarray:
    """Over the pixels of charts alone."""
    share = ndimage.gaussian_filter(inside.astype(np.float32), sigma)
    return ndimage.gaussian_filter(np.where(inside, values, 0).astype(np.float32), sigma) / np.maximum(share, 1e-6)
