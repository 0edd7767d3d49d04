"""The end of the hand at the wrist: opaque skin up to the rim, and a rounded cap over the opening."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import (
    OPACITY,
    RIM_FADE,
    THICKNESS,
    VERTEX_SPREAD,
    batch_anchors,
    rim_fade,
    surface_frames,
    vertex_to_gaussians,
)
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandLight

END, OVERLAP = 0.5, 0.8
"""Shares of opacity left by the fade at the wrist, below which Gaussians end and their opaque replacements begin."""
SHADE_FADE = 0.022
"""The stretch before that fade over which the photo's shade ends [m]: that of a sleeve, or of the turn into the arm,
looks like a burn where the arm is missing."""
SMOOTHING = 0.004
"""Standard deviation of the average of colours from before the fade [m]: photos show sleeves and shadows there."""
CAP_HEIGHT = 0.006
"""Height of the cap over the rim [m]."""
CAP_RINGS = 12
"""Steps of the cap's rings from the rim to its middle: about as far apart as the rim's vertices."""
INDENT = 0.003
"""How far the cap's widest Gaussians stay inside the rim, where they would make a collar [m]."""
RIM_PARTS = -1 / 3, 0.0, 1 / 3
"""Places of Gaussians along the edges at a vertex of the rim, as shares of the edge: one on each vertex makes teeth."""
RIM_SPREAD = 0.8
"""Standard deviation of the rim's Gaussians over their distance."""
CAP_SPREAD = 1.9
"""Standard deviations of the cap's Gaussians over those of vertex Gaussians: no face Gaussians fill their gaps."""


def close_wrist(hand: HandModel, gaussians: CanonicalGaussians, rest: Float[Tensor, "V 3"]) -> CanonicalGaussians:
    """Close the hand at the wrist, where a prior's opacity fades out because photos show an arm there.

    Gaussians in the second half of the fade are replaced by opaque ones on every vertex and face; the others become as
    opaque as they were before the fade. The cap's Gaussians are bound to rim vertices. New Gaussians have the colours
    of the nearest Gaussians before the fade, and no shade; the shade of the others ends before.

    Args:
        hand: Model of the surface.
        gaussians: On `rest`.
        rest: The surface at rest [m].
    """
    faces, rim = hand.faces.to(rest.device), hand.rim.to(rest.device)
    full = batch_anchors(rest[None], faces, surface.faces_of_vertices(faces, len(rest)), rim)
    at_vertices, at_faces = full.fade[0].split([len(rest), len(faces)])
    own = torch.cat([at_vertices[gaussians.vertex_index], at_faces[gaussians.face_index]])
    kept = gaussians._replace(opacities=(gaussians.opacities / own.clamp_min(END)).clamp(max=OPACITY))
    kept, n_kept = select(kept, own > END), int((own[: len(gaussians.vertex_index)] > END).sum())
    inside = torch.ones_like(at_vertices).index_fill(0, rim, 0) > 0
    vertices, on_faces = (torch.nonzero(part)[:, 0] for part in ((at_vertices < OVERLAP) & inside, at_faces < OVERLAP))
    rows = vertices, len(rest) + on_faces
    end = rim_line(rest, rim, full.quats[0, rim]), rim_cap(rest, rim)
    index, offsets, end_quats, end_scales = (torch.cat(parts) for parts in zip(*end, strict=True))
    scales = full.scales[0]
    points = torch.cat([rest[vertices], rest[index] + offsets])
    read = [_smoothed(gaussians, own, rest, faces, rim, at) for at in (points, rest[faces[on_faces]].mean(1))]

    def joined(old: Tensor, of_points: Tensor, of_faces: Tensor) -> Tensor:
        return torch.cat([old[:n_kept], of_points, old[n_kept:], of_faces])

    shade = kept.shade
    if shade is not None:
        shade = shade ** vertex_to_gaussians(_shade_left(hand, rest), faces, kept)
    return CanonicalGaussians(
        torch.cat([kept.vertex_index, vertices, index]),
        torch.cat([kept.offsets, torch.zeros_like(rest[vertices]), offsets]),
        torch.cat([kept.face_index, on_faces]),
        torch.cat([kept.barycentrics, rest.new_full((len(on_faces), 3), 1 / 3)]),
        joined(kept.quats, torch.cat([full.quats[0, rows[0]], end_quats]), full.quats[0, rows[1]]),
        joined(kept.scales, torch.cat([scales[rows[0]], end_scales]), scales[rows[1]]),
        joined(kept.opacities, *(rest.new_full((len(part),), OPACITY) for part in (points, on_faces))),
        joined(kept.colors, *read),
        None if shade is None else joined(shade, *(torch.ones_like(part) for part in read)),
    )


def end_shade(hand: HandModel, light: HandLight, rest: Float[Tensor, "V 3"]) -> HandLight:
    """`light` whose shade ends before the wrist, as the shade of Gaussians does in `close_wrist`."""
    return light if light.shade is None else light._replace(shade=light.shade ** _shade_left(hand, rest))


def _shade_left(hand: HandModel, rest: Tensor) -> Float[Tensor, "V 1"]:
    """The power of shade that is left at each vertex."""
    return rim_fade(rest[None], hand.rim.to(rest.device), RIM_FADE, SHADE_FADE)[0, :, None]


def _smoothed(
    gaussians: CanonicalGaussians, fade: Tensor, rest: Tensor, faces: Tensor, rim: Tensor, points: Tensor
) -> Float[Tensor, "M 3"]:
    """The colours of Gaussians just before the fade, averaged around `points`.

    The average is wider where these are farther away. With one width the middle of the cap would have wedges of one
    colour each.
    """
    on_faces = (rest[faces[gaussians.face_index]] * gaussians.barycentrics[..., None]).sum(1)
    centers = torch.cat([rest[gaussians.vertex_index] + gaussians.offsets, on_faces])
    before = (fade >= 1) & (torch.cdist(centers, rest[rim]).amin(1) < 2 * RIM_FADE)
    near = torch.cdist(points, centers[before]).square()
    spread = SMOOTHING**2 + near.amin(1, keepdim=True)
    return torch.softmax(-0.5 * near / spread, 1) @ gaussians.colors[before]


def rim_line(
    rest: Float[Tensor, "V 3"], rim: Int[Tensor, "R"], quats: Float[Tensor, "R 4"]
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 3"], Float[Tensor, "M 4"], Float[Tensor, "M 3"]]:
    """Vertex Gaussians along the rim, as `rim_cap` gives them, with the orientations of its vertices."""
    edge, n = rest[rim], len(RIM_PARTS)
    before, after = edge.roll(1, 0) - edge, edge.roll(-1, 0) - edge
    offsets = torch.stack([part * after if part > 0 else -part * before for part in RIM_PARTS], 1).flatten(0, 1)
    spread = RIM_SPREAD / n * (before.norm(dim=1) + after.norm(dim=1)) / 2
    scales = torch.stack([spread, spread, THICKNESS * spread], 1)
    return rim.repeat_interleave(n), offsets, quats.repeat_interleave(n, 0), scales.repeat_interleave(n, 0)


def rim_cap(
    rest: Float[Tensor, "V 3"], rim: Int[Tensor, "R"]
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 3"], Float[Tensor, "M 4"], Float[Tensor, "M 3"]]:
    """Vertex Gaussians that close the open end: vertices of the rim, offsets, quaternions and scales [m].

    Ring k of n has the radius r = 1 - k / n of the rim's and the height 1 - r^2 of the cap's: a paraboloid.
    """
    edge, center, n = rest[rim], rest[rim].mean(0), len(rim)
    arms = edge - center
    axis = normalize(torch.linalg.cross(arms, arms.roll(-1, 0)).sum(0), dim=0)
    axis = axis * torch.sign((axis * (center - rest.mean(0))).sum())  # away from the hand
    radius, circumference = arms.norm(dim=1).mean(), (edge - edge.roll(1, 0)).norm(dim=1).sum()
    arms = arms * (1 - INDENT / radius)
    index, offsets, normals, along, spreads = [], [], [], [], []
    for k in range(CAP_RINGS + 1):
        share = 1 - k / CAP_RINGS
        count = max(4, math.ceil(n * share))
        rows = torch.arange(count, device=rim.device) * n // count
        index.append(rows)
        at = center + share * arms[rows] + CAP_HEIGHT * (1 - share * share) * axis
        offsets.append(at - edge[rows])
        normals.append(normalize(axis + 2 * share * CAP_HEIGHT / radius**2 * arms[rows], dim=-1))
        along.append(arms[rows])
        area = radius / CAP_RINGS * circumference * max(share, 0.5 / CAP_RINGS) / count
        spreads.append((CAP_SPREAD * VERTEX_SPREAD * (area / math.pi).sqrt()).expand(count))
    spread = torch.cat(spreads)
    quats = surface_frames(torch.cat(normals), torch.cat(along))
    return rim[torch.cat(index)], torch.cat(offsets), quats, torch.stack([spread, spread, THICKNESS * spread], 1)


def select(gaussians: CanonicalGaussians, kept: Bool[Tensor, "N"]) -> CanonicalGaussians:
    """Some of the Gaussians."""
    points, on_faces = kept.split([len(gaussians.vertex_index), len(gaussians.face_index)])
    vertex_index, offsets, face_index, barycentrics, *rest = gaussians
    return CanonicalGaussians(
        vertex_index[points], offsets[points], face_index[on_faces], barycentrics[on_faces],
        *(None if part is None else part[kept] for part in rest),
    )  # fmt: skip
