"""What is wide on skin: knuckles, tendons and pads that stand out, blotches of blood, red joints and fingertips.

Relief is paint: what stands out is brighter skin, hollows are darker. Its forms are made by
`asset_build/build_skin_detail.py` from those of the synthetic world.
"""

import functools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.avatar.appearance import skin_regions
from oasis_warp.core import surface
from oasis_warp.core.hand_model import TIP_JOINTS, HandModel, finger_of

FORM_UNIT = 0.02
"""Height of one step of the stored forms [mm]."""
PER_MM = (0.133, 0.154, 0.168)
"""What a millimetre above the skin around adds to the logarithms of sRGB. Light from one side at 45 degrees changes on
the flank of a tendon, of slope .4, by 37 % to either side: by .17 in sRGB, and tendons stand out by .6 mm. A little
more than half of the light is taken to be from all around. With 1.4 times as much, and `TENDONS` of .3 to .9, backs
have more of real hands' contrast, but blind graders saw painted stripes and a skeleton: 10 : 3 for this on 14 hands of
tests/data/photos/same_hand."""
PALM_PER_MM = (0.26, 0.39, 0.42)
"""The same on palms: light that reached a hollow through the skin is red. With two thirds of it, palms looked flat."""
ON_PADS, FINGER_PASSES = 0.25, 6
"""How much of that fingers have on the palm's side, and the smoothings over the mesh at which it begins. With all of it
pads were pale between wide dark bands at the joints: +-.12, where 23 photos of tests/data/photos and its same_hand have
+-.04; with this, painted pads have the same."""
WIDE, WIDE_PASSES = 1.3, 6
"""How much more the wide part of a back's relief adds, and the smoothings over the mesh that leave it, 5 mm. With .85
hidden backs had .56 of real hands' contrast at 4-8 px, with this .60 (17 photos of same_hand, when all relief added 1.4
times as much as now)."""
MOST, DEEPEST = 0.7, 0.35
"""Height above and depth below the skin around to which forms are clamped [mm]: creases of palms are lines of the maps
besides, and deeper hollows between knuckles looked like bruises."""
HIGHEST = 0.35
"""Height that forms of palms tend to [mm]: the ball of the thumb had a white patch."""
BONY, TENDONS = (0.3, 0.9), (0.05, 0.45)
"""Range of how bony people are and how their tendons show; those of the synthetic world have .1 to .9 and .2 to 1."""
THUMB_BASE = 13
"""The joint below the ball of the thumb: what it moves is no finger."""


def relief(hand: HandModel, seed: int) -> Float[Tensor, "V"]:
    """How far the skin of the hand that `seed` says stands out of the skin some 10 mm around [mm]; on the CPU."""
    forms = _forms()
    assert forms.shape[1] == len(hand.template), "the forms are those of the bundled hand"
    bony, tendons = torch.rand(2, generator=torch.Generator().manual_seed(seed + 2)).tolist()
    bony, tendons = (low + share * (high - low) for share, (low, high) in ((bony, BONY), (tendons, TENDONS)))
    heights = forms.new_tensor([1, bony, tendons, bony * tendons]) @ forms
    return heights.clamp(-DEEPEST, MOST)


@functools.lru_cache(2)
@torch.inference_mode(False)
@torch.no_grad()
def relief_shade(hand: HandModel, seed: int) -> Float[Tensor, "V 3"]:
    """What that adds to the logarithms of colours; on the CPU, not to be written to."""
    heights, palm = relief(hand, seed)[:, None], skin_regions(hand).palm.cpu()[:, None]
    segment, edges = hand.segment.cpu(), surface.mesh_edges(hand.faces.cpu())
    wide = surface.smooth_over_mesh(heights, edges, WIDE_PASSES)
    on_back = heights.new_tensor(PER_MM) * (heights + WIDE * wide)
    on_palm = torch.where(heights > 0, HIGHEST * torch.tanh(heights / HIGHEST), heights)
    fingers = ((segment > 0) & (segment != THUMB_BASE)).to(heights)[:, None]
    fingers = surface.smooth_over_mesh(fingers, edges, FINGER_PASSES)
    on_palm = heights.new_tensor(PALM_PER_MM) * (1 + (ON_PADS - 1) * fingers) * on_palm
    return torch.lerp(on_back, on_palm, palm)


FLUSH, FLUSH_ON_BACK = (-0.018, -0.042, -0.041), 0.3
"""What a standard deviation of the blood in the skin of a palm adds to the logarithms of colours, 28 % of its mean in
the model of `avatar.appearance.skin_color`, and the share of this on a back. Set by eye on photos of same_hand: twice
as much has blotches. With .8 on backs, which had green and yellow patches, a blind grader preferred this on 11 of 14
hands of tests/data/photos, with 3 ties."""
FLUSH_PASSES = 6, 25
"""Smoothings of white noise over the mesh that give the fine and the coarse blotches of blood, 5 and 12 mm."""


@functools.lru_cache(2)
@torch.inference_mode(False)
@torch.no_grad()
def flush_shade(hand: HandModel, seed: int) -> Float[Tensor, "V 3"]:
    """What blotches of blood add to the logarithms of colours. On the CPU, for equal bits; not to be written to."""
    palm, edges = skin_regions(hand).palm.cpu()[:, None], surface.mesh_edges(hand.faces.cpu())
    noise = torch.randn(len(palm), 2, generator=torch.Generator().manual_seed(seed + 3))
    layers = [surface.smooth_over_mesh(noise[:, k : k + 1], edges, n) for k, n in enumerate(FLUSH_PASSES)]
    blood = sum((layer - layer.mean()) / layer.std() for layer in layers) / len(layers) ** 0.5
    finger = torch.from_numpy(finger_of(hand.segment.cpu().numpy()))
    of_fingers = torch.zeros(1 + int(finger.max()), 1)
    for k in range(1, len(of_fingers)):  # no finger is redder than another
        of_fingers[k] = (palm * blood)[finger == k].sum() / palm[finger == k].sum()
    blood = blood - surface.smooth_over_mesh(of_fingers[finger], edges, FLUSH_PASSES[0])
    return (FLUSH_ON_BACK + (1 - FLUSH_ON_BACK) * palm) * blood * blood.new_tensor(FLUSH)


OVER_JOINTS = ((-0.075, -0.095, -0.095), 0.007), ((-0.05, -0.075, -0.075), 0.007), ((-0.03, -0.06, -0.055), 0.005)
"""What the first, second and third joint of a finger add to the logarithms of the colours of its back, and the standard
deviation of that spot [m]. On 7 photos of tests/data/photos and its same_hand, backs have, against the back of the
metacarpus, logarithms of -.13 over the second joints, -.12 over the third and -.1 around nails, and redness log(R / G)
of .06, .09 and .08 (by a script that is not kept, as all such numbers here). With this, painted hands have -.07, -.06
and -.07, and .06, .06 and .06; without, -.03, -.04 and -.03, and .04, .04 and .01. First joints were bright, by the
relief of their heads, and are dark."""
AT_TIP, TIP = (-0.005, -0.06, -0.045), (0.05, 0.5)
"""The same around nails and on the pads below them, and the part of the last bone over which it begins: 23 photos have
pads of a redness log(R / G) of .06 there against the palm, painted pads had -.05."""
JOINT_PASSES = 4
"""Smoothings over the mesh of all this, so that no bone's skin ends in a line."""


@functools.lru_cache(2)
@torch.inference_mode(False)
@torch.no_grad()
def joint_shade(hand: HandModel) -> Float[Tensor, "V 3"]:
    """What red joints and fingertips add to the logarithms of colours; on the CPU, not to be written to.

    It comes on top of the blood of `skin_tone`; the maps of `sample_detail` have only what is fine.
    """
    template, bone_t, segment = hand.template.cpu(), hand.bone_t.cpu(), hand.segment.cpu()
    back = 1 - skin_regions(hand).palm.cpu()
    shade = torch.zeros_like(template)
    for joint in range(1, len(hand.joints)):
        color, width = OVER_JOINTS[(joint - 1) % len(OVER_JOINTS)]
        if joint != THUMB_BASE:
            over = (segment == joint) & (bone_t < 0.15) & (back > 0.8)
            apart = (template - template[over].mean(0)).norm(dim=1)
            spot = back * (-0.5 * (apart / width).square()).exp()
            shade += spot[:, None] * shade.new_tensor(color)
        if joint in TIP_JOINTS:
            share = (segment == joint) * ((bone_t - TIP[0]) / (TIP[1] - TIP[0])).clamp(0, 1)
            shade += share[:, None] * shade.new_tensor(AT_TIP)
    return surface.smooth_over_mesh(shade, surface.mesh_edges(hand.faces.cpu()), JOINT_PASSES)


@functools.cache
def _forms() -> Float[Tensor, "4 V"]:
    """What all hands have, and what is added for bones, for tendons, and for both [mm]."""
    with asset("skin", "relief.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        return torch.from_numpy(stored["forms"].astype(np.float32) * FORM_UNIT)
