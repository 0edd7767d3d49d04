"""Numbers of Gaussians: faces cut into parts with a Gaussian each, or vertices alone where little is seen."""

import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import embedding_bag

from oasis_warp.avatar.anchors import (
    FACE_SPREAD,
    MIN_OPACITY,
    OPACITY,
    centers_at_rest,
    face_shapes,
    place_anchors,
    vertex_shapes,
)
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.processes import kernel_threads
from oasis_warp.core.types import CanonicalGaussians, PosedHand


class PartLooks(NamedTuple):
    """How large and how opaque the Gaussians of parts are."""

    spread: float
    """Standard deviations of a part's Gaussian over those of the part as a uniform plate."""
    opacity: float
    """The more opaque Gaussians overlap, the more the nearer ones hide those beside them."""
    ground: float
    """Standard deviations of the discs under parts over those of a vertex Gaussian. Wide ones stand out of strong
    bends, as a blur."""
    thickness: float = 0.0
    """Least standard deviation across the surface [m]."""


FITTED = PartLooks(1.9, 0.28, 1.4)
"""For colours that are fitted to a photo. With more opaque parts the picture moves to the side that is nearer in the
view at hand. The hand's other side shimmers through half transparent ones when the ground has a spread of 1, at the
wrist the background; with 1.8 the hand from afar is less like its photo."""
SKIN = PartLooks(1.5, 0.8, 1.05, 0.2e-3)
"""For skin that is painted, as sharp as the parts allow. With a ground of .85 stretched skin has gaps, with 1.4
knuckles have a blur of 1 mm. Thinner than the Gaussians that the outline was aligned with, slits between fingers
open: to .1 mm the photo's view of `palm_flat_right_03` loses 3 dB."""
SOLID = 0.25
"""Opacity of an old Gaussian below which the surface itself is taken for fading, as at the wrist."""
GROUND_DEPTH = 0.001
"""Depth at which the vertex Gaussians of cut faces go on, as discs that are the ground under the parts' [m]."""
GROUND_THICKNESS = 0.00025
"""Their largest standard deviation across the surface [m]. Half as thick as wide, they had up to .8 mm and stood out of
the skin: outlines of fists had a blur of 1 mm."""
NEIGHBOURS = 12
"""Old Gaussians that a new one takes its looks from."""


class Densified(NamedTuple):
    """Canonical Gaussians with more of them on some faces."""

    gaussians: CanonicalGaussians
    """Those on faces that are not cut stay bit for bit and in their order; the parts' own are the last."""
    changed: Bool[Tensor, "N"]
    """Whether each Gaussian is new, or sunk under new ones."""
    n_new: int
    """How many are new."""


def parts_for_spacing(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], spacing: float | Float[Tensor, "F"]
) -> Int[Tensor, "F"]:
    """Parts an edge into which each face is cut, so that a part is at most `spacing` [m] squared; 1 for no cut."""
    _, areas = surface.face_normals(vertices, faces)
    return (areas.sqrt() / spacing).ceil().clamp_min(1).long()


def densify(
    gaussians: CanonicalGaussians,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    parts: Int[Tensor, "F"],
    looks: PartLooks = FITTED,
) -> Densified:
    """Replace the Gaussians on some faces by finer ones that look the same.

    A face of n > 1 parts an edge is cut into n^2 triangles of its own shape, each with a Gaussian at its centre. The
    face's own Gaussians are removed. Vertex Gaussians whose faces are all cut sink and become the ground under the new
    ones. A new Gaussian has the colour and the shade that the old ones have there together. Faces without a Gaussian,
    in the fade at the wrist, stay without.

    Args:
        gaussians: On the surface at rest.
        vertices: Vertices of the surface at rest [m].
        faces: Faces of the surface.
        parts: An edge, for each face; 1 leaves the face as it is.
        looks: Of the parts' Gaussians.
    """
    opacity = _face_opacities(gaussians, faces)
    cut = (parts > 1) & (opacity >= MIN_OPACITY)
    n_points, index = len(gaussians.vertex_index), gaussians.vertex_index
    sunk = _inside(cut, faces, len(vertices))[index]
    depth = GROUND_DEPTH * surface.vertex_normals(vertices, faces)[index]
    disc_quats, disc_scales = vertex_shapes(vertices, faces, surface.faces_of_vertices(faces, len(vertices)))
    disc_opacities = OPACITY * (_vertex_opacities(gaussians, faces, opacity, len(vertices))[index] / SOLID).clamp(max=1)
    on_top = ~cut[gaussians.face_index]

    face_index, barycentrics, quats, scales = cut_faces(vertices, faces, torch.where(cut, parts, 0), looks)
    centers = (vertices[faces[face_index]] * barycentrics[..., None]).sum(1)

    def joined(old: Tensor, ground: Tensor, fine: Tensor) -> Tensor:
        points = torch.where(sunk.view(-1, *[1] * (old.ndim - 1)), ground, old[:n_points])
        return torch.cat([points, old[n_points:][on_top], fine])

    colors = gaussians.colors if gaussians.shade is None else torch.cat([gaussians.colors, gaussians.shade], 1)
    colors = joined(colors, colors[:n_points], read_at(gaussians, colors, vertices, faces, centers))

    dense = CanonicalGaussians(
        index,
        torch.where(sunk[:, None], -depth, gaussians.offsets),
        torch.cat([gaussians.face_index[on_top], face_index]),
        torch.cat([gaussians.barycentrics[on_top], barycentrics]),
        joined(gaussians.quats, disc_quats[index], quats),
        joined(gaussians.scales, ground_discs(looks.ground * disc_scales[index]), scales),
        joined(gaussians.opacities, disc_opacities, looks.opacity * (opacity[face_index] / SOLID).clamp(max=1)),
        colors[:, :3],
        None if gaussians.shade is None else colors[:, 3:],
    )
    n_new = len(face_index)
    changed = torch.cat([sunk, torch.zeros_like(on_top[on_top]), torch.ones_like(face_index, dtype=torch.bool)])
    return Densified(dense, changed, n_new)


def ground_discs(scales: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V 3"]:
    """Standard deviations of discs below the surface that do not stand out of it [m]."""
    return torch.cat([scales[..., :2], scales[..., 2:].clamp(max=GROUND_THICKNESS)], -1)


def _face_opacities(gaussians: CanonicalGaussians, faces: Int[Tensor, "F 3"]) -> Tensor:
    """Highest opacity of the Gaussians on each face, 0 where there is none.

    If no face has any, as in the hand of a small photo, the opacity is that of the vertices' Gaussians.
    """
    n_points = len(gaussians.vertex_index)
    if n_points == len(gaussians.opacities):
        at_vertices = gaussians.opacities.new_zeros(int(faces.max()) + 1)
        at_vertices = at_vertices.index_copy(0, gaussians.vertex_index, gaussians.opacities)
        return at_vertices[faces].mean(1)
    opacity = torch.zeros(len(faces), dtype=gaussians.opacities.dtype, device=gaussians.opacities.device)
    return opacity.scatter_reduce_(0, gaussians.face_index, gaussians.opacities[n_points:], "amax")


def _vertex_opacities(
    gaussians: CanonicalGaussians, faces: Int[Tensor, "F 3"], of_faces: Tensor, n_vertices: int
) -> Tensor:
    """Highest opacity around each vertex; a learned prior covers by faces where the vertices' Gaussians are faint."""
    own = gaussians.opacities[: len(gaussians.vertex_index)]
    opacity = own.new_zeros(n_vertices).index_copy(0, gaussians.vertex_index, own)
    return opacity.scatter_reduce_(0, faces.flatten(), of_faces.repeat_interleave(3), "amax")


def _inside(cut: Bool[Tensor, "F"], faces: Tensor, n_vertices: int) -> Bool[Tensor, "V"]:
    """Whether all faces of a vertex are cut."""
    whole = torch.zeros(n_vertices, dtype=torch.bool, device=faces.device)
    whole[faces[~cut].flatten()] = True
    return ~whole


def cut_faces(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], parts: Int[Tensor, "F"], looks: PartLooks
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 3"], Float[Tensor, "M 4"], Float[Tensor, "M 3"]]:
    """Faces, barycentrics, quaternions and scales [m] of Gaussians at the centres of `parts` an edge, 0 for none."""
    index, place = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, 3, dtype=vertices.dtype)]
    wanted = parts.cpu()
    for n in wanted.unique().tolist():
        if n:
            on = torch.nonzero(wanted == n)[:, 0]
            index.append(on.repeat_interleave(n * n))
            place.append(part_centers(n).to(vertices.dtype).repeat(len(on), 1))
    rows = torch.cat(index).to(parts.device)
    quats, scales = face_shapes(vertices, faces)
    long, short, across = (scales[rows] * (looks.spread / FACE_SPREAD / parts[rows, None])).unbind(1)
    scales = torch.stack([long, short, across.clamp_min(looks.thickness)], 1)
    return rows, torch.cat(place).to(parts.device), quats[rows], scales


@functools.cache
def part_centers(n: int) -> Float[Tensor, "P 3"]:
    """Barycentrics of the centres of the n^2 parts of a face, the upright parts first."""
    i, j = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    upright, turned = i + j < n, i + j < n - 1
    first = torch.cat([i[upright] + 1 / 3, i[turned] + 2 / 3]) / n
    second = torch.cat([j[upright] + 1 / 3, j[turned] + 2 / 3]) / n
    return torch.stack([1 - first - second, first, second], -1).double()


def read_at(
    gaussians: CanonicalGaussians,
    values: Float[Tensor, "N D"],
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    points: Float[Tensor, "M 3"],
) -> Float[Tensor, "M D"]:
    """Values of the nearest Gaussians at `points` of the surface at rest [m], each weighted by what it covers there."""
    centers = centers_at_rest(gaussians, vertices, faces)
    tree = cKDTree(centers.detach().cpu().double().numpy())
    count = min(NEIGHBOURS, len(centers))
    found = tree.query(points.detach().cpu().double().numpy(), count, workers=kernel_threads())
    far, near = (torch.from_numpy(np.asarray(part)).to(points.device).view(len(points), count) for part in found)
    # Along the surface only: a point of it may lie off a flat Gaussian's plane and still be under it.
    apart = far.to(points).square() / gaussians.scales[:, :2].prod(1)[near]
    weight = torch.softmax(-0.5 * apart, 1) * gaussians.opacities[near]
    weight = weight / weight.sum(1, keepdim=True).clamp_min(1e-12)
    return embedding_bag(near, values, per_sample_weights=weight.to(values), mode="sum")


COARSE_SPREAD = 1.6
"""Standard deviations along the surface over those of a vertex Gaussian that has face Gaussians beside it. With 1.3 a
lattice of gaps shows where the surface is drawn out; thicker ones make fingers fatter."""


def coarsen(hand: HandModel, gaussians: CanonicalGaussians, rest: PosedHand) -> CanonicalGaussians:
    """A third of the Gaussians: wider ones on the vertices alone, in the colours that all have there together.

    Args:
        hand: Model of the surface.
        gaussians: Gaussians of vertices and faces, on `rest`, without shade.
        rest: The surface at rest.
    """
    anchors = place_anchors(hand, rest)
    index, n = anchors.vertex_index, len(anchors.vertex_index)
    faces = hand.faces.to(index.device)
    colors = read_at(gaussians, gaussians.colors, rest.vertices, faces, rest.vertices[index])
    return CanonicalGaussians(
        index,
        rest.vertices.new_zeros(n, 3),
        anchors.face_index[:0],
        anchors.barycentrics[:0],
        anchors.quats[:n],
        anchors.scales[:n] * rest.vertices.new_tensor([COARSE_SPREAD, COARSE_SPREAD, 1.0]),
        anchors.opacities[:n],
        colors,
    )
