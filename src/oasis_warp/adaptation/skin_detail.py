"""What is fine on skin: maps of real hands, drawn folds and palm lines, and where nails are.

The maps are made by `asset_build/build_skin_detail.py` over the texture coordinates of the bundled hand.
"""

import functools
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from oasis_warp.assets import asset
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

HANDS = 3
GREY, UNIT = 128, 400
"""Value of the detail maps that stands for none, and steps to one of the natural logarithm."""
SOFT = 0.45
"""Standard deviation of the blur of the detail maps [texels]: without, backs of fine Gaussians have 1.4 times real
hands' contrast below 1 px."""
NO_LINE, LOUDEST_LINE = 64, 2.0
"""Value of the maps of lines that stands for none, and strength of a line that is stored as 255."""
FINER = 3
"""Texels of the drawn lines in one of the other maps along each side: those are .45 mm wide on palms and 1 mm on
fingers, whose folds they blur into a stain."""
BOX, BODY = (732, 1621, 411, 412), 2048
"""Column, row, width and height of the maps in the texture of the whole body, and that one's side [px]."""
LOW, SPAN = (0.361408, 0.011539), 0.192729
"""Corner and side of the hand's texture coordinates in those of the body."""
MIX_PASSES, MIX_SHARPNESS = 60, 3.0
"""Smoothings of the noise that chooses between the hands, about 20 mm, and its strength: most places show one hand,
since the mean of several is blurred."""
WARP = 1.5
"""Standard deviation by which the maps are moved, smoothly over the hand [texels of .45 mm]."""


class SkinDetail(NamedTuple):
    """What is fine at each Gaussian."""

    skin: Float[Tensor, "N 3"]
    """Added to the logarithm of sRGB; 0 on nails."""
    fold: Float[Tensor, "N"]
    """Depth of the folds over the joints and of the palm's lines, 1 for a clear fold; the ridges between folds, whose
    skin is brighter, are below 0."""
    vein: Float[Tensor, "N"]
    """Strength of the veins on the back."""
    plate: Float[Tensor, "N"]
    """Share of nail."""
    pale: Float[Tensor, "N"]
    """1 on a nail's lunula, -1 on its free edge."""
    rim: Float[Tensor, "N"]
    """Share of the fold around a nail."""


def sample_detail(hand: HandModel, gaussians: CanonicalGaussians, seed: int) -> SkinDetail:
    """Read the maps at every Gaussian: skin of three hands, mixed place by place and a little warped as `seed` says.

    The lines are one person's: where those of two were mixed, they ended abruptly. Persons take turns with the seed.
    """
    device = gaussians.barycentrics.device
    faces = hand.faces.cpu().contiguous()
    noise = _smooth_noise(faces.numpy().tobytes(), faces.dtype, len(hand.template), seed)
    weights = torch.softmax(MIX_SHARPNESS * noise[:, :HANDS], 1)
    of_vertices = torch.cat([weights, WARP * noise[:, HANDS:]], 1).to(device)
    first = _first_corner(hand.faces, len(hand.template)).to(device)
    faces, uv = hand.faces.to(device), texels_of(hand).to(device)
    uv_faces = hand.uv_faces.to(device)
    corners = first[gaussians.vertex_index]
    on_points = torch.cat([uv[uv_faces.flatten()[corners]], of_vertices[gaussians.vertex_index]], 1)
    at_corners = torch.cat([uv[uv_faces[gaussians.face_index]], of_vertices[faces[gaussians.face_index]]], -1)
    on_faces = (at_corners * gaussians.barycentrics[..., None]).sum(1)
    read = torch.cat([on_points, on_faces])
    place, share, shift = read.split([2, HANDS, 2], 1)
    share = share.square() / share.square().sum(1, keepdim=True)
    maps, lines = (part.to(device) for part in _maps())
    moved = _sample(maps, place + shift).unflatten(1, (HANDS, 3))
    # not moved: lines and nails belong to their joints
    *folds, vein, plate, pale, rim = _sample(lines, FINER * place).unbind(1)
    bare, fold = 1 - plate, folds[(seed + 1) % len(folds)]
    skin = (moved * share[..., None]).sum(1)
    return SkinDetail(skin * bare[:, None], fold * bare, vein, plate, pale, rim)


@functools.lru_cache(2)
def _smooth_noise(faces: bytes, dtype: torch.dtype, n_vertices: int, seed: int) -> Float[Tensor, "V C"]:
    """Fields of mean 0 and standard deviation 1: one a hand, two of the warp. On the CPU, for equal bits.

    Kept, as a photo asks for it twice and all photos of a seed for the same one; none may write to it.
    """
    with torch.inference_mode(False), torch.no_grad():
        table = torch.frombuffer(bytearray(faces), dtype=dtype).view(-1, 3)
        noise = torch.randn(n_vertices, HANDS + 2, generator=torch.Generator().manual_seed(seed))
        smooth = surface.smooth_over_mesh(noise, surface.mesh_edges(table), MIX_PASSES)
        return (smooth - smooth.mean(0)) / smooth.std(0)


def _first_corner(faces: Int[Tensor, "F 3"], n_vertices: int) -> Int[Tensor, "V"]:
    """The first place of each vertex among the faces' corners."""
    flat = faces.flatten().cpu()
    place = torch.full((n_vertices,), len(flat))
    return place.scatter_reduce_(0, flat, torch.arange(len(flat)), "amin")


def texels_of(hand: HandModel) -> Float[Tensor, "U 2"]:
    """Column and row of the texture coordinates in the maps; the first texel's centre is at .5."""
    atlas = hand.uv.new_tensor(LOW) + (hand.uv - 0.01) / 0.98 * SPAN
    return torch.stack([atlas[:, 0] * BODY - BOX[0], (1 - atlas[:, 1]) * BODY - BOX[1]], 1)


def _sample(maps: Float[Tensor, "C H W"], place: Float[Tensor, "N 2"]) -> Float[Tensor, "N C"]:
    if not len(place):
        return place.new_zeros(0, len(maps))
    size = place.new_tensor([maps.shape[2], maps.shape[1]])
    grid = (2 * place / size - 1)[None, None]
    return grid_sample(maps[None], grid, padding_mode="border", align_corners=False)[0, :, 0].T


@functools.cache
def _maps() -> tuple[Float[Tensor, "C H W"], Float[Tensor, "6 h w"]]:
    """The detail of all hands; finer, two persons' folds, one person's veins, and plate, paleness and rim of nails."""

    def read(name: str) -> np.ndarray:
        stored = np.frombuffer(asset("skin", name).read_bytes(), np.uint8)
        bgr = cv2.imdecode(stored, cv2.IMREAD_COLOR)
        assert bgr is not None, name
        return bgr[..., ::-1].astype(np.float32)

    detail = [cv2.GaussianBlur((read(f"detail_{k}.png") - GREY) / UNIT, (0, 0), SOFT) for k in range(HANDS)]
    lines = (read("lines.png") - NO_LINE) * (LOUDEST_LINE / (255 - NO_LINE))
    nails = (read("nails.png") - np.float32([0, GREY, 0])) / np.float32([255, 127, 255])
    channels = np.concatenate(detail, 2), np.concatenate([lines, nails], 2)
    maps, fine = (torch.from_numpy(values).permute(2, 0, 1).contiguous() for values in channels)
    return maps, fine
