"""The end of the hand at the wrist: opaque skin up to the rim, and an arm that fades."""

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
    centers_at_rest,
    rim_fade,
    surface_frames,
    vertex_shapes,
    vertex_to_gaussians,
)
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.arm_skin import DARKEST, MIRRORED, arm_colors
from oasis_warp.avatar.densify import GROUND_DEPTH, SKIN, cut_faces, ground_discs, parts_for_spacing
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians, HandLight

END, OVERLAP = 0.5, 0.8
"""Shares of opacity left by the fade at the wrist, below which Gaussians end and their opaque replacements begin."""
SHADE_FADE = 0.022
"""The stretch before that fade over which the photo's shade ends [m]: that of a sleeve, or of the turn into the arm,
looks like a burn where the arm is missing."""
LEFT = 0.5
"""Share of the photo's shade that is left where the hand's own colours end to turn into those of the arm."""
ARM_LENGTH = 0.12
"""The stretch past the rim over which an arm fades out [m]: a hand that ends at once looks sawn off, and one whose arm
fades within the picture, as 6 cm did beside a thumb that points up, looks cut out."""
ARM_GROWTH = 0.2
"""How much wider the arm is at its end than at the rim."""
BEFORE_RIM, ASIDE = 0.008, 0.004
"""Stretch of skin before the rim whose direction the arm follows, and width along the rim of what is averaged [m]."""
STRAIGHT = 0.008
"""Length over which the arm turns from the direction of the skin before the rim into its own [m]: with a sudden turn
outlines had a step. Set by eye on two hands."""
ARM_STEP, LAST_STEP = 0.001, 0.0016
"""Distance of the arm's Gaussians at the rim, where skin is not finer, and at its end [m]: with 2 mm at the rim the
skin's detail ended there, with 3 mm at the end the arm was blurred."""
FILL_STEP, FILL_SPREAD, FILL_DEPTH = 0.004, 0.8, 0.007
"""Distance of the balls that fill the arm [m], their standard deviation over it, and how deep the first lie [m]: nearer
to the skin they blur the arm's outline."""
ARM_LAYERS, FILL_LAYERS = 1.5, 12.0
"""Numbers of the arm's Gaussians and of balls one behind the other, each of them so much fainter. There are more balls,
so the arm is opaque for 6 cm and then fades."""
RIM_PARTS = -0.4, -0.2, 0.0, 0.2, 0.4
"""Places of Gaussians along the edges at a vertex of the rim, as shares of the edge: one on each vertex makes teeth."""
RIM_SPREAD = 0.8
"""Standard deviation of the rim's Gaussians over their distance."""
WALL_SPREAD = 1.3
"""Standard deviations of the arm's Gaussians over those of vertex Gaussians: no face Gaussians fill their gaps."""


def close_wrist(
    hand: HandModel, gaussians: CanonicalGaussians, rest: Float[Tensor, "V 3"], spacing: float = ARM_STEP,
    *, seed: int = 0,
) -> CanonicalGaussians:  # fmt: skip
    """Close the hand at the wrist, where a prior's opacity fades out because photos show an arm there.

    Gaussians in the second half of the fade are replaced by opaque ones on parts of faces, over discs at the vertices;
    the others become as opaque as they were before the fade. The Gaussians of the arm are bound to rim vertices. New
    Gaussians have the colours of `arm_colors`, without shade; the colours and the shade of the others end before.

    Args:
        hand: Model of the surface.
        gaussians: On `rest`.
        rest: The surface at rest [m].
        spacing: Distance of the new Gaussians at the rim [m].
        seed: Of the arm's skin.
    """
    faces, rim = hand.faces.to(rest.device), hand.rim.to(rest.device)
    quats, scales = vertex_shapes(rest, faces, surface.faces_of_vertices(faces, len(rest)))
    at_vertices = rim_fade(rest[None], rim)[0]
    at_faces = at_vertices[faces].mean(1)
    own = torch.cat([at_vertices[gaussians.vertex_index], at_faces[gaussians.face_index]])
    kept = gaussians._replace(opacities=(gaussians.opacities / own.clamp_min(END)).clamp(max=OPACITY))
    kept, n_kept = select(kept, own > END), int((own[: len(gaussians.vertex_index)] > END).sum())
    inside = torch.ones_like(at_vertices).index_fill(0, rim, 0) > 0
    vertices, on_faces = (torch.nonzero(part)[:, 0] for part in ((at_vertices < OVERLAP) & inside, at_faces < OVERLAP))
    parts = torch.zeros_like(hand.faces[:, 0]).to(rest.device)
    parts[on_faces] = parts_for_spacing(rest, faces[on_faces], spacing)
    on_faces, places, face_quats, face_scales = cut_faces(rest, faces, parts, SKIN)
    *arm, arm_opacities = fading_arm(rest, rim, spacing)
    end = rim_line(rest, rim, quats[rim]), arm
    index, offsets, end_quats, end_scales = (torch.cat(parts) for parts in zip(*end, strict=True))
    discs = ground_discs(SKIN.ground * scales[vertices])
    points = torch.cat([rest[vertices], rest[index] + offsets])
    on_parts = (rest[faces[on_faces]] * places[..., None]).sum(1)
    left = vertex_to_gaussians(shade_left(hand, rest), faces, kept)
    near = torch.nonzero(left[:, 0] < LEFT)[:, 0]
    wanted = torch.cat([points, on_parts, centers_at_rest(kept, rest, faces)[near]])
    known = (own >= 1) & (torch.cdist(centers_at_rest(gaussians, rest, faces), rest[rim]).amin(1) < MIRRORED)
    palm = (skin_regions(hand).palm.to(rest)[:, None] * surface.vertex_normals(rest, faces)).sum(0)
    skin = select(gaussians, known)
    *read, calm = arm_colors(skin, rest, faces, rim, rim_axis(rest, rim), palm, wanted, seed).split(
        [len(points), len(on_faces), len(near)]
    )
    calm = calm.clamp_min(DARKEST)
    mixed = calm * (kept.colors[near].clamp_min(DARKEST) / calm) ** (left[near] / LEFT)
    kept = kept._replace(colors=kept.colors.index_copy(0, near, mixed))

    opaque = rest.new_full((len(points) + len(on_faces) - len(arm_opacities),), OPACITY)
    on_points, of_faces = opaque.split([len(points) - len(arm_opacities), len(on_faces)])

    def joined(old: Tensor, of_points: Tensor, of_faces: Tensor) -> Tensor:
        return torch.cat([old[:n_kept], of_points, old[n_kept:], of_faces])

    shade = kept.shade
    if shade is not None:
        shade = shade**left
    return CanonicalGaussians(
        torch.cat([kept.vertex_index, vertices, index]),
        torch.cat([kept.offsets, -GROUND_DEPTH * surface.vertex_normals(rest, faces)[vertices], offsets]),
        torch.cat([kept.face_index, on_faces]),
        torch.cat([kept.barycentrics, places]),
        joined(kept.quats, torch.cat([quats[vertices], end_quats]), face_quats),
        joined(kept.scales, torch.cat([discs, end_scales]), face_scales),
        joined(kept.opacities, torch.cat([on_points, arm_opacities]), of_faces),
        joined(kept.colors, *read),
        None if shade is None else joined(shade, *(torch.ones_like(part) for part in read)),
    )


def end_shade(hand: HandModel, light: HandLight, rest: Float[Tensor, "V 3"]) -> HandLight:
    """`light` whose shade ends before the wrist, as the shade of Gaussians does in `close_wrist`."""
    return light if light.shade is None else light._replace(shade=light.shade ** shade_left(hand, rest))


def shade_left(hand: HandModel, rest: Tensor) -> Float[Tensor, "V 1"]:
    """The power of the photo's shade that is left at each vertex: 0 at the wrist's end, 1 before `SHADE_FADE`."""
    return rim_fade(rest[None], hand.rim.to(rest.device), RIM_FADE, SHADE_FADE)[0, :, None]


def rim_axis(rest: Float[Tensor, "V 3"], rim: Int[Tensor, "R"]) -> Float[Tensor, "3"]:
    """Normal of the rim, away from the hand."""
    middle = rest[rim].mean(0)
    arms = rest[rim] - middle
    axis = normalize(torch.linalg.cross(arms, arms.roll(-1, 0)).sum(0), dim=0)
    return axis * torch.sign((axis * (middle - rest.mean(0))).sum())


def arm_axis(rest: Float[Tensor, "V 3"], rim: Int[Tensor, "R"]) -> Float[Tensor, "3"]:
    """Direction in which the arm goes on: half way from the rim's normal to the direction of the skin before it.

    They differ by 17 degrees. Along the normal the arm turned back from the palm, with a step at the rim; along the
    skin, which is flared, it stepped on the back.
    """
    axis = rim_axis(rest, rim)
    return normalize(axis + _slopes(rest, rim, axis).mean(0), dim=0)


def hand_up(hand: HandModel, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "3"]:
    """Direction from the arm to the hand, for posed `vertices`: an orbit around it sees the hand from all sides.

    Around the picture's vertical, a hand that points to the side would also be seen along its arm.
    """
    return -arm_axis(vertices, hand.rim.to(vertices.device))


def _slopes(rest: Tensor, rim: Tensor, axis: Tensor) -> Float[Tensor, "R 3"]:
    """How far the skin before each point of the rim leads away from the `axis`, for each length along it."""
    at = rest - rest[rim].mean(0)
    along = at @ axis
    arms = at - along[:, None] * axis
    radii, outward = arms.norm(dim=1), normalize(arms, dim=1)
    before = torch.nonzero((along < 0) & (torch.cdist(rest, rest[rim]).amin(1) < BEFORE_RIM))[:, 0]
    apart = torch.cdist(outward[rim], outward[before]) * radii[rim].mean()
    share = torch.softmax(-0.5 * (apart / ASIDE).square(), 1)
    run, rise = along[before] - along[rim][:, None], radii[before] - radii[rim][:, None]
    lean = (share * run * rise).sum(1) / (share * run.square()).sum(1)
    return lean[:, None] * outward[rim]


def rim_line(
    rest: Float[Tensor, "V 3"], rim: Int[Tensor, "R"], quats: Float[Tensor, "R 4"]
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 3"], Float[Tensor, "M 4"], Float[Tensor, "M 3"]]:
    """Vertices of the rim, offsets, quaternions and scales [m] of Gaussians along it, oriented as its vertices are."""
    edge, n = rest[rim], len(RIM_PARTS)
    before, after = edge.roll(1, 0) - edge, edge.roll(-1, 0) - edge
    offsets = torch.stack([part * after if part > 0 else -part * before for part in RIM_PARTS], 1).flatten(0, 1)
    spread = RIM_SPREAD / n * (before.norm(dim=1) + after.norm(dim=1)) / 2
    scales = torch.stack([spread, spread, THICKNESS * spread], 1)
    return rim.repeat_interleave(n), offsets, quats.repeat_interleave(n, 0), scales.repeat_interleave(n, 0)


def fading_arm(
    rest: Float[Tensor, "V 3"], rim: Int[Tensor, "R"], spacing: float = ARM_STEP
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 3"], Float[Tensor, "M 4"], Float[Tensor, "M 3"], Float[Tensor, "M"]]:
    """Vertices, offsets, quaternions, scales [m] and opacities of an arm that continues the rim and fades out.

    Its Gaussians lie `spacing` [m] apart at the rim. It is filled: seen along the arm, the hand would be hollow.
    """
    edge, axis = rest[rim], arm_axis(rest, rim)
    slopes = _slopes(rest, rim, axis)
    radius = float((edge - edge.mean(0)).norm(dim=1).mean())
    last = LAST_STEP / spacing
    n_walls = round(ARM_LENGTH / spacing * math.log(last) / (last - 1))
    coarser = [last ** (k / n_walls) for k in range(1, n_walls)]
    walls = [((ratio - 1) / (last - 1), 1.0, ratio * spacing) for ratio in coarser]
    sections = [k * FILL_STEP for k in range(1, round(ARM_LENGTH / FILL_STEP))]
    inner = radius - FILL_DEPTH
    n_rings = round(inner / FILL_STEP)
    places = [(k + 0.5) / n_rings * inner / radius for k in range(n_rings)]
    fill = [(height / ARM_LENGTH, place, FILL_STEP) for height in sections for place in places]
    share, out, length = torch.tensor(walls + fill, dtype=torch.float64, device=rest.device).T
    inside, height = out < 1, share * ARM_LENGTH
    ring, index, arm, outward, tangent, flare = _rings(edge, axis, length / out, slopes)

    def at_points(of_rings: Tensor) -> Float[Tensor, "M D"]:
        return of_rings.reshape(len(out), -1)[ring].to(rest)

    wide, left = out * (1 + ARM_GROWTH * share.square()), (-height / STRAIGHT).exp()
    turned = at_points(out * STRAIGHT * (1 - left)) * flare
    offsets = edge.mean(0) + at_points(wide) * arm + turned + at_points(height) * axis - edge[index]
    outward = normalize(outward, dim=-1)
    tilt = at_points(left) * (flare * outward).sum(1, keepdim=True) * axis
    normals = torch.where(inside[ring, None], axis, normalize(outward - tilt, dim=-1))
    scales = torch.where(inside[:, None], _balls(length), _discs(length))
    seen, layers = OPACITY * (1 - share).square() * (1 + 2 * share), torch.where(inside, FILL_LAYERS, ARM_LAYERS)
    opacities = 1 - (1 - seen) ** (1 / layers)
    return rim[index], offsets, surface_frames(normals, tangent), at_points(scales), at_points(opacities)[:, 0]


def _rings(
    edge: Float[Tensor, "R 3"], axis: Float[Tensor, "3"], lengths: Float[Tensor, "K"], *fields: Float[Tensor, "R 3"]
) -> tuple[Tensor, ...]:
    """K rings of points on the rim, in each about a length apart: ring, nearest point of the rim, arm, outward, along.

    Every other ring is shifted by half a length; arms start in the middle. After these, each [M] or [M, 3], come the
    `fields` of the rim's points, interpolated.
    """
    arms, n = edge - edge.mean(0), len(edge)
    along = arms.roll(-1, 0) - arms.roll(1, 0)
    outward = torch.linalg.cross(along, axis.expand_as(along))
    outward = outward * torch.sign((outward * arms).sum())
    around = float((edge - edge.roll(1, 0)).norm(dim=1).sum())
    counts = (around / lengths).round().long().clamp_min(1)
    ring = torch.arange(len(counts), device=edge.device).repeat_interleave(counts)
    number = torch.arange(len(ring), device=edge.device) - (counts.cumsum(0) - counts)[ring]
    place = (number + 0.5 * (ring % 2)) * (n / counts)[ring]
    first, second = place.long() % n, (place.long() + 1) % n
    between = (place - place.floor()).to(arms)[:, None]
    known = torch.cat([arms, outward, along, *fields], 1)
    read = torch.lerp(known[first], known[second], between).split(3, 1)
    return ring, torch.where(between[:, 0] < 0.5, first, second), *read


def _discs(lengths: Float[Tensor, "K"]) -> Float[Tensor, "K 3"]:
    """Scales of flat Gaussians that lie `lengths` apart."""
    spread = WALL_SPREAD * VERTEX_SPREAD * lengths / math.sqrt(math.pi)
    return torch.stack([spread, spread, THICKNESS * spread], 1)


def _balls(lengths: Float[Tensor, "K"]) -> Float[Tensor, "K 3"]:
    """The same of balls."""
    return FILL_SPREAD * lengths[:, None].expand(-1, 3)


def select(gaussians: CanonicalGaussians, kept: Bool[Tensor, "N"]) -> CanonicalGaussians:
    """Some of the Gaussians."""
    points, on_faces = kept.split([len(gaussians.vertex_index), len(gaussians.face_index)])
    vertex_index, offsets, face_index, barycentrics, *rest = gaussians
    return CanonicalGaussians(
        vertex_index[points], offsets[points], face_index[on_faces], barycentrics[on_faces],
        *(None if part is None else part[kept] for part in rest),
    )  # fmt: skip
