"""Put the drawn outline onto the mask's: a second displacement of the surface, by pictures of Gaussians.

`estimation.surface_offsets` brings the mesh onto the mask. Gaussians reach beyond the mesh by their size and by a
pixel's blur, more at the tip of a finger than along it, and across slits; so one depth below the skin leaves outlines
too fat in one place and too thin in another. Here Gaussians are drawn, their outline is compared with the mask's, and
the surface moves along its normals, smoothly, until the two agree.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import PRIOR_SIZE
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core import surface
from oasis_warp.core.camera import project
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop
from oasis_warp.estimation.surface_offsets import ThinSheet, crossing
from oasis_warp.render.render import render

BEYOND = 0.5
"""Way from the mask's half to the half of the drawn outline, outwards [px]. A pixel on the outline is half background
in the photo and half black in a picture over black, so what fits best is opaque there: see docs/avatar.md."""
_ROUNDS = 2
_GRAZING = 0.5
"""Largest |normal . view| of a vertex that speaks for the rim."""
_NEAR = 2.5 / PRIOR_SIZE
"""Distance from what is not drawn within which a vertex speaks for the rim; this and the next as shares of the side."""
_REJECT = 4 / PRIOR_SIZE
"""A gap wider than this is the mask's fault and is left."""
_BORDER = 2
"""Outlines nearer to the picture's border may be those of the picture [px]."""


class _Rim(NamedTuple):
    """What one picture says."""

    vertices: np.ndarray
    outwards: np.ndarray
    """How far each should be moved along its normal [m]."""
    weight: np.ndarray


@torch.no_grad()
def rendered_outline_offsets(
    hand: HandModel, guesses: Sequence[CanonicalGaussians], crops: Sequence[HandCrop]
) -> Float[Tensor, "V 3"]:
    """Displacement of the rest surface that brings the outlines of Gaussians on it to the masks' [m].

    Zero where no outline says anything.

    Args:
        hand: The model.
        guesses: Gaussians as each photo shows them. Neither their colours nor the photos' are looked at.
        crops: Photos of one hand, as large as its pictures will be, with one surface at rest.
    """
    faces = hand.faces.to(crops[0].mask.device)
    along = [
        (surface.vertex_normals(e.rest.vertices, faces), surface.vertex_normals(e.posed.vertices, faces))
        for e in crops
    ]
    sheet = ThinSheet(hand.faces.cpu().numpy(), len(hand.template))
    outwards = np.zeros(len(hand.template))
    for _ in range(_ROUNDS):
        step = torch.from_numpy(outwards).to(crops[0].mask)[:, None]
        parts = [
            _look(guess, faces, e._replace(
                rest=e.rest._replace(vertices=e.rest.vertices + step * at_rest),
                posed=e.posed._replace(vertices=e.posed.vertices + step * posed),
            ))
            for guess, e, (at_rest, posed) in zip(guesses, crops, along, strict=True)
        ]  # fmt: skip
        vertices, missing, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        if len(vertices) == 0:
            break
        target = outwards[vertices] + missing
        outwards = sheet.drawn(vertices, target[:, None], weight)[:, 0]
    return torch.from_numpy(outwards).to(along[0][0])[:, None] * along[0][0]


def _look(gaussians: CanonicalGaussians, faces: Int[Tensor, "F 3"], crop: HandCrop) -> _Rim:
    """Draw Gaussians on the surface of `crop`, and compare their outline with the mask's at the vertices there."""
    vertices, camera = crop.posed.vertices, crop.camera
    posed = pose_gaussians(gaussians, faces, crop.rest.vertices, vertices)
    alpha = render(posed, camera).alpha.cpu().numpy()
    mask, side = crop.mask.cpu().numpy(), len(alpha)

    turn = camera.viewmat[:3, :3]
    normals = surface.vertex_normals(vertices, faces) @ turn.T
    seen = vertices @ turn.T + camera.viewmat[:3, 3]
    grazing = ((normals * normalize(seen, dim=-1)).sum(-1).abs() < _GRAZING).cpu().numpy()
    uv, depth = (part.cpu().numpy() for part in project(camera, vertices))
    pixel = np.clip(np.floor(uv).astype(int), 0, side - 1)
    inside = cv2.distanceTransform((alpha > 0.5).astype(np.uint8), cv2.DIST_L2, 3)
    near = inside[pixel[:, 1], pixel[:, 0]] < max(_NEAR * side, 1)
    judged = crop.above_wrist.cpu().numpy()[pixel[:, 1], pixel[:, 0]] > 0.5
    rim = np.flatnonzero(grazing & near & judged)

    across = normals.cpu().numpy()[rim, :2]
    steep = np.linalg.norm(across, axis=1)
    out, start, reach = across / steep[:, None], uv[rim], 1.5 * _REJECT * side
    drawn, shown = crossing(alpha, start, out, reach), crossing(mask, start, out, reach)
    gap = shown + BEYOND - drawn
    edge = start + out * np.nan_to_num(drawn)[:, None]
    # A slit that the photo does not have: the picture falls and rises again where the mask stays.
    width = np.nan_to_num(crossing(1 - alpha, edge, out, reach))
    slit = np.isfinite(drawn) & (width > 0)
    for share in (0.0, 0.5, 1.0):
        x, y = np.clip(np.floor(edge + share * out * width[:, None]).astype(int), 0, side - 1).T
        slit &= mask[y, x] > 0.5
    gap = np.where(slit, width / 2, gap)
    on_photo = ((edge > _BORDER) & (edge < side - _BORDER)).all(1)
    good = on_photo & (np.abs(np.nan_to_num(gap, nan=np.inf)) < _REJECT * side)
    rim, gap = rim[good], gap[good]
    pixel_size = depth[rim] / float(camera.K[0, 0])
    # A wide gap is more often a fault of the mask.
    return _Rim(rim, gap * pixel_size / steep[good], 1 / (1 + (gap / (0.4 * _REJECT * side)) ** 2))
