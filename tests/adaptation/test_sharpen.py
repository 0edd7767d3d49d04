import itertools

import pytest
import torch
from painted_truth import make_truth
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.carried import Canvas, look
from oasis_warp.adaptation.sharpen import FACING, sharpen
from oasis_warp.avatar.anchors import RIM_FADE
from oasis_warp.avatar.lighting import with_shade_on
from oasis_warp.avatar.observe import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import surface
from oasis_warp.core.types import Camera, Evidence
from oasis_warp.hand.skinning import skin
from oasis_warp.losses.image import masked_psnr
from oasis_warp.render.cameras import orbit_camera
from oasis_warp.render.render import render

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
    evidence = Evidence(image, (alpha > 0.5).float(), torch.ones_like(alpha), truth.camera, rest, posed)
    return evidence, gaussians, sharpen(hand, gaussians, [evidence])


def draw(hand, evidence, gaussians, camera):
    """In the shade of the photo, which is in even light."""
    shown = with_shade_on(gaussians)
    return render(pose_gaussians(shown, hand.faces, evidence.rest.vertices, evidence.posed.vertices), camera)


def judged(hand, evidence):
    """Where the photo shows the hand, but for its rim and its wrist."""
    uv = evidence.posed.vertices[hand.rim].mean(0) @ evidence.camera.K.T
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    away = (torch.stack([columns, rows], -1) - uv[:2] / uv[2]).norm(dim=-1)
    reach = WRIST * evidence.camera.K[0, 0] / uv[2]
    return inner_mask(evidence.mask, 5) * (away > 2 * reach)


def test_detail_that_coarse_gaussians_cannot_show_is_shown(hand, case):
    evidence, coarse, made = case
    inside = judged(hand, evidence)
    before, after = (
        masked_psnr(draw(hand, evidence, gaussians, evidence.camera).image, evidence.image, inside)
        for gaussians in (coarse, made.gaussians)
    )
    assert inside.mean() > 0.1
    assert after > before + 4


def test_half_as_large_the_hand_is_as_like_the_photo_as_before(hand, case):
    evidence, coarse, made = case
    half = Camera(
        evidence.camera.viewmat, evidence.camera.K * torch.tensor([[0.5], [0.5], [1.0]]), SIZE // 2, SIZE // 2
    )
    image = avg_pool2d(evidence.image.permute(2, 0, 1), 2).permute(1, 2, 0)
    inside = (avg_pool2d(judged(hand, evidence)[None], 2)[0] == 1).float()
    before, after = (
        masked_psnr(draw(hand, evidence, gaussians, half).image, image, inside)
        for gaussians in (coarse, made.gaussians)
    )
    assert after > before


def test_what_the_photo_does_not_show_stays_bit_for_bit(hand, case):
    evidence, coarse, made = case
    n_points, kept = len(coarse.vertex_index), len(made.gaussians.face_index) - made.n_new
    was_cut = torch.zeros(len(hand.faces), dtype=torch.bool)
    was_cut[made.gaussians.face_index[kept:]] = True
    stays = ~was_cut[coarse.face_index]
    for name in ("colors", "shade"):
        after, before = (getattr(gaussians, name)[n_points:] for gaussians in (made.gaussians, coarse))
        assert torch.equal(after[:kept], before[stays])
    normals = surface.vertex_normals(evidence.posed.vertices, hand.faces)
    away = (normals * evidence.posed.vertices).sum(1) > 0.02  # faces away from the camera at the origin
    assert away.float().mean() > 0.3
    assert not was_cut[away[hand.faces].all(1)].any()
    rest = evidence.rest.vertices
    fading = torch.cdist(rest, rest[hand.rim]).amin(1) < RIM_FADE
    assert fading.any() and not was_cut[fading[hand.faces].any(1)].any()


def test_detail_is_on_the_skin_and_not_in_its_shade(hand, case):
    _, coarse, made = case
    plain = sharpen(hand, with_shade_on(coarse), [case[0]]).gaussians
    new = slice(-made.n_new, None)
    shade, colors = made.gaussians.shade[new], made.gaussians.colors[new]
    assert len(plain.colors) == len(made.gaussians.colors)
    torch.testing.assert_close(shade * colors, plain.colors[new], atol=0.05, rtol=0)
    of_coarse = coarse.shade.log().abs().mean()
    assert float(of_coarse) > 0.01
    assert abs(float(shade.log().abs().mean() / of_coarse) - 1) < 0.5


def test_seen_from_behind_the_hand_is_the_same(hand, case):
    evidence, coarse, made = case
    camera = orbit_camera(evidence.posed.vertices, torch.pi, 0.0, 256)
    before, after = (draw(hand, evidence, gaussians, camera) for gaussians in (coarse, made.gaussians))
    assert masked_psnr(after.image, before.image, inner_mask((before.alpha > 0.9).float())) > 40


def test_a_picture_that_is_explained_asks_for_nothing(hand, case):
    evidence, coarse, _ = case
    own = draw(hand, evidence, coarse, evidence.camera).image
    made = sharpen(hand, coarse, [evidence._replace(image=own)])
    assert made.n_new == 0 and made.losses == ()
    assert made.gaussians is coarse


def test_the_same_photo_gives_the_same_bits(hand, case):
    evidence, coarse, made = case
    again = sharpen(hand, coarse, [evidence])
    assert torch.equal(again.gaussians.colors, made.gaussians.colors)


def test_every_step_of_the_fit_comes_nearer(case):
    losses = case[2].losses
    assert all(after < before for before, after in itertools.pairwise(losses))
    assert losses[-1] < 0.9 * losses[0]


def test_of_two_photos_each_gives_the_detail_where_it_is_believed(hand, case):
    evidence, coarse, _ = case
    darker = evidence._replace(image=0.85 * evidence.image)
    first = (evidence.rest.vertices[:, 0] < evidence.rest.vertices[:, 0].mean()).float()
    made = sharpen(hand, coarse, [evidence, darker], torch.stack([first, 1 - first]))
    picture = draw(hand, evidence, made.gaussians, evidence.camera).image
    shown = look(evidence.posed.vertices, hand.faces, Canvas(evidence.image, evidence.mask, evidence.camera), FACING)
    believed = (first[hand.faces[shown.faces.clamp_min(0)]] * shown.barycentrics).sum(-1)
    inside = judged(hand, evidence) * (shown.share > 0.99)
    for photo, share in ((evidence, believed), (darker, 1 - believed)):
        own = inside * (share > 0.99)
        assert own.mean() > 0.05
        assert masked_psnr(picture, photo.image, own) > 30
