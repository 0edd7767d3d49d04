"""Light on posed skin: what colours of even light are multiplied with."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp.avatar.anchors import vertex_to_gaussians
from oasis_warp.core import rotation, surface
from oasis_warp.core.types import Camera, CanonicalGaussians, HandLight
from oasis_warp.ops import depth_map, face_rotations

GAMMA = 2.2
"""Light is sRGB to this power, nearly."""
RIM = 1 / 32
"""Width over which light goes on beyond the surface's outline, over the picture's side."""


def shading(light: HandLight, normals: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V 3"]:
    """Factor of the sRGB colours of skin that faces `normals` (unit, in the world of the photo's camera)."""
    received = light.harmonics[0] + normals @ light.harmonics[1:]
    least, most = light.limits.unbind(0)
    return torch.minimum(torch.maximum(received, least), most).pow(1 / GAMMA)


def lit_colors(
    canonical: CanonicalGaussians,
    faces: Int[Tensor, "F 3"],
    light: HandLight,
    normals: Float[Tensor, "*B V 3"],
) -> Float[Tensor, "*B N 3"]:
    """Colours of Gaussians in `light`, where the vertices face `normals`."""
    factor = shading(light, normals)
    if factor.ndim == 2:
        return (canonical.colors * vertex_to_gaussians(factor, faces, canonical)).clamp(0, 1)
    of_poses = vertex_to_gaussians(factor.movedim(0, 1).flatten(1), faces, canonical)
    return (canonical.colors[:, None] * of_poses.unflatten(1, (-1, 3))).clamp(0, 1).movedim(1, 0)


def in_even_light(canonical: CanonicalGaussians, light: HandLight) -> CanonicalGaussians:
    """The same without light that depends on the direction."""
    return canonical._replace(colors=(canonical.colors * light.even.pow(1 / GAMMA)).clamp(0, 1))


def posed_normals(
    rest: Float[Tensor, "V 3"], posed: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """The normals of the rest surface, turned as Gaussians are."""
    turned = face_rotations(rest, posed, faces, validate=False)
    return rotation.rotate(turned.vertex_quats, surface.vertex_normals(rest, faces))


def shading_picture(
    light: HandLight,
    rest: Float[Tensor, "V 3"],
    posed: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    camera: Camera,
) -> Float[Tensor, "H W 3"]:
    """What `light` multiplies the colours of a picture of the hand with; goes on a little beyond it, then 1."""
    factor = shading(light, posed_normals(rest, posed, faces))
    seen = depth_map(posed, faces, camera.viewmat, camera.K, camera.width, camera.height, validate=False)
    on_hand = (seen.face_ids >= 0).to(factor)[..., None]
    inside = (factor[faces[seen.face_ids.clamp_min(0).long()]] * seen.barycentrics[..., None]).sum(-2)
    # the outlines of picture and surface may differ by a few pixels
    window = 2 * round(RIM * camera.width) + 1
    planes = torch.cat([inside * on_hand, on_hand], -1).permute(2, 0, 1)[None]
    spread = avg_pool2d(planes, window, stride=1, padding=window // 2)[0].permute(1, 2, 0)
    beyond = torch.where(spread[..., 3:] > 0, spread[..., :3] / spread[..., 3:].clamp_min(1e-6), 1)
    return torch.where(on_hand > 0, inside, beyond)


def mirror_light(light: HandLight) -> HandLight:
    """The same light in the mirrored world (x -> -x)."""
    all_around, x, y, z = light.harmonics.unbind(0)
    return light._replace(harmonics=torch.stack([all_around, -x, y, z]))


def turn_light(light: HandLight, rotation: Float[Tensor, "3 3"]) -> HandLight:
    """The same light in a world that `rotation` leads to."""
    return light._replace(harmonics=torch.cat([light.harmonics[:1], rotation @ light.harmonics[1:]]))
