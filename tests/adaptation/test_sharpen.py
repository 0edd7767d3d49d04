import itertools

import pytest
import torch
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.reprojection import Canvas, map_surface
from oasis_warp.adaptation.sharpen import FACING, sharpen
from oasis_warp.avatar.anchors import RIM_FADE
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians, with_shade_baked
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import surface
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import Camera, HandCrop
from oasis_warp.hand.skinning import skin
from oasis_warp.losses.image import masked_psnr
from oasis_warp.render.render import render
from studies.painted_truth import make_truth

pytestmark = pytest.mark.slow

SIZE, WRIST = 512, 0.03


@pytest.fixture(scope="module")
def case(hand):
    """A photo with detail finer than the Gaussians that were fitted to it, half as large; and what comes of them."""
    truth = make_truth(hand, MeanPrior(hand), back=False, size=SIZE, steps=20)
    rest, posed = truth.avatar.rest, skin(hand, truth.avatar.rest, truth.pose)
    gaussians = truth.avatar.gaussians
    assert gaussians.shade is not None
    alpha = render(pose_gaussians(gaussians, hand.faces, rest.vertices, posed.vertices), truth.camera).alpha
    image = truth.photo.rgb.float() / 255
    crop = HandCrop(image, (alpha > 0.5).float(), torch.ones_like(alpha), truth.camera, rest, posed)
    return crop, gaussians, sharpen(hand, gaussians, [crop])


def draw(hand, crop, gaussians, camera):
    """In the shade of the photo, which is in even light."""
    shown = with_shade_baked(gaussians)
    return render(pose_gaussians(shown, hand.faces, crop.rest.vertices, crop.posed.vertices), camera)


def judged(hand, crop):
    """Where the photo shows the hand, but for its rim and its wrist."""
    uv = crop.posed.vertices[hand.rim].mean(0) @ crop.camera.K.T
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    away = (torch.stack([columns, rows], -1) - uv[:2] / uv[2]).norm(dim=-1)
    reach = WRIST * crop.camera.K[0, 0] / uv[2]
    return inner_mask(crop.mask, 5) * (away > 2 * reach)


def test_detail_that_coarse_gaussians_cannot_show_is_shown(hand, case):
    crop, coarse, made = case
    inside = judged(hand, crop)
    before, after = (
        masked_psnr(draw(hand, crop, gaussians, crop.camera).image, crop.image, inside)
        for gaussians in (coarse, made.gaussians)
    )
    assert inside.mean() > 0.1
    assert after > before + 4


def test_half_as_large_the_hand_is_as_like_the_photo_as_before(hand, case):
    crop, coarse, made = case
    half = Camera(
        crop.camera.viewmat, crop.camera.K * torch.tensor([[0.5], [0.5], [1.0]]), SIZE // 2, SIZE // 2
    )
    image = avg_pool2d(crop.image.permute(2, 0, 1), 2).permute(1, 2, 0)
    inside = (avg_pool2d(judged(hand, crop)[None], 2)[0] == 1).float()
    before, after = (
        masked_psnr(draw(hand, crop, gaussians, half).image, image, inside)
        for gaussians in (coarse, made.gaussians)
    )
    assert after > before


def test_what_the_photo_does_not_show_stays_bit_for_bit(hand, case):
    crop, coarse, made = case
    n_points, kept = len(coarse.vertex_index), len(made.gaussians.face_index) - made.n_new
    was_cut = torch.zeros(len(hand.faces), dtype=torch.bool)
    was_cut[made.gaussians.face_index[kept:]] = True
    stays = ~was_cut[coarse.face_index]
    for name in ("colors", "shade"):
        after, before = (getattr(gaussians, name)[n_points:] for gaussians in (made.gaussians, coarse))
        assert torch.equal(after[:kept], before[stays])
    normals = surface.vertex_normals(crop.posed.vertices, hand.faces)
    away = (normals * crop.posed.vertices).sum(1) > 0.02  # faces away from the camera at the origin
    assert away.float().mean() > 0.3
    assert not was_cut[away[hand.faces].all(1)].any()
    rest = crop.rest.vertices
    fading = torch.cdist(rest, rest[hand.rim]).amin(1) < RIM_FADE
    assert fading.any() and not was_cut[fading[hand.faces].any(1)].any()


def test_detail_is_on_the_skin_and_not_in_its_shade(hand, case):
    _, coarse, made = case
    plain = sharpen(hand, with_shade_baked(coarse), [case[0]]).gaussians
    new = slice(-made.n_new, None)
    shade, colors = made.gaussians.shade[new], made.gaussians.colors[new]
    assert len(plain.colors) == len(made.gaussians.colors)
    torch.testing.assert_close(shade * colors, plain.colors[new], atol=0.05, rtol=0)
    of_coarse = coarse.shade.log().abs().mean()
    assert float(of_coarse) > 0.01
    assert abs(float(shade.log().abs().mean() / of_coarse) - 1) < 0.5


def test_seen_from_behind_the_hand_is_the_same(hand, case):
    crop, coarse, made = case
    camera = orbit_camera(crop.posed.vertices, torch.pi, 0.0, 256)
    before, after = (draw(hand, crop, gaussians, camera) for gaussians in (coarse, made.gaussians))
    assert masked_psnr(after.image, before.image, inner_mask((before.alpha > 0.9).float())) > 40


def test_a_picture_that_is_explained_asks_for_nothing(hand, case):
    crop, coarse, _ = case
    own = draw(hand, crop, coarse, crop.camera).image
    made = sharpen(hand, coarse, [crop._replace(image=own)])
    assert made.n_new == 0 and made.losses == ()
    assert made.gaussians is coarse


def test_the_same_photo_gives_the_same_bits(hand, case):
    crop, coarse, made = case
    again = sharpen(hand, coarse, [crop])
    assert torch.equal(again.gaussians.colors, made.gaussians.colors)


def test_every_step_of_the_fit_comes_nearer(case):
    losses = case[2].losses
    assert all(after < before for before, after in itertools.pairwise(losses))
    assert losses[-1] < 0.9 * losses[0]


def test_of_two_photos_each_gives_the_detail_where_it_is_believed(hand, case):
    crop, coarse, _ = case
    darker = crop._replace(image=0.85 * crop.image)
    first = (crop.rest.vertices[:, 0] < crop.rest.vertices[:, 0].mean()).float()
    made = sharpen(hand, coarse, [crop, darker], torch.stack([first, 1 - first]))
    picture = draw(hand, crop, made.gaussians, crop.camera).image
    shown = map_surface(crop.posed.vertices, hand.faces, Canvas(crop.image, crop.mask, crop.camera), FACING)
    believed = (first[hand.faces[shown.faces.clamp_min(0)]] * shown.barycentrics).sum(-1)
    inside = judged(hand, crop) * (shown.share > 0.99)
    for photo, share in ((crop, believed), (darker, 1 - believed)):
        own = inside * (share > 0.99)
        assert own.mean() > 0.05
        assert masked_psnr(picture, photo.image, own) > 30
