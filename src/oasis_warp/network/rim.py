"""The wrist's end: pictures that networks learn from fade to black there, and so does what they make of it.

Over another background it would end in a dark line and in large faint Gaussians that stand out of the arm.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import OPACITY, RIM_FADE
from oasis_warp.network.anchors import batch_anchors
from oasis_warp.network.inputs import Prediction

FIRST, LAST = 0.5, 1.25
"""Times the length of the fade at the wrist: up to the first Gaussians have the shapes of their anchors, from the last
on those that the network gave them. Nearer than that its colours may be too dark."""


def settle_rim(
    prediction: Prediction,
    rest: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    vertex_faces: Int[Tensor, "V M"],
    rim: Int[Tensor, "R"],
) -> Prediction:
    """The prediction of one hand, with anchors in the colours of the skin next to them at the wrist's end.

    Args:
        prediction: B is 1.
        rest: Vertices at rest [m].
        faces: Corners.
        vertex_faces: From `anchors.faces_of_vertices`.
        rim: Vertices of the open wrist.
    """
    count = prediction.colors.shape[1]
    from_rim = distance_from_rim(rest, faces, rim)[:count]
    share = ((from_rim / RIM_FADE - FIRST) / (LAST - FIRST)).clamp(0, 1)
    share = (share * share * (3 - 2 * share))[None, :, None]
    quats, scales, fade = (part[:, :count] for part in batch_anchors(rest[None], faces, vertex_faces, rim))
    same = torch.where((quats * prediction.quats).sum(-1, keepdim=True) < 0, -quats, quats)
    return prediction._replace(
        offsets=share[:, : len(rest)] * prediction.offsets,
        quats=normalize(torch.lerp(same, prediction.quats, share), dim=-1),
        scales=scales * (prediction.scales / scales) ** share,
        opacities=torch.lerp(OPACITY * fade, prediction.opacities, share[..., 0]),
        colors=spread_to_rim(prediction.colors[0], rest, faces, from_rim)[None],
    )


def distance_from_rim(
    rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], rim: Int[Tensor, "R"]
) -> Float[Tensor, "N"]:
    """Of every vertex and face from the open wrist [m]."""
    at_vertices = torch.cdist(rest, rest[rim]).amin(1)
    return torch.cat([at_vertices, at_vertices[faces].amin(1)])


def spread_to_rim(
    colors: Float[Tensor, "N 3"],
    rest: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    from_rim: Float[Tensor, "N"],
) -> Float[Tensor, "N 3"]:
    """Colours where Gaussians fade out at the wrist become those of the nearest ones that do not.

    Args:
        colors: Of the vertices, and of the faces if they carry Gaussians.
        rest: Vertices at rest [m].
        faces: Corners.
        from_rim: Distance of each of them from the open wrist [m].
    """
    return colors[color_sources(rest, faces, from_rim)]


def color_sources(
    rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], from_rim: Float[Tensor, "N"]
) -> Int[Tensor, "N"]:
    """Whose colour each vertex, and each face if `from_rim` has them, takes in `spread_to_rim`."""
    n, sources = len(rest), []
    for places, part in ((rest, slice(0, n)), (rest[faces].mean(1), slice(n, None))):
        away = from_rim[part]
        if len(away) == 0:
            continue
        own = torch.arange(len(away), device=away.device)
        fading, near = away < LAST * RIM_FADE, (away >= LAST * RIM_FADE) & (away < 1.5 * LAST * RIM_FADE)
        own[fading] = own[near][torch.cdist(places[fading], places[near]).argmin(1)]
        sources.append(own + (part.start or 0))
    return torch.cat(sources)
