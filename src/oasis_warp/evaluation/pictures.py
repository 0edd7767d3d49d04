"""Pictures of an evaluation: the result of each method, the attention of the network (the paper's figures), and sheets.

Contact sheets show photo and avatar in the photo's view, from eight sides and in eight poses, large enough to judge.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from oasis_warp.avatar.observation import CropBatch, batch_of_crop
from oasis_warp.avatar.prior import Prior
from oasis_warp.core import surface
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import Camera, HandCrop
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import contact_sheet, to_uint8, write_picture
from oasis_warp.network.attention import VisibilityAttention
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.network.tokens import color_difference
from oasis_warp.ops import depth_map

TILE = 160
"""Side of a picture on a sheet [px]."""
HEADING = 22
"""Height of the line with the names of the columns [px]."""
INK, PAPER = 40, 255
ATTENTION_COLUMNS = ("photo", "visibility", "other side", "global attention", "other side")


def tile(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "t t 3"]:
    """The picture, resized to a tile of a sheet, on the CPU."""
    small = interpolate(image.permute(2, 0, 1)[None], size=(TILE, TILE), mode="area")
    return small[0].permute(1, 2, 0).cpu()


def write_strip(path: Path, rows: Sequence[Sequence[Float[Tensor, "t t 3"]]]) -> None:
    """Write rows of tiles as one picture."""
    write_picture(path, to_uint8(torch.cat([torch.cat(list(row), dim=1) for row in rows])))


def write_sheet(path: Path, strips: Sequence[Path], columns: Sequence[str]) -> None:
    """Write the equally wide pictures `strips` below each other under the names of their columns."""
    parts = [read_photo(strip).rgb for strip in strips]
    heading = np.full((HEADING, parts[0].shape[1], 3), PAPER, np.uint8)
    for k, name in enumerate(columns):
        position = (k * TILE + 4, HEADING - 7)
        cv2.putText(heading, name, position, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (INK, INK, INK), 1, cv2.LINE_AA)
    write_picture(path, torch.cat([torch.from_numpy(heading), *parts]))


def write_attention(path: Path, priors: Mapping[str, Prior], crop: HandCrop) -> None:
    """Write the attention that the learned prior pays to a photo, if its network has any."""
    prior = priors.get("learned")
    if isinstance(prior, NetworkPrior) and isinstance(prior.network.fusion, VisibilityAttention):
        write_strip(path, [draw_attention(prior.network.to(crop.image.device), batch_of_crop(crop))])


@torch.no_grad()
def draw_attention(network: HandNetwork, inputs: CropBatch) -> list[Float[Tensor, "t t 3"]]:
    """The row of `ATTENTION_COLUMNS` for the one hand of `inputs`.

    Visibility is equation 4, the global attention the share of a point's attention that the global token gets, both
    from 0 (dark) to 1 (bright), on the posed surface as the photo sees it and from behind.
    """
    if not isinstance(network.fusion, VisibilityAttention):
        raise ValueError("network: expected one with visibility-conditioned attention, got another fusion.")
    observation = network.observe(inputs)
    mean = network.mean_hands(observation.colors, observation.confidence)
    seen = None if network.point_evidence is None else color_difference(observation, mean)
    points, local, context = network.tokens(inputs, observation, mean, seen)
    share = network.fusion.global_share(points, local, context, observation.visibility)
    size, vertices = inputs.image.shape[1], inputs.posed[0]
    cameras = (
        Camera(inputs.viewmat[0], inputs.K[0], size, size), orbit_camera(vertices, math.pi, size=size)
    )  # fmt: skip
    fields = (observation.visibility[0], share[0])
    drawn = [_draw_field(field, vertices, network.faces, camera) for field in fields for camera in cameras]
    return [tile(inputs.image[0]), *map(tile, drawn)]


def _draw_field(field: Float[Tensor, "V"], vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
    """One value per vertex as a colour on the shaded surface."""
    seen = depth_map(vertices, faces, camera.viewmat, camera.K, camera.width, camera.height, validate=False)
    corners, on_hand = faces[seen.face_ids.clamp_min(0).long()], seen.face_ids >= 0
    value = (field[corners] * seen.barycentrics).sum(-1)
    grey = (value.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    color = torch.from_numpy(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()).to(value) / 255
    normals = surface.vertex_normals(vertices, faces) @ camera.viewmat[:3, :3].T
    facing = -(normals[corners] * seen.barycentrics[..., None]).sum(-2)[..., 2]
    shade = 0.45 + 0.55 * facing.clamp(0, 1)
    return torch.where(on_hand[..., None], color * shade[..., None], torch.ones_like(color))


PLOT, MARGIN = (480, 320), 56
"""Width and height of a plot, and the room around its axes [px]."""


def write_curve(path: Path, points: Sequence[tuple[float, float]], across: str, up: str) -> None:
    """Plot a line through points, each with its two numbers; `across` and `up` say what they are."""
    width, height = PLOT
    pixels, values = np.full((height, width, 3), PAPER, np.uint8), np.array(points)
    low, high = values.min(0), values.max(0)
    place = (values - low) / np.maximum(high - low, 1e-9) * (width - 2 * MARGIN, height - 2 * MARGIN)
    xy = np.round(np.stack([MARGIN + place[:, 0], height - MARGIN - place[:, 1]], 1)).astype(np.int32)
    corners = np.array([(MARGIN, MARGIN), (MARGIN, height - MARGIN), (width - MARGIN, height - MARGIN)])
    for line in (corners, xy):
        cv2.polylines(pixels, [line], False, (INK, INK, INK), 1, cv2.LINE_AA)

    def write(words: str, left: int, bottom: int) -> None:
        cv2.putText(pixels, words, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (INK, INK, INK), 1, cv2.LINE_AA)

    for (x, y), (left, bottom) in zip(points, xy.tolist(), strict=True):
        cv2.circle(pixels, (left, bottom), 3, (INK, INK, INK), -1, cv2.LINE_AA)
        write(f"{x:g}", left - 4, height - MARGIN + 18)
        write(f"{y:.2f}", left + 5, bottom - 7)
    write(across, MARGIN, height - 14)
    write(up, 8, MARGIN - 24)
    write_picture(path, torch.from_numpy(pixels))


COLUMNS = 6
"""Cells in a row of a sheet."""
GAP = 2
"""Between cells [px]."""
SMALL = 256
"""Side of a cell of the overview [px]."""
DARK_GREY = (60, 60, 60)

Cell = tuple[Float[Tensor, "S S 3"], str]
"""A picture and a few words."""


def write_cells(path: Path, cells: Sequence[Cell], columns: int = COLUMNS) -> None:
    """Write labelled pictures of one size in rows of `columns`."""
    labelled = torch.stack([_label(image, words).float() / 255 for image, words in cells])
    write_picture(path, to_uint8(contact_sheet(labelled, columns, GAP)))


def write_overview(path: Path, sheets: Sequence[Path], shown: Sequence[int], columns: int = COLUMNS) -> None:
    """Write the cells numbered `shown` of each sheet, made smaller, as a row.

    Raises:
        InputError: a sheet cannot be read.
    """
    rows = []
    for sheet in sheets:
        pixels = read_photo(sheet).rgb.numpy()
        side = (pixels.shape[1] - (columns - 1) * GAP) // columns
        for k in shown:
            top, left = k // columns * (side + GAP), k % columns * (side + GAP)
            cell = pixels[top : top + side, left : left + side]
            rows.append(torch.from_numpy(cv2.resize(cell, (SMALL, SMALL), interpolation=cv2.INTER_AREA)))
    write_picture(path, to_uint8(contact_sheet(torch.stack(rows).float() / 255, len(shown), GAP)))


def _label(image: Tensor, words: str) -> UInt8[Tensor, "S S 3"]:
    pixels = np.ascontiguousarray(to_uint8(image).numpy())
    size = max(12, len(pixels) // 28)
    cv2.putText(pixels, words, (8, size + 6), DARK_GREY, cv2.FontFace("sans"), size, 400)
    return torch.from_numpy(pixels)
