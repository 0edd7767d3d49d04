"""After the fit all skin has thin, opaque Gaussians, and the photos' cameras see what they saw."""

import pytest
import torch
from synthetic import crop_of

from oasis_warp.adaptation.fine_skin import COARSE, cut_skin
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.densify import FITTED, SKIN, coarsen, densify
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.losses import masked_psnr
from oasis_warp.render import render


@pytest.fixture(scope="module")
def fitted(hand):
    """A hand with fine specks on half transparent parts, and its photo."""
    crop, truth, _ = crop_of(hand, region_colors(label_regions(hand), 0.03), size=192)
    parts = torch.where(crop.rest.vertices[hand.faces][..., 2].mean(1) > 0, 3, 1)
    fine = densify(truth, crop.rest.vertices, hand.faces, parts, FITTED).gaussians
    noise = torch.rand(len(fine.colors), 1, generator=torch.Generator().manual_seed(0))
    return crop, fine._replace(colors=(fine.colors * (0.6 + 0.7 * noise)).clamp(0, 1))


def everywhere(hand):
    return torch.ones(len(hand.template))


def picture(hand, gaussians, crop):
    return render(pose_gaussians(gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices), crop.camera)


def test_cut_skin_keeps_the_photos_picture(hand, fitted, monkeypatch):
    """Averages of what was there blurred the detail of several photos."""
    crop, before = fitted
    cut = cut_skin(hand, before, [crop], everywhere(hand))
    monkeypatch.setattr("oasis_warp.adaptation.fine_skin.keep_pictures", lambda hand, before, cut, *_: cut.gaussians)
    averaged = cut_skin(hand, before, [crop], everywhere(hand))
    shown, kept, blurred = (picture(hand, each, crop).image for each in (before, cut, averaged))
    inside = (inner_mask(crop.mask, 4) > 0.9).float()
    kept, blurred = (masked_psnr(each, shown, inside) for each in (kept, blurred))
    assert kept > 30 and kept > blurred + 4, (kept, blurred)


def test_no_part_stays_thick_or_half_transparent(hand, fitted):
    """They were so for the fit; turned, seen skin had blurred outlines beside painted skin."""
    crop, before = fitted
    cut = cut_skin(hand, before, [crop], everywhere(hand))
    inner = cut.opacities > 0.99 * SKIN.opacity  # without the fade at the wrist
    on_faces = torch.arange(len(inner)) >= len(cut.vertex_index)
    assert float((inner | ~on_faces).float().mean()) > 0.97
    assert float(cut.scales[on_faces & inner, 2].quantile(0.99)) < 1.5 * SKIN.thickness
    count = torch.bincount(cut.face_index, minlength=len(hand.faces))
    own = torch.bincount(before.face_index, minlength=len(hand.faces))
    assert bool((count[own > 0] >= own[own > 0]).all())
    coarse = cut_skin(hand, before, [crop], everywhere(hand), COARSE)
    same = torch.bincount(coarse.face_index, minlength=len(hand.faces)) == own
    assert float(same.float().mean()) > 0.95  # others are large


def test_a_small_photos_hand_without_faces_stays(hand, fitted):
    crop, before = fitted
    few: CanonicalGaussians = coarsen(hand, before._replace(shade=None), crop.rest)
    assert cut_skin(hand, few, [crop], everywhere(hand)) is few
