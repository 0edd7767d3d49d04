"""Skin that no photo shows is painted on; what may be background, or a finger before the palm, is no skin."""

import pytest
import torch
from synthetic import PALM_TO_CAMERA, crop_of

from oasis_warp.adaptation import reliability, scraps
from oasis_warp.adaptation.adapt import adapt
from oasis_warp.adaptation.fine_skin import SPACING, cut_skin
from oasis_warp.adaptation.reliability import mask_unreliable
from oasis_warp.adaptation.skin_detail import sample_detail
from oasis_warp.adaptation.skin_grain import skin_grain
from oasis_warp.adaptation.unseen_skin import SEEN, _clarities, paint_hand, paint_unseen
from oasis_warp.avatar.anchors import RIM_FADE, vertex_colors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.densify import coarsen
from oasis_warp.avatar.observation import inner_mask, observe
from oasis_warp.avatar.pose import with_shade_baked
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.windows import largest_around
from oasis_warp.ops import depth_map


@pytest.fixture(scope="module")
def palm_photo(hand):
    crop, _, _ = crop_of(hand, region_colors(label_regions(hand), 0.03), orientation=PALM_TO_CAMERA)
    prior = MeanPrior(hand)(crop)
    return crop, adapt(hand, [prior], [crop], AdaptConfig(texture_steps=5))


def paint(hand, palm_photo, gaussians=None, seed=0, observations=None):
    crop, adapted = palm_photo
    fine = cut_skin(hand, gaussians or adapted.gaussians, [crop], adapted.trusted.confidence.amax(0))
    return paint_unseen(hand, fine, adapted.guess, crop, observations or adapted.observations, seed=seed)


@pytest.fixture(scope="module")
def painted(hand, palm_photo):
    return paint(hand, palm_photo)


def test_skin_that_is_seen_but_not_trusted_is_painted(hand, palm_photo):
    """In the shadow of fingers all that a photo shows is shade: the opened palm had a smooth band there."""
    crop, adapted = palm_photo
    shaded = (crop.rest.vertices[:, 0] > crop.rest.vertices[:, 0].median()).float()
    trusted = adapted._replace(trust=adapted.trust * (1 - shaded)).trusted
    inner = (surface.smooth_over_mesh(shaded[:, None], surface.mesh_edges(hand.faces), 8)[:, 0] > 0.99) & (
        adapted.observations.confidence[0] > 0.9
    )
    before, after = (paint(hand, palm_photo, observations=seen) for seen in (adapted.observations, trusted))
    assert int(inner.sum()) > 500 and float(before.invented[inner].max()) == 0
    assert float(after.invented[inner].min()) > 0.99
    smooth, detailed = (detail_of(hand, vertex_colors(each.gaussians, len(inner)), inner) for each in (before, after))
    assert detailed > 1.5 * smooth


def unseen_back(hand, painted):
    regions = label_regions(hand)
    return (painted.invented > 0.99) & (regions.palm < 0.05) & (regions.nail < 0.05)


def detail_of(hand, colors, where):
    edges = surface.mesh_edges(hand.faces)
    logs = colors.clamp_min(0.01).log()
    return (logs - surface.smooth_over_mesh(logs, edges, 4))[where].std()


def test_seen_skin_gets_grain_that_the_photo_does_not_show(hand, palm_photo, painted):
    """Beside grainy painted skin, seen skin was a plaster; in the photo's own view it must stay the photo."""
    seen = painted.invented == 0
    assert bool((palm_photo[1].observations.confidence[0] >= SEEN)[~seen].logical_not().all())
    made = painted.gaussians
    on = torch.cat([torch.zeros_like(made.vertex_index, dtype=torch.bool), seen[hand.faces[made.face_index]].all(1)])
    grain = skin_grain(hand, made, 0)[on]
    skin, photo = (g.colors[on].clamp_min(0.01).log().mean(1) for g in (made, with_shade_baked(made)))
    assert int(on.sum()) > 20000 and 0.008 < float(grain.std()) < 0.035
    assert float(torch.corrcoef(torch.stack([grain, skin]))[0, 1]) > 0.1
    assert abs(float(torch.corrcoef(torch.stack([grain, photo]))[0, 1])) < 0.03


def test_the_unseen_back_gets_detail_that_a_mean_has_not(hand, palm_photo, painted):
    where = unseen_back(hand, painted)
    before, after = (vertex_colors(g, len(where)) for g in (palm_photo[1].gaussians, painted.gaussians))
    assert detail_of(hand, after, where) > 1.5 * detail_of(hand, before, where)


def test_a_smooth_back_says_little_of_its_palm(hand, palm_photo):
    """The palm behind a smooth pale back was as smooth: .25 of real palms' contrast at 2 to 4 px."""
    _, adapted = palm_photo
    seen, palm = adapted.observations, label_regions(hand).palm
    noise = 0.006 * torch.randn(1, len(palm), 1, generator=torch.Generator().manual_seed(0))
    for side, of_seen in ((palm < 0.5, 1), (palm >= 0.5, 0)):
        shown = seen._replace(colors=0.5 * noise.exp().expand(-1, -1, 3), confidence=side.float()[None])
        gains = _clarities(hand, shown)
        assert gains[of_seen] < gains[1 - of_seen] < 1


def test_a_photo_with_crisp_skin_gets_crisper_skin_painted(hand, palm_photo):
    """At one strength for all, a pale hand in a soft photo got the skin of an old one on its other side."""
    _, adapted = palm_photo
    seen = adapted.observations
    noise = torch.randn(1, len(hand.template), 1, generator=torch.Generator().manual_seed(0))
    found = []
    for contrast in (0.0, 0.08):
        made = paint(hand, palm_photo, observations=seen._replace(colors=seen.colors * (contrast * noise).exp()))
        where = unseen_back(hand, made)
        found.append(float(detail_of(hand, vertex_colors(made.gaussians, len(where)), where)))
    assert found[1] > 1.4 * found[0]  # relief and blotches do not depend on it


def test_the_photo_looks_as_before_in_its_own_view(hand, palm_photo, painted):
    """What the photo shows on a slant is painted, and its own look there becomes shade."""
    crop, adapted = palm_photo
    first = observe(hand, crop)
    slanted = (first.visibility > 0.99) & (first.facing > 0) & (painted.invented > 0.5)
    on = slanted[adapted.gaussians.vertex_index]
    before, after = (with_shade_baked(g).colors[: len(on)][on] for g in (adapted.gaussians, painted.gaussians))
    assert int(on.sum()) > 50
    torch.testing.assert_close(after, before, atol=0.01, rtol=0)
    assert float((painted.gaussians.colors[: len(on)][on] - after).abs().mean()) > 0.005


def test_one_seed_gives_one_skin_and_another_seed_another(hand, palm_photo, painted):
    again, other = paint(hand, palm_photo), paint(hand, palm_photo, seed=1)
    assert torch.equal(again.gaussians.colors, painted.gaussians.colors)
    where = unseen_back(hand, painted)
    one, two = (vertex_colors(made.gaussians, len(where))[where] for made in (painted, other))
    assert float((one - two).square().mean().sqrt()) > 0.01


def test_skin_is_as_fine_as_a_fist_that_fills_the_picture_needs(hand, palm_photo, painted):
    """One Gaussian a face has deviations of .5 mm: 2 px of a fist of 512 px, which looked like wax."""
    crop, _ = palm_photo
    faces = painted.gaussians.face_index
    away = torch.cdist(crop.rest.vertices, crop.rest.vertices[hand.rim]).amin(1)[hand.faces].amin(1)
    areas = surface.face_normals(crop.rest.vertices, hand.faces)[1] / torch.bincount(faces, minlength=len(hand.faces))
    assert float(areas[away > RIM_FADE].amax().sqrt()) < 1.001 * SPACING
    assert len(painted.gaussians.colors) < 250_000


def test_a_small_photos_hand_is_painted_on_its_vertices(hand, palm_photo):
    crop, adapted = palm_photo
    few = coarsen(hand, adapted.gaussians._replace(shade=None), crop.rest)
    made = paint(hand, palm_photo, few)
    assert len(made.gaussians.colors) == len(few.colors)
    where = unseen_back(hand, made)
    before, after = (vertex_colors(g, len(where)) for g in (few, made.gaussians))
    assert detail_of(hand, after, where) > 1.2 * detail_of(hand, before, where)


def test_no_step_shows_where_painted_skin_meets_seen_skin(hand, palm_photo):
    _, adapted = palm_photo
    across = vertex_to_gaussians(0.12 * torch.tanh(hand.template[:, 2:] / 0.01), hand.faces, adapted.gaussians)
    tinted = adapted.gaussians._replace(colors=(adapted.gaussians.colors * across.exp()).clamp(0, 1))
    made = paint(hand, palm_photo, tinted)
    nail = label_regions(hand).nail > 0.02
    colors = vertex_colors(made.gaussians, len(nail)).clamp_min(0.01).log()
    edges = surface.mesh_edges(hand.faces)
    edges = edges[~nail[edges].any(1)]
    share = made.invented[edges]
    crossing, inside = share.amin(1) == 0, share.amin(1) == 1
    crossing = crossing & (share.amax(1) > 0)
    step = (colors[edges[:, 0]] - colors[edges[:, 1]]).abs().mean(1)
    assert int(crossing.sum()) > 100
    assert float(step[crossing].mean()) < 1.5 * float(step[inside].mean())


def test_a_nail_ends_in_a_pale_free_edge_and_is_redder_than_its_lunula(hand, painted):
    """One flat tone, a nail looked like plastic."""
    nails = sample_detail(hand, painted.gaussians, 0)
    bed, free, lunula = (where & (nails.plate > 0.9) for where in (
        nails.pale.abs() < 0.05, nails.pale < -0.8, nails.pale > 0.8
    ))  # fmt: skip
    assert min(int(part.sum()) for part in (bed, free, lunula)) > 10
    bed, free, lunula = (painted.gaussians.colors[part].log().mean(0) for part in (bed, free, lunula))
    assert float((free - bed).mean()) > 0.1
    assert float((bed - lunula)[0] - (bed - lunula)[1]) > 0.05


def test_a_hand_that_is_painted_all_over_has_what_unseen_skin_is_given(hand, palm_photo, painted):
    crop, adapted = palm_photo
    whole = [
        paint_hand(hand, adapted.guess, crop.rest.vertices, painted.skin, seed=seed) for seed in (0, 1)
    ]  # fmt: skip
    back = unseen_back(hand, painted)
    colors = [
        vertex_colors(each, len(back)).log().mean(1) for each in (painted.gaussians._replace(shade=None), *whole)
    ]  # fmt: skip
    inside = surface.mesh_edges(hand.faces)
    fine = [(one - surface.smooth_over_mesh(one[:, None], inside, 8)[:, 0])[back] for one in colors]
    same, other = (float(torch.corrcoef(torch.stack([fine[0], one]))[0, 1]) for one in fine[1:])
    assert same > 0.8 and same > other + 0.1, (same, other)
    assert float((colors[0] - colors[1])[back].mean().abs()) < 0.1
    seen = (painted.invented == 0) & (label_regions(hand).palm > 0.9)
    assert detail_of(hand, vertex_colors(whole[0], len(back)), seen) > 1.5 * detail_of(
        hand, vertex_colors(painted.gaussians, len(back)), seen
    )


def test_without_shade_what_the_photo_shows_on_a_slant_stays(hand, palm_photo):
    crop, adapted = palm_photo
    bare = adapted.gaussians._replace(shade=None)
    made = paint(hand, palm_photo, bare)
    first = observe(hand, crop)
    shown = (first.visibility == 1) & (first.facing > 0)
    on = shown[bare.vertex_index]
    assert torch.equal(*(g.colors[: len(on)][on] for g in (bare, made.gaussians)))


SKIN, WALL = (0.7, 0.5, 0.4), (0.1, 0.3, 0.8)


@pytest.fixture(scope="module")
def shown(hand):
    """A flat hand in one colour before a blue wall, and what is drawn of it."""
    crop, *_ = crop_of(hand, 0.8 * region_colors(label_regions(hand), 0.03))
    skin, wall = (torch.tensor(color).expand_as(crop.image) for color in (SKIN, WALL))
    share = crop.mask[..., None]
    return crop._replace(image=share * skin + (1 - share) * wall), skin


def test_a_right_mask_is_left_as_it_is(hand, shown):
    crop, drawn = shown
    sure = mask_unreliable(hand, drawn, crop)
    assert float((sure.mask - crop.mask).abs().mean() / crop.mask.mean()) < 0.06
    deep = inner_mask(crop.mask, 8) > 0.5
    assert float(sure.mask[deep].mean()) > 0.97
    assert sure.image is crop.image


def test_background_inside_the_mask_does_not_count(hand, shown):
    crop, drawn = shown
    wider = len(crop.mask) // 64  # 1 px of 96
    fat = crop._replace(mask=-inner_mask(-crop.mask, wider))  # the largest so near
    added = (fat.mask > 0.99) & (crop.mask < 0.01)
    assert int(added.sum()) > 100
    sure = mask_unreliable(hand, drawn, fat)
    assert float(sure.mask[added].mean()) < 0.1  # slits that the mask has closed have no wall in them
    kept = inner_mask(crop.mask, 2) > 0.99
    assert float(sure.mask[kept].mean()) > 0.95


def test_a_spot_of_the_walls_colour_far_from_the_border_is_the_hands(hand, shown):
    crop, drawn = shown
    deep = inner_mask(crop.mask, 10) > 0.5
    painted = crop._replace(image=torch.where(deep[..., None], torch.tensor(WALL), crop.image))
    before, after = (mask_unreliable(hand, drawn, e).mask[deep] for e in (crop, painted))
    assert torch.equal(before, after)


def test_skin_that_looks_like_the_wall_counts(hand, shown):
    crop, drawn = shown
    same = crop._replace(image=drawn)
    assert float(mask_unreliable(hand, drawn, same).mask.mean() / crop.mask.mean()) > 0.95


def test_what_is_read_as_another_place_does_not_count(hand, shown):
    """The tip of a finger that is fitted beside it was printed on the palm."""
    crop, drawn = shown
    seen = depth_map(
        crop.posed.vertices, hand.faces, crop.camera.viewmat, crop.camera.K, *crop.mask.shape, validate=False
    )
    places = (hand.template[hand.faces[seen.face_ids.clamp_min(0).long()]] * seen.barycentrics[..., None]).sum(-2)
    right = torch.cat([places, torch.full_like(crop.mask, 0.005)[..., None], torch.zeros_like(places)], -1)
    before = mask_unreliable(hand, drawn, crop).mask
    assert torch.equal(mask_unreliable(hand, drawn, crop._replace(reading=right)).mask, before)
    deep = inner_mask(crop.mask, 10) > 0.5
    wrong = right.clone()
    wrong[..., 0][deep] += 0.03
    sure = mask_unreliable(hand, drawn, crop._replace(reading=wrong)).mask
    assert float(sure[deep].max()) == 0 and torch.equal(sure[~grown(deep, 2)], before[~grown(deep, 2)])
    unsure = right.clone()
    unsure[..., 3] = 0.03
    assert torch.equal(mask_unreliable(hand, drawn, crop._replace(reading=unsure)).mask, before)
    unsure[..., 0][deep] += 0.03
    unsure[..., 3][deep] = 0.005
    ring = grown(deep, 2) & ~deep  # beside it, as in a picture of 96 px
    assert float(mask_unreliable(hand, drawn, crop._replace(reading=unsure)).mask[ring].max()) == 0


def grown(where, pixels):
    return inner_mask(-where.float(), pixels) < 0


def test_a_dark_scrap_beside_a_finger_does_not_count_and_a_crease_in_the_palm_does(hand):
    """Gaps and shadows beside a bent finger were dark scabs at its base as soon as it was opened."""
    crop, *_ = crop_of(hand, torch.full_like(hand.template, 0.5), pose_name="ok", size=128, orientation=PALM_TO_CAMERA)
    seen = depth_map(crop.posed.vertices, hand.faces, crop.camera.viewmat, crop.camera.K, 128, 128, validate=False)
    place, nail = scraps._read(hand, seen)
    outlines = scraps._outlines(seen.face_ids >= 0, place)
    skin = (seen.face_ids >= 0) & (nail < 0.5)
    beside = (largest_around(outlines.inside.float(), 2) > 0) & skin
    far = (largest_around((outlines.inside | outlines.around).float(), 6) == 0) & skin
    assert int(beside.sum()) > 100 and int(far.sum()) > 100
    lines = torch.arange(128)[:, None] % 8 == 0  # dark ones all over
    dark = torch.where(lines[..., None], 0.6, 1.0) * crop.image
    found = scraps.scrap_share(hand, crop.image, crop._replace(image=dark), seen)
    assert float(found[beside & lines].mean()) > 0.9
    assert float(found[far].max()) == 0 and float(found[beside & ~lines].mean()) < 0.1
    assert float(scraps.scrap_share(hand, crop.image, crop, seen).max()) == 0
    unsure = crop._replace(mask=0.8 * crop.mask, image=dark)  # the rest had no median, and a whole avatar became NaN
    assert float(scraps.scrap_share(hand, crop.image, unsure, seen).max()) == 0


def test_what_lies_just_behind_a_finger_does_not_count(hand, shown):
    crop, drawn = shown
    side = len(crop.mask)
    bent = crop.posed.vertices.clone()
    finger = (hand.segment == 3) | (hand.segment == 2)  # hangs in the air 5 cm before the palm, over it
    toward = -bent.mean(0) / bent.mean(0).norm()
    down = bent[hand.segment == 0].mean(0) - bent[finger].mean(0)
    bent[finger] += 0.7 * down + 0.05 * toward
    before = crop._replace(posed=crop.posed._replace(vertices=bent), mask=torch.ones(side, side))
    image = drawn.clone()
    lost = mask_unreliable(hand, drawn, before._replace(image=image)).mask < 0.5
    assert 100 < int(lost.sum()) < 0.1 * side * side


def test_the_palm_beside_a_finger_that_lies_on_it_is_unreliable(hand, monkeypatch):
    """Finger tips that touch the palm lie less than `BEHIND_GAP` above it: their picture stayed on the opened palm."""
    shares = {}
    for name in ("fist", "open"):
        crop, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5), pose_name=name, size=128)
        with monkeypatch.context() as patch:
            sure = mask_unreliable(hand, crop.image, crop).mask
            patch.setattr(reliability, "FINGER_GAP", torch.inf)
            shares[name] = float((mask_unreliable(hand, crop.image, crop).mask - sure).sum() / crop.mask.sum())
    assert shares["fist"] > 0.02 and shares["open"] < 0.01
