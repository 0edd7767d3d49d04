"""Normal and roughness textures beside the albedo of a mesh: what an avatar does not know, and engines ask for."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.appearance import label_regions
from oasis_warp.core.color import luminance
from oasis_warp.data.pictures import to_uint8
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.texture import Texels, bake_colors, encoded
from oasis_warp.hand_avatar import Avatar

DEPTH = 0.41e-3
"""Height [m] of skin that is e times as bright as what is around: least squares over the slopes of twenty synthetic
people, from their true albedo (docs/export.md says what it is worth)."""
FINE, COARSE = 0.4e-3, 4e-3
"""Standard deviations between which detail counts as relief [m]: a pixel, and the breadth of a fold with its flanks."""
MIN_LUMINANCE = 0.02
"""Whose logarithm is taken of darker pixels: ink and dirt are no abysses."""
SKIN, PALM, PALM_TIP, NAIL = 0.56, 0.04, -0.06, 0.32
"""GGX roughness of skin, what the palm and its finger tips add, and that of nails: the means of the synthetic world, by
which `synthetic.skin_texture` draws its gloss."""


@torch.no_grad()
def bake_material(request: ExportRequest, size: int) -> dict[str, bytes]:
    """The textures of a mesh as PNG by name: "skin", and unless light is baked into it "normal" and "roughness".

    Normals are unit vectors n as (n + 1) / 2 along the directions of u, of v (which points up), and out of the skin.
    The roughness is green; blue, which glTF has for metal, is 0.

    Args:
        request: Whose skin, and in what light; none if it does not say.
        size: Side [px].

    Raises:
        InputError: a value is not finite.
    """
    light = request.light or "none"
    colors, texels = bake_colors(request, light, size)
    pictures = {"skin": colors}
    if light == "none":
        maps = material_maps(request.avatar, colors, texels)
        rough = torch.nn.functional.pad(maps[..., 3:], (1, 1))
        pictures |= {"normal": maps[..., :3], "roughness": rough}
    return {name: encoded(to_uint8(picture)) for name, picture in pictures.items()}


def material_maps(avatar: Avatar, colors: Float[Tensor, "S S 3"], texels: Texels) -> Float[Tensor, "S S 4"]:
    """Normals guessed from the detail of the albedo, as colours, and the roughness of skin and nails.

    Dark is deep (Langer and Buelthoff 2000): height is `DEPTH` times the logarithm of the luminance, without what is
    finer than `FINE` or coarser than `COARSE`. What the photo's light shades is not in it.

    Args:
        avatar: Whose skin.
        colors: Albedo, sRGB.
        texels: Of the colours' size.
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
    share = gaussian_filter(inside.astype(np.float32), sigma)
    return gaussian_filter(np.where(inside, values, 0).astype(np.float32), sigma) / np.maximum(share, 1e-6)
