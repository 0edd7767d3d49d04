"""What a posed hand hides of the light around it from its own skin."""

import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from oasis_warp.assets import asset
from oasis_warp.core import rotation, surface
from oasis_warp.core.types import HandLight
from oasis_warp.ops.sky_exposure import sky_directions, sky_exposure

LOBE = (1.0, 2 / 3, 1 / 4)
"""What a cosine lobe leaves of each degree of harmonics (Ramamoorthi and Hanrahan 2001)."""


NEARBY = 2
"""Rings of coarse faces, of 5 mm each, within which what hid the sky in the photo counts as having moved: pixels that
may show it instead of the skin reach 5 mm past its outline (`adaptation.reliability.BEHIND_REACH`), and a fit is some
pixels off."""


class SkyMesh(NamedTuple):
    """A coarse version of the hand's surface. Built by `asset_build/build_sky_mesh.py`."""

    vertices: Int[Tensor, "C"]
    """Numbers of the hand's vertices that it keeps."""
    faces: Int[Tensor, "G 3"]
    """Between these."""
    corners: Int[Tensor, "V 3"]
    """Of the coarse face that lies nearest to each vertex of the hand."""
    weights: Float[Tensor, "V 3"]
    """With which that vertex reads them."""
    vertex_faces: Int[Tensor, "C M"]
    """The coarse faces around each coarse vertex, as `core.surface.faces_of_vertices`."""
    still: int
    """The vertex that moves most with the wrist alone."""


@functools.cache
def sky_mesh(device: torch.device) -> SkyMesh:
    """That of the bundled hand."""
    # Kept for all: what is known of its faces is remembered only for tensors made outside of inference.
    with (
        torch.inference_mode(False),
        asset("hand", "sky_mesh.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        vertices, faces, corners = (
            torch.from_numpy(stored[name].astype(np.int64)).to(device) for name in ("vertices", "faces", "corners")
        )
        weights = torch.from_numpy(stored["weights"].astype(np.float32)).to(device)
        vertex_faces = surface.faces_of_vertices(faces, len(vertices))
        return SkyMesh(vertices, faces, corners, weights, vertex_faces, int(stored["still"]))


def largest_nearby(values: Float[Tensor, "*B V"]) -> Float[Tensor, "*B V"]:
    """The largest of `values`, none below 0, over `NEARBY` rings of coarse faces around each vertex."""
    mesh = sky_mesh(values.device)
    coarse = values[..., mesh.vertices]
    for _ in range(NEARBY):
        on_faces = pad(coarse[..., mesh.faces].amax(-1), (0, 1))  # a zero past the last face
        coarse = on_faces[..., mesh.vertex_faces].amax(-1)
    return (coarse[..., mesh.corners] * mesh.weights.to(values)).sum(-1)


def harmonic_basis(directions: Float[Tensor, "*B 3"], count: int) -> Float[Tensor, "*B K"]:
    """The 4 or 9 functions of `HandLight.harmonics` in unit `directions`."""
    first = torch.cat([torch.ones_like(directions[..., :1]), directions], -1)
    if count == 4:
        return first
    x, y, z = directions.unbind(-1)
    return torch.cat([first, torch.stack([x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1)], -1)


def radiance(light: HandLight, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """The light that comes from unit `directions`: irradiance without the blur of the cosine lobe, never below 0."""
    count = len(light.harmonics)
    degrees = [0] + 3 * [1] + 5 * [2]
    blur = torch.cat([torch.full_like(light.harmonics[:1], LOBE[degree]) for degree in degrees[:count]])
    return (harmonic_basis(directions, count) @ (light.harmonics / blur)).clamp_min(0)


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
        quats: By which each vertex has turned from rest.
        light: Any; what of it does not arrive bounces.
    """
    mesh, batch = sky_mesh(posed.device), posed.shape[:-2]
    frames = rotation.to_matrix(quats[..., mesh.still, :]).float().reshape(-1, 3, 3)
    directions = sky_directions(posed.device).directions @ frames.mT
    coarse = posed[..., mesh.vertices, :].float().reshape(-1, len(mesh.vertices), 3)
    facing = normals[..., mesh.vertices, :].float().reshape(coarse.shape)
    found = sky_exposure(coarse, facing, mesh.faces, frames, radiance(light, directions.to(light.harmonics)).float())
    return (found[:, mesh.corners] * mesh.weights[..., None]).sum(-2).to(posed).reshape(*batch, -1, 4)


def bounced(exposure: Float[Tensor, "*B 3"], albedo: Float[Tensor, "3"]) -> Float[Tensor, "*B 3"]:
    """The share of the light that arrives directly or after it bounced between surfaces of this reflectance.

    A cubic fit to path-traced scenes (Jimenez et al. 2016, "Practical real-time strategies for accurate indirect
    occlusion", section 6).
    """
    a = 2.0404 * albedo - 0.3324
    b = -4.7951 * albedo + 0.6417
    c = 2.7552 * albedo + 0.6903
    return torch.maximum(exposure, ((exposure * a + b) * exposure + c) * exposure)
