"""Paint what no photo shows: a plausible skin in the person's tone, joined to the seen skin without a seam."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.adaptation.fine_skin import SPACING
from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.reliability import VertexObservations
from oasis_warp.adaptation.skin_detail import SkinDetail, sample_detail
from oasis_warp.adaptation.skin_forms import flush_shade, joint_shade, relief_shade
from oasis_warp.adaptation.skin_grain import skin_grain
from oasis_warp.adaptation.skin_tone import MIN_COLOR, SkinTone, infer_tone
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.avatar.densify import SKIN, densify, parts_for_spacing
from oasis_warp.avatar.observation import observe
from oasis_warp.core import surface
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel
from oasis_warp.core.types import CanonicalGaussians, HandCrop

SEEN = 0.5
"""Confidence of an observation from which skin is left as the photo shows it."""
RIM_PASSES = 3
"""Smoothings over the mesh of the border between seen and painted skin, about 4 mm."""
JOIN_DETAIL, JOIN_REACH = 0.004, 0.04
"""Length below which seen colours are averaged for the join, and distance over which the painted skin leaves them for
the person's mean colours [m]."""
MAX_DIFFERENT = 0.3
"""Difference of the logarithms from the person's mean colours that is carried on: more is dirt, a ring or a shadow."""
SHOWS_FORM = 0.3
"""Cosine between normal and view from which a photo shows the forms of skin that it shows on a slant."""
DETAIL = 0.9
"""Gain of the maps' detail. With 1.25 on backs, which had fainter veins, skin looked mottled; with 1.6 on palms, which
had less grain, it had swirls like watercolour."""
LOUDEST_ON_PALM, LOUDEST_ON_BACK = 0.2, 0.12
"""Logarithms of sRGB that this detail tends to. The maps have the same contrast all over palms, not over backs."""
LINES_ON_PALM, LINES_ON_BACK = 1.8, 2.6
"""Gain of the drawn lines."""
FOLD, VEIN = (-0.10, -0.14, -0.15), (-0.14, -0.09, -0.09)
"""What a fold and a vein add to the logarithms of the colours."""
USUAL_CONTRASTS = 0.023, 0.016
"""Median difference of a vertex of a real palm and back from its surroundings, as the logarithm of sRGB: medians of the
52 photos of tests/data/photos/same_hand."""
OWN_POWER, OTHER_POWER = 0.5, 0.25
"""Power of a side's contrast over the usual one that is its gain, and that which is the gain of the side that no photo
shows. On 24 of those photos that show both sides, 10 % more on one side goes with 1.6 to 3.8 % more on the other."""
FINE_PASSES, SURELY_SEEN, FEWEST = 3, 0.97, 200
"""Smoothings over the mesh that leave a vertex's surroundings, 3 mm; confidence there from which it counts; fewest."""
CLARITIES = 0.5, 1.2
"""Least and most gain of detail."""
LUNULA, FREE_EDGE, NAIL_RIM = (0.02, 0.08, 0.08), (0.06, 0.22, 0.22), (-0.12, -0.16, -0.16)
"""What is added to the logarithms of the bed's colour on a nail's lunula and its free edge, and to skin in the fold
around it."""
BED = (0.0, -0.07, -0.05)
"""The same on the outer half of the bed, which has more blood."""
GLOSS, GLOSS_AT, GLOSS_WIDTH = 0.18, 0.15, 0.2
"""What a nail's gloss adds to the logarithms along a stripe, and takes beside it: where its normal leans to one side by
this sine, and the stripe's width."""
KNOWN_NAIL = 0.05
"""Share of all nails that must be seen to count as much as the mean person's."""


class OwnSkin(NamedTuple):
    """What the photos tell of skin that they do not show."""

    tone: SkinTone
    of_palm: float
    """Gain of detail on the palm that suits the photo."""
    of_back: float
    """The same on the back."""


class PaintedSkin(NamedTuple):
    """Gaussians with skin wherever no photo shows any."""

    gaussians: CanonicalGaussians
    invented: Float[Tensor, "V"]
    """1 where the skin is painted, 0 where it is as a photo shows it."""
    skin: OwnSkin


@torch.no_grad()
def paint_unseen(
    hand: HandModel,
    gaussians: CanonicalGaussians,
    guess: CanonicalGaussians,
    crop: HandCrop,
    observations: VertexObservations,
    *,
    seed: int,
) -> PaintedSkin:
    """Replace the colours of what was not seen.

    A painted place is exp(t + x + d). The mean colour t is that of the region in the person's tone (`infer_tone`). The
    membrane x continues the difference of the seen skin from it (`inpaint`). The detail d comes from real hands
    (`sample_detail`), with the skin's relief (`relief_shade`), blotches of blood (`flush_shade`), red joints
    (`joint_shade`) and grain (`skin_grain`). Where the seen skin ends, t + x is its own smooth colour, so that
    gradients continue and no seam shows. Seen skin gets grain, which its shade removes in the photo.

    Args:
        hand: Model of the surface.
        gaussians: Fitted to the photos, in even light, and as fine as the skin is to be (`cut_skin`).
        guess: Guess of the prior, before adaptation.
        crop: The first photo.
        observations: What the photos show, as far as it is skin: `Adaptation.trusted`.
        seed: Seed of the detail.
    """
    rest = crop.rest.vertices
    faces = hand.faces.to(rest.device)
    first = observe(hand, crop)
    shown = first.visibility * (first.facing > 0)
    confidence = observations.confidence.amax(0)
    invented = _unseen_share(hand, confidence)
    seen = vertex_colors(gaussians, len(rest))
    tone = infer_tone(hand, vertex_colors(guess, len(rest)), seen, confidence)
    difference = seen.clamp_min(MIN_COLOR).log() - tone.log_skin
    nail = skin_regions(hand).nail.to(rest)
    sure = ((confidence - SEEN) / (1 - SEEN)).clamp(0, 1) * (1 - nail)
    difference = difference.clamp(-MAX_DIFFERENT, MAX_DIFFERENT)
    smooth = inpaint(rest, faces, difference, sure, detail=JOIN_DETAIL, fade=JOIN_REACH)
    bed = _nail_color(tone, seen, confidence * nail, nail.sum())

    unknown = (1 - first.visibility * first.facing / SHOWS_FORM).clamp(0, 1)
    skin = OwnSkin(tone, *_clarities(hand, observations))
    form = _skin_form(hand, rest, seed) * unknown[:, None]
    painted, grain = _paint_on(
        hand, gaussians, rest, tone.log_skin + form + smooth, bed + smooth + _nail_form(hand, rest), skin, seed
    )
    shares = vertex_to_gaussians(torch.stack([invented, shown], 1), faces, gaussians).clamp(0, 1)
    return PaintedSkin(_mix(gaussians, painted, grain, *shares.split(1, 1)), invented, skin)


@torch.no_grad()
def paint_hand(
    hand: HandModel, guess: CanonicalGaussians, rest: Float[Tensor, "V 3"], skin: OwnSkin, *, seed: int
) -> CanonicalGaussians:
    """A hand that is painted all over: `paint_unseen` where nothing was seen.

    Args:
        hand: Model of the surface.
        guess: Guess of the prior, whose places and shapes are taken.
        rest: The surface at rest [m].
        skin: Of its person.
        seed: Seed of the detail.
    """
    faces = hand.faces.to(rest.device)
    fine = densify(guess, rest, faces, parts_for_spacing(rest, faces, SPACING), SKIN).gaussians
    nails = skin.tone.log_nail + _nail_form(hand, rest)
    painted, _ = _paint_on(hand, fine, rest, skin.tone.log_skin + _skin_form(hand, rest, seed), nails, skin, seed)
    return fine._replace(colors=painted.exp().clamp(MIN_COLOR, 1), shade=None)


def _skin_form(hand: HandModel, rest: Float[Tensor, "V 3"], seed: int) -> Float[Tensor, "V 3"]:
    """What relief and blood add to the logarithms of bare skin."""
    bare = 1 - skin_regions(hand).nail.to(rest)
    return (relief_shade(hand, seed) + flush_shade(hand, seed) + joint_shade(hand)).to(rest) * bare[:, None]


def _paint_on(
    hand: HandModel, gaussians: CanonicalGaussians, rest: Float[Tensor, "V 3"], skin: Float[Tensor, "V 3"],
    nails: Float[Tensor, "V 3"], own: OwnSkin, seed: int,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 1"]]:  # fmt: skip
    """Logarithms of the Gaussians' colours, from those of smooth skin and nails at the vertices, and their grain."""
    palm = skin_regions(hand).palm.to(rest)[:, None]
    read = vertex_to_gaussians(torch.cat([skin, nails, palm], 1), hand.faces.to(rest.device), gaussians)
    sample = sample_detail(hand, gaussians, seed)
    gain = own.of_back + (own.of_palm - own.of_back) * read[:, 6:]
    grain = gain * skin_grain(hand, gaussians, seed)[:, None]
    return _paint(sample, read[:, :3] + gain * _skin_detail(sample, read[:, 6:]) + grain, read[:, 3:6]), grain


def _mix(
    gaussians: CanonicalGaussians, painted: Float[Tensor, "N 3"], grain: Tensor, invented: Tensor, shown: Tensor
) -> CanonicalGaussians:
    """The Gaussians with the painted colours where they are invented, and with `grain` where they are not.

    What the first photo shows becomes shade: it stays in the photo's own view and goes when the skin turns. Without
    shade it stays as it is.
    """
    if gaussians.shade is None:
        invented, grain = invented * (1 - shown), torch.zeros_like(grain)
    logs = gaussians.colors.clamp_min(MIN_COLOR).log()
    colors = torch.lerp(logs + grain, painted, invented).exp().clamp(MIN_COLOR, 1)
    if gaussians.shade is None:
        return gaussians._replace(colors=torch.where(invented > 0, colors, gaussians.colors))
    beyond = torch.maximum(shown, 1 - invented) * (logs - colors.log())
    return gaussians._replace(colors=colors, shade=gaussians.shade * beyond.exp())


def _unseen_share(hand: HandModel, confidence: Float[Tensor, "V"]) -> Float[Tensor, "V"]:
    """1 unseen, 0 seen, smooth along the border; the border lies on the side that the photo hardly shows."""
    hidden = (1 - confidence / SEEN).clamp(0, 1)[:, None]
    smooth = surface.smooth_over_mesh(hidden, surface.mesh_edges(hand.faces).to(hidden.device), RIM_PASSES)
    return torch.minimum(smooth, (hidden > 0).to(smooth))[:, 0]


def _nail_form(hand: HandModel, rest: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
    """Blood below each nail, and a stripe along it where it reflects the sky: paint, which goes with the nail."""
    normals = surface.vertex_normals(rest, hand.faces.to(rest.device))
    on_nail, form = skin_regions(hand).nail.to(normals), torch.zeros_like(normals)
    for joint in TIP_JOINTS:
        on_bone = hand.segment.to(rest.device) == joint
        own, place = on_bone & (on_nail > 0), hand.bone_t.to(rest)[on_bone, None]
        along = ((place - place.mean()) * rest[on_bone]).sum(0)
        across = normalize(torch.linalg.cross(normals[own].mean(0), along), dim=0)
        stripe = (-(((normals[own] @ across - GLOSS_AT) / GLOSS_WIDTH) ** 2)).exp()[:, None]
        place = hand.bone_t.to(rest)[own, None]
        outer = (2 * (place - place.amin()) / (place.amax() - place.amin()) - 0.5).clamp(0, 1)
        form[own] = GLOSS * (stripe - stripe.mean()) + outer * form.new_tensor(BED)
    return form * on_nail[:, None]


def _nail_color(tone: SkinTone, seen: Tensor, weight: Float[Tensor, "V"], total: Tensor) -> Float[Tensor, "3"]:
    """Logarithm of a nail's colour: the mean person's, or that of the nails that were seen."""
    known = weight.sum() / total
    own = (weight[:, None] * seen.clamp_min(MIN_COLOR).log()).sum(0) / weight.sum().clamp_min(1e-9)
    return torch.lerp(tone.log_nail, own, known / (known + KNOWN_NAIL))


def _skin_detail(detail: SkinDetail, palm: Float[Tensor, "N 1"] | float) -> Float[Tensor, "N 3"]:
    """What is added to the logarithms of smooth skin's colours; `palm` is its share."""
    folds = (LINES_ON_BACK + (LINES_ON_PALM - LINES_ON_BACK) * palm) * detail.fold[:, None]
    lines = folds * detail.skin.new_tensor(FOLD) + detail.vein[:, None] * detail.skin.new_tensor(VEIN)
    own = DETAIL * detail.skin
    loudest = LOUDEST_ON_BACK + (LOUDEST_ON_PALM - LOUDEST_ON_BACK) * palm
    return loudest * torch.tanh(own / loudest) + lines


def _clarities(hand: HandModel, observations: VertexObservations) -> tuple[float, float]:
    """Gains of detail on palm and back that suit the photo.

    Detailed skin beside the smooth skin of a soft or bright photo looks old and dirty. A gain is a power of the
    contrast from vertex to vertex, in the photo that shows most, over `USUAL_CONTRASTS`; a third of what differs
    between photos here is noise and relief. A smooth back says little of its palm.
    """
    best = int(observations.confidence.sum(1).argmax())
    edges = surface.mesh_edges(hand.faces).to(observations.colors.device)
    logs = observations.colors[best].clamp_min(MIN_COLOR).log().mean(1, keepdim=True)
    fine = (logs - surface.smooth_over_mesh(logs, edges, FINE_PASSES))[:, 0].abs()
    inner = surface.smooth_over_mesh(observations.confidence[best][:, None], edges, FINE_PASSES)[:, 0] > SURELY_SEEN
    palm = skin_regions(hand).palm.to(fine) > 0.5
    sides = [fine[inner & side] for side in (palm, ~palm)]
    palm, back = (
        float(own.median()) / usual if len(own) >= FEWEST else None
        for own, usual in zip(sides, USUAL_CONTRASTS, strict=True)
    )
    return _gain_of(palm, back), _gain_of(back, palm)


def _gain_of(own: float | None, other: float | None) -> float:
    """The gain of a side with these contrasts of its own and of the other side, over the usual; None is unknown."""
    low, high = CLARITIES
    gain = own**OWN_POWER if own is not None else other**OTHER_POWER if other is not None else 1.0
    return min(max(gain, low), high)


def _paint(detail: SkinDetail, skin: Float[Tensor, "N 3"], nail: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Logarithms of the colours of skin, and of nails with their parts."""
    lunula, free, rim = (skin.new_tensor(part) for part in (LUNULA, FREE_EDGE, NAIL_RIM))
    pale = detail.pale[:, None]
    plate = nail + pale.clamp_min(0) * lunula + (-pale).clamp_min(0) * free
    return torch.lerp(skin, plate, detail.plate[:, None]) + detail.rim[:, None] * rim
