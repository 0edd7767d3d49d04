"""Light from all around as nine harmonics of irradiance, and what a posed hand hides of it from its own skin."""

import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.core import surface
from oasis_warp.core.color import LUMINANCE
from oasis_warp.core.types import HandLight
from oasis_warp.ops.corner_reading import Corners, read_corners
from oasis_warp.ops.sky_exposure import sky_exposure

LOBE = (1.0, 2 / 3, 1 / 4)
"""What a cosine lobe leaves of each degree of harmonics (Ramamoorthi and Hanrahan 2001)."""
DEGREES = (0, 1, 1, 1, 2, 2, 2, 2, 2)
"""Of the nine functions."""


IN_HOLLOWS = (1.0, 1.2, 1.35)
"""Powers of the shares of red, green and blue light that a model of bounces says arrive in hollows: photos are darker
there, and redder. Chosen on 41 photos of same_hand; `python -m studies hollows` measures it (docs/avatar.md)."""
LEAST_LIGHT = (0.05, 0.02, 0.01)
"""Share of red, green and blue light that reaches skin which sees no sky, where two fingers touch: black lines of the
width of a coarse face looked like gaps. Set by eye on two photos of same_hand."""
IN_CREVICES = (0.03, 0.012, 0.008)
"""Shares of red, green and blue light that reach skin which touches other skin. Depth buffers of 3 mm and faces of 5 mm
do not show the dark lines between closed fingers."""
DEEP_INSIDE, OUTSIDE = 0.4, 0.6
"""Shares of the sky that a vertex sees up to which skin close by hides the rest of the light, and from which it hides
none: flesh that lies inside other flesh by more than both can yield may end on the other side."""
THROUGH_SKIN = (0.15, 0.07, 0.04)
"""The same in files of version 7, which had no other powers."""
NOTHING_HIDDEN, SCATTERED = 4, 7
"""Last file version whose hands hid nothing of the light, and the one with `THROUGH_SKIN`."""
NEARBY = 2
"""Rings of coarse faces, of 5 mm each, within which what hid the sky in the photo counts as having moved: pixels that
may show it instead of the skin reach 5 mm past its outline (`adaptation.reliability.BEHIND_REACH`), and a fit is some
pixels off."""


class SkyMesh(NamedTuple):
    """A coarse version of the hand's surface. Built by `asset_build/build_coarse_meshes.py`."""

    vertices: Int[Tensor, "C"]
    """Numbers of the hand's vertices that it keeps."""
    faces: Int[Tensor, "G 3"]
    """Between these."""
    corners: Corners
    """Of the coarse face that lies nearest to each vertex of the hand."""
    vertex_faces: Int[Tensor, "C M"]
    """The coarse faces around each coarse vertex, as `core.surface.faces_of_vertices`."""
    nearby: Int[Tensor, "C N"]
    """The coarse vertices within `NEARBY` rings of each, itself among them; the last also fills a row up."""
    still: int
    """The vertex that moves most with the wrist alone."""


@functools.cache
def sky_mesh(device: torch.device) -> SkyMesh:
    """The coarse mesh of the bundled hand."""
    # Kept for all: what is known of its faces is remembered only for tensors made outside of inference.
    with (
        torch.inference_mode(False),
        asset("hand", "sky_mesh.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        table = {name: stored[name].astype(np.int64) for name in ("vertices", "faces", "corners")}
        table["nearby"] = _within_rings(table["faces"], len(table["vertices"])).astype(np.int64)
        vertices, faces, corners, nearby = (torch.from_numpy(part).to(device) for part in table.values())
        weights = torch.from_numpy(stored["weights"].astype(np.float32)).to(device)
        read = Corners(corners.int(), weights)
        vertex_faces = surface.faces_of_vertices(faces, len(vertices))
        return SkyMesh(vertices.int(), faces, read, vertex_faces, nearby.int(), int(stored["still"]))


def _within_rings(faces: np.ndarray, count: int) -> np.ndarray:
    """Vertices within `NEARBY` rings of each of `count` vertices; the last of a row also fills it up."""
    rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()
    beside = sparse.csr_array((np.ones(len(rows)), (rows, columns)), (count, count))
    near = sparse.csr_array(sparse.linalg.matrix_power(beside, NEARBY))
    sizes = np.diff(near.indptr)
    return near.indices[near.indptr[:-1, None] + np.minimum(np.arange(sizes.max()), sizes[:, None] - 1)]


def largest_nearby(values: Float[Tensor, "*B V"]) -> Float[Tensor, "*B V"]:
    """The largest of `values` over `NEARBY` rings of coarse faces around each vertex."""
    mesh = sky_mesh(values.device)
    coarse = values[..., mesh.vertices][..., mesh.nearby].amax(-1)
    return read_corners(coarse[..., None], mesh.corners)[..., 0]


def harmonic_basis(directions: Float[Tensor, "*B 3"], count: int) -> Float[Tensor, "*B K"]:
    """The 4 or 9 functions of `HandLight.harmonics` in unit `directions`."""
    first = torch.cat([torch.ones_like(directions[..., :1]), directions], -1)
    if count == 4:
        return first
    x, y, z = directions.unbind(-1)
    return torch.cat([first, torch.stack([x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1)], -1)


@torch.no_grad()
def exposure(
    posed: Float[Tensor, "*B V 3"],
    normals: Float[Tensor, "*B V 3"],
    quats: Float[Tensor, "*B V 4"],
    light: HandLight,
) -> Float[Tensor, "*B V 4"]:
    """`ops.sky_exposure` of the bundled hand: of an even sky, then of the red, green and blue of `light`.

    Computed on the coarse mesh; directions turn with the wrist, so that nothing changes when the whole hand moves.

    Args:
        posed: Vertices [m].
        normals: Unit.
        quats: Unit, by which each vertex has turned from rest.
        light: Any; what of it does not arrive bounces.
    """
    mesh, batch = sky_mesh(posed.device), posed.shape[:-2]
    surface, facing = (part.float().reshape(-1, *part.shape[-2:]) for part in (posed, normals))
    turns = quats[..., mesh.still, :].float().reshape(-1, 4)
    found = sky_exposure(surface, facing, mesh.vertices, mesh.faces, turns, light.harmonics.float())
    return read_corners(found, mesh.corners).to(posed).reshape(*batch, -1, 4)


def bounced(exposure: Float[Tensor, "*B 3"], albedo: Float[Tensor, "3"]) -> Float[Tensor, "*B 3"]:
    """The share of the light that arrives directly or after it bounced between surfaces of this reflectance.

    A cubic fit to path-traced scenes (Jimenez et al. 2016, "Practical real-time strategies for accurate indirect
    occlusion", section 6).
    """
    a = 2.0404 * albedo - 0.3324
    b = -4.7951 * albedo + 0.6417
    c = 2.7552 * albedo + 0.6903
    return torch.maximum(exposure, ((exposure * a + b) * exposure + c) * exposure)


def arriving(exposure: Float[Tensor, "*B 3"], albedo: Float[Tensor, "3"]) -> Float[Tensor, "*B 3"]:
    """The share of the light that arrives directly, after bounces, or through the skin beside it."""
    least, powers, _ = _constants(exposure.device).to(exposure)
    return least + (1 - least) * bounced(exposure, albedo) ** powers


def in_crevices(closeness: Float[Tensor, "*B V"], exposure: Float[Tensor, "*B V 4"]) -> Float[Tensor, "*B V 3"]:
    """Share of the light that skin close by leaves, where vertices see little of the sky past the hand."""
    inside = ((OUTSIDE - exposure[..., 0]) / (OUTSIDE - DEEP_INSIDE)).clamp(0, 1)
    hidden = (inside * closeness)[..., None]
    return 1 - hidden * (1 - _constants(closeness.device)[2]).to(closeness)


def arriving_before(version: int, exposure: Float[Tensor, "*B 3"], albedo: Float[Tensor, "3"]) -> Float[Tensor, "*B 3"]:
    """`arriving` by the rules of avatar files of an older version."""
    if version <= NOTHING_HIDDEN:
        return torch.ones_like(exposure)
    through = exposure.new_tensor(THROUGH_SKIN if version == SCATTERED else (0.0, 0.0, 0.0))
    return through + (1 - through) * bounced(exposure, albedo)


@functools.cache
def _constants(device: torch.device) -> Float[Tensor, "3 3"]:
    """`LEAST_LIGHT`, `IN_HOLLOWS` and `IN_CREVICES`; kept, because a graph must not copy them from the host."""
    with torch.inference_mode(False):
        return torch.tensor([LEAST_LIGHT, IN_HOLLOWS, IN_CREVICES], device=device)


SQUARES = (1, 1 / 3, 1 / 3, 1 / 3, 1 / 15, 1 / 15, 4 / 5, 1 / 15, 4 / 15)
"""Means over the sphere of the squares of the nine functions."""
STUDIO_FILL = 0.55
"""Even light of the studio; its lamps give the rest."""
STUDIO_LAMPS = (((-0.6, -0.6, -0.55), 0.85), ((0.8, -0.1, -0.6), 0.25), ((0.3, -0.6, 0.75), 0.45))
"""Directions to the lamps, as the photo's camera sees them (x right, y down, z forward), and how strong they are: a key
from above left, a fill from the right, and one from behind."""
SOFTNESS = (1.0, 0.9, 0.7)
"""What the size of the studio's lamps leaves of each degree."""


def environment_light(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "9 3"]:
    """Harmonics of the irradiance of an equirectangular picture of linear light (Ramamoorthi and Hanrahan 2001).

    As bright as even light of 1: the mean luminance over the sphere is 1. The middle of the picture lies where the
    photo's camera looks, behind the hand; its upper edge is above.

    Args:
        picture: Linear light, not negative and not all black, rows from above to below, columns from left to right.
    """
    height, width = picture.shape[:2]
    down = (torch.arange(height, dtype=torch.float64) + 0.5) * (math.pi / height)
    right = (torch.arange(width, dtype=torch.float64) + 0.5) * (2 * math.pi / width) - math.pi
    sine = down.sin()[:, None]
    rays = torch.stack([sine * right.sin(), -down.cos()[:, None].expand(-1, width), sine * right.cos()], -1)
    weights = (sine / (sine.sum() * width)).expand(-1, width).flatten()
    return _normalised(harmonic_basis(rays.view(-1, 3), 9), picture.double().view(-1, 3) * weights[:, None])


def studio_light() -> Float[Tensor, "9 3"]:
    """Harmonics of the irradiance of three large lamps in an even room, as bright as even light of 1."""
    directions = torch.tensor([direction for direction, _ in STUDIO_LAMPS], dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    soft = torch.tensor([SOFTNESS[degree] for degree in DEGREES], dtype=torch.float64)
    strengths = torch.tensor([[strength] * 3 for _, strength in STUDIO_LAMPS], dtype=torch.float64)
    room = torch.zeros(1, 9, dtype=torch.float64)
    room[0, 0] = 1
    basis = torch.cat([room, soft * harmonic_basis(directions, 9)])
    return _normalised(basis, torch.cat([torch.full((1, 3), STUDIO_FILL, dtype=torch.float64), strengths / 4]))


def _normalised(basis: Float[Tensor, "N 9"], light: Float[Tensor, "N 3"]) -> Float[Tensor, "9 3"]:
    """Irradiance of light from N directions, given their harmonics."""
    scale = torch.tensor([LOBE[d] / square for d, square in zip(DEGREES, SQUARES, strict=True)], dtype=torch.float64)
    harmonics = scale[:, None] * (basis.mT @ light)
    return (harmonics / (harmonics[0] @ harmonics.new_tensor(LUMINANCE))).float()
