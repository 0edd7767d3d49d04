"""The split of what photos show beyond a guess into albedo and shade.

Two photos of one hand agree on little of what they show beyond the prior. Where skin faces as before, a third to a half
of it is found again; where skin has turned by more than 45 degrees, a tenth at most (docs/avatar.md). The rest is
shadows, gloss, wrinkles of the pose, and misplaced detail. So most of what is wide becomes shade: the photo's own view
keeps it and other poses lose it. Marks whose colours light cannot give to skin stay in the albedo as a whole, and so
does what is fine: a hand without pores, creases and relief looks like wax.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.adaptation.sh_lighting import MAX_LOG_SHADE, MIN_COLOR
from oasis_warp.avatar.anchors import vertex_colors, vertex_to_gaussians
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import CanonicalGaussians

MIN_SHOWN = 1e-3
"""Least colour that comes out of colours and shade, which is a factor above 0."""
ALBEDO_SHARE, FINE_SHARE = 0.2, 1.2
"""Share of a difference that is no mark which becomes albedo, and that of its fine part: creases, folds and the rims of
nails stay on the skin, and light hardly changes so fast on it, but in sharp shadows beside outlines, which go before
(`scraps`). Set by eye, as the three below. Fine skin is drawn fainter than it is, so there is more of it: with 1.0, ten
photos keep .02 less of their contrast at 1-4 px on turned skin."""
FINE_PASSES, FINE_PASSES_AT_WRIST = 60, 9
"""Smoothings over the mesh that leave the wide part, about 15 mm and 6 mm. With 9 everywhere, four photos of same_hand
keep .65 of their contrast at 4-8 px in other poses, with 60 .72; but where the hand turns into the arm, wider folds are
smears on a hand without its arm."""
END_PASSES, LOCAL_PASSES = 18, 3
"""Smoothings over the mesh of the end of what photos show, about 8 mm, and those that leave what is wide there, 3 mm.
"""
DARKEST_FINE, BRIGHTEST_FINE, MOST_HUE = 0.3, 0.15, 0.06
"""Largest fine part that is darker, that is brighter, and that differs between channels, as logarithms; more is a sharp
shadow, gloss, or another part of the hand. With .3 for all, folds of a squeezed palm stayed as red gashes, and the
light on a finger's tip as white spots; eight photos of same_hand lose .01 of their contrast in other poses."""
SURE_FOLD, SURE_SHADOW = 0.5, 0.8
"""How dark a difference is, as the mean of the logarithms, up to which it may be a crease of the skin, and from which
it is a shadow of the pose and nothing of it stays: the fold of a squeezed palm was a wound in the opened one. Set by
eye on one photo of same_hand."""
BESIDE_SHADOW, SOFT_SHADOW = 4, 3
"""Rings of vertices around such a shadow that go with it, and smoothings of its border."""
FLAT = 0.004
"""Deviation of places [m] below which they do not tell a slope: across the skin, and on the width of a crease."""
BRIGHT_AT_END = 0.3
"""Share of the largest brighter part that is left where photos end: there it is the photo's background."""
ACROSS_SHADING = ((-18.0, 21.3, -7.5), (8.8, 4.6, -8.1))
"""Shading moves the logarithms of skin colours along one line, from dark and red to bright and pale. These two
directions are perpendicular to it, each divided by the standard deviation there, measured on photos of bare hands."""
MARK_DISTANCES = 3.5, 7.0
"""Distances from that line, in standard deviations, at which a difference begins to count as a mark and at which it
surely is one. 98 % of the vertices of bare skin are below the first; half-transparent ink has 5, ink 15, polish 24."""
SHADOW_SLOPE = 0.6
"""By how much those distances grow for each unit by which a difference is dark and redder or yellower than the line:
deep between fingers light has come through skin, and cameras lose blue first. Set on a shadow beside a thumb in one
photo of same_hand; ink is bluer."""
CRUSHED = 0.05
"""What is added to sRGB colours before marks are told by their ratio: that of channels that are next to black tells
nothing. In one photo the shadow between two tendons had no blue, and was a brown burn in every pose."""
MARK_BRIGHTNESSES = 0.45, 0.7
"""The same for the mean of the logarithms, for bright marks: 99 % of bare skin is below the first."""


def split_albedo_shading(
    hand: HandModel, guess: Float[Tensor, "N 3"], learned: CanonicalGaussians, trust: Float[Tensor, "V"] | None = None,
    hand_share: Float[Tensor, "V"] | None = None, seen: Float[Tensor, "V"] | None = None,
) -> CanonicalGaussians:  # fmt: skip
    """Split off part of the learned Gaussians' colours as shade; colours times shade stay as they were.

    Args:
        hand: Model of the surface.
        guess: Colours of the Gaussians before they were learned.
        learned: In even light.
        trust: Result of `trust_in_albedo`, 1 if not given: the rest of what was learned is all shade, marks or not.
        hand_share: 0 where the hand turns into the arm and less of what is wide stays, 1 before; 1 if not given.
        seen: How well the photos show the skin of each vertex, above 0; 1 if not given. What is wide is read from what
            they show: with the rest, skin that a photo shows dark on a slant kept a dark edge where the photo ends.
    """
    ratio = learned.colors.clamp_min(MIN_COLOR) / guess.clamp_min(MIN_COLOR)
    beyond = ratio.log().clamp(-MAX_LOG_SHADE, MAX_LOG_SHADE)
    of_vertices = vertex_colors(learned._replace(colors=beyond), len(hand.template))
    told = ((learned.colors + CRUSHED) / (guess + CRUSHED)).log().clamp(-MAX_LOG_SHADE, MAX_LOG_SHADE)
    no_mark = 1 - mark_probability(vertex_colors(learned._replace(colors=told), len(hand.template)))
    faces = hand.faces.to(guess.device)
    edges = surface.mesh_edges(faces)
    trust, hand_share, seen = (
        torch.ones_like(no_mark[:, 0]) if share is None else share for share in (trust, hand_share, seen)
    )
    openly = torch.maximum(seen_around(trust, edges), 1 - hand_share[:, None])
    wide = _wide_part(hand.template.to(guess.device), edges, of_vertices, seen, hand_share)
    wide = torch.lerp(_local_mean(of_vertices, edges, seen), wide, openly)
    no_shadow = 1 - _shadow_of_pose(of_vertices, edges)
    read = vertex_to_gaussians(torch.cat([wide, no_mark, no_shadow, trust[:, None], openly], 1), faces, learned)
    wide, no_mark, no_shadow, trust, openly = read.split([3, 1, 1, 1, 1], 1)
    fine = FINE_SHARE * (beyond - wide)
    grey = fine.mean(1, keepdim=True)
    brightest = BRIGHTEST_FINE * (BRIGHT_AT_END + (1 - BRIGHT_AT_END) * openly)
    fine = torch.minimum(grey.clamp_min(-DARKEST_FINE), brightest) + (fine - grey).clamp(-MOST_HUE, MOST_HUE)
    skin = no_shadow * torch.lerp(fine, beyond, ALBEDO_SHARE * openly)
    albedo = trust * torch.lerp(beyond, skin, no_mark)
    colors = (guess.clamp_min(MIN_COLOR) * albedo.exp()).clamp(max=1)
    return learned._replace(colors=colors, shade=learned.colors.clamp_min(MIN_SHOWN) / colors)


def _wide_part(
    places: Float[Tensor, "V 3"], edges: Int[Tensor, "E 2"], beyond: Float[Tensor, "V 3"], seen: Float[Tensor, "V"],
    hand_share: Float[Tensor, "V"],
) -> Float[Tensor, "V 3"]:  # fmt: skip
    """What varies over long distances of a difference: at each vertex a linear fit to those around it.

    A mean is wrong where the photo ends: there it is one of brighter skin only, and all skin on a slant seemed dark.
    """
    point = torch.cat([torch.ones_like(places[:, :1]), places - places.mean(0)], 1)
    terms = point[:, :, None] * torch.cat([point, beyond], 1)[:, None]  # [V, 4, 7]
    weighted = (seen[:, None, None] * terms).flatten(1)
    narrow = surface.smooth_over_mesh(weighted, edges, FINE_PASSES_AT_WRIST)
    wide = surface.smooth_over_mesh(narrow, edges, FINE_PASSES - FINE_PASSES_AT_WRIST)
    flat = FLAT**2 * torch.tensor([0.0, 1.0, 1.0, 1.0], dtype=torch.float64, device=edges.device).diag()

    def at_vertices(moments: Tensor) -> Tensor:
        squares, products = moments.double().view(terms.shape).split([4, 3], 2)
        linear = torch.linalg.solve(squares + squares[:, :1, :1] * flat, products)
        return (point[:, None].double() @ linear)[:, 0].to(beyond)

    return torch.lerp(at_vertices(narrow), at_vertices(wide), hand_share[:, None])


def seen_around(seen: Float[Tensor, "V"], edges: Int[Tensor, "E 2"]) -> Float[Tensor, "V 1"]:
    """1 where photos show all skin around, 0 where what they show ends."""
    return (2 * surface.smooth_over_mesh(seen[:, None], edges, END_PASSES) - 1).clamp(0, 1)


def _local_mean(
    beyond: Float[Tensor, "V 3"], edges: Int[Tensor, "E 2"], seen: Float[Tensor, "V"]
) -> Float[Tensor, "V 3"]:
    """Mean of a difference at and beside each vertex, of what photos show."""
    weighted = torch.cat([seen[:, None] * beyond, seen[:, None]], 1)
    total, weight = surface.smooth_over_mesh(weighted, edges, LOCAL_PASSES).split([3, 1], 1)
    return total / weight


def _shadow_of_pose(beyond: Float[Tensor, "V 3"], edges: Int[Tensor, "E 2"]) -> Float[Tensor, "V 1"]:
    """How likely a difference is, or lies beside, a shadow too dark for a crease, 0 to 1."""
    dark = ((-beyond.mean(1) - SURE_FOLD) / (SURE_SHADOW - SURE_FOLD)).clamp(0, 1)
    at, beside = torch.cat([edges, edges.flip(1)]).unbind(1)
    for _ in range(BESIDE_SHADOW):
        dark = dark.scatter_reduce(0, at, dark[beside], "amax")
    return surface.smooth_over_mesh(dark[:, None], edges, SOFT_SHADOW)


def mark_probability(beyond: Float[Tensor, "V 3"]) -> Float[Tensor, "V 1"]:
    """Probability that a difference of the logarithms of colours is a mark on the skin and not light."""
    across, bright = beyond @ beyond.new_tensor(ACROSS_SHADING).T, beyond.mean(-1)
    as_in_shadow = (across[..., 0] < 0) | (across[..., 1] > 0)
    wider = torch.where(as_in_shadow, 1 + SHADOW_SLOPE * (-bright).clamp_min(0), 1)
    likely = [
        ((measure - low) / (high - low)).clamp(0, 1)
        for measure, (low, high) in ((across.norm(dim=-1) / wider, MARK_DISTANCES), (bright, MARK_BRIGHTNESSES))
    ]
    return torch.maximum(*likely)[:, None]
