"""Colours read off a picture: finding paint, repainting an avatar, and detail finer than its Gaussians."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.repaint import find_paint, match_size, read_mask, repaint
from oasis_warp.adaptation.reprojection import Canvas, map_surface
from oasis_warp.adaptation.sharpen import FACING, sharpen
from oasis_warp.avatar.anchors import RIM_FADE
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians, with_shade_baked
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core import surface
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.config import BLACK
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Camera, HandCrop, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.hand.skinning import skin
from oasis_warp.losses import masked_psnr
from oasis_warp.ops import depth_map
from oasis_warp.render import render
from studies.painted_truth import Chart, draw_truth, make_truth

pytestmark = pytest.mark.slow

SIZE = 192
PHOTOS = Path(__file__).parents[1] / "data" / "photos"


@pytest.fixture(scope="module")
def truth(hand):
    return make_truth(hand, MeanPrior(hand), back=False, size=SIZE, steps=20)


def painted(truth, kind="tattoo"):
    chart = Chart(truth, kind)
    drawn = draw_truth(truth, chart, truth.pose, truth.camera)
    return chart, Canvas(drawn.image, drawn.paint, truth.camera)


def run(truth, canvas, steps=25):
    avatar = truth.avatar
    return repaint(
        avatar.gaussians, truth.hand.faces, avatar.rest.vertices, avatar.mesh(truth.pose).vertices, canvas, steps=steps
    )


def draw(truth, gaussians, pose, camera):
    posed = truth.avatar.mesh(pose).vertices
    shown = with_shade_baked(gaussians)
    return render(pose_gaussians(shown, truth.hand.faces, truth.avatar.rest.vertices, posed), camera, background=BLACK)


def _face_ids(truth):
    camera = truth.camera
    posed = truth.avatar.mesh(truth.pose).vertices
    return depth_map(posed, truth.hand.faces, camera.viewmat, camera.K, SIZE, SIZE).face_ids.clamp_min(0).long()


@pytest.fixture(scope="module")
def tattoo(truth):
    chart, canvas = painted(truth)
    return chart, canvas, run(truth, canvas)


def test_the_drawing_shows_in_the_input_view(truth, tattoo):
    _, canvas, made = tattoo
    inside = (canvas.mask > 0).float()
    before = draw(truth, truth.avatar.gaussians, truth.pose, truth.camera).image
    after = draw(truth, made.gaussians, truth.pose, truth.camera).image
    assert masked_psnr(before, canvas.image, inside) < 13
    assert masked_psnr(after, canvas.image, inside) > 18


def test_gaussians_on_other_faces_are_the_same_bits(truth, tattoo):
    made, old = tattoo[2], truth.avatar.gaussians
    elsewhere = ~made.faces[old.face_index]
    n = int(elsewhere.sum())
    first = len(made.gaussians.vertex_index)
    assert torch.equal(made.gaussians.face_index[:n], old.face_index[elsewhere])
    for name in ("colors", "shade"):
        before = getattr(old, name)[len(old.vertex_index) :][elsewhere]
        assert torch.equal(getattr(made.gaussians, name)[first : first + n], before)
    assert made.n_new == len(made.gaussians.face_index) - n


def test_paint_is_in_no_shade(tattoo):
    made = tattoo[2].gaussians
    black = made.colors[-tattoo[2].n_new :].amax(1) < 0.2
    assert int(black.sum()) > 100
    torch.testing.assert_close(made.shade[-tattoo[2].n_new :][black].median(), torch.tensor(1.0), atol=1e-3, rtol=0)


def test_away_from_the_paint_the_picture_stays(truth, tattoo):
    made = tattoo[2]
    shown = made.faces[_face_ids(truth)]
    before = draw(truth, truth.avatar.gaussians, truth.pose, truth.camera).image
    after = draw(truth, made.gaussians, truth.pose, truth.camera).image
    assert masked_psnr(after, before, (~shown).float()) > 50


def test_learning_makes_it_likelier_and_never_leaves_the_colours(tattoo):
    made = tattoo[2]
    assert made.losses[-1] < 0.7 * made.losses[0]
    assert made.gaussians.colors.min() >= 0
    assert made.gaussians.colors.max() <= 1


def test_the_painted_area_is_measured_on_the_skin(truth):
    _, canvas = painted(truth)
    vertices, camera = truth.avatar.mesh(truth.pose).vertices, canvas.camera
    mask = torch.zeros_like(canvas.mask)
    x, y = (int(v) for v in project(camera, vertices[truth.hand.segment == 0].mean(0)[None])[0][0])
    half = 12
    mask[y - half : y + half, x - half : x + half] = 1
    made = run(truth, canvas._replace(mask=mask), steps=0)
    # At focal length f a pixel shows z^2 / (f^2 n.v) of skin at depth z with the normal n, along v = (x / z, y / z, 1).
    faces, size = truth.hand.faces, camera.width
    seen = depth_map(vertices, faces, camera.viewmat, camera.K, size, size, validate=False)
    normals, _ = surface.face_normals(vertices, faces)
    grid = torch.stack(torch.meshgrid(torch.arange(size), torch.arange(size), indexing="xy"), -1) + 0.5
    rays = torch.cat([(grid - camera.K[:2, 2]) / camera.K.diagonal()[:2], torch.ones(size, size, 1)], -1)
    slant = (normals[seen.face_ids.clamp_min(0).long()] * rays).sum(-1).abs()
    areas = seen.depth**2 / (camera.K[0, 0] * camera.K[1, 1] * slant)
    least, most = (float(areas[inner_mask(mask, pixels) > 0.5].sum()) for pixels in (2, 0))
    assert least < made.area < most < 1.5 * least  # what lies on the border counts in part


def test_what_another_surface_hides_gets_no_paint(truth):
    """A picture that is paint all over colours what the photo shows, and nothing behind it."""
    _, canvas = painted(truth)
    red = torch.tensor([1.0, 0.0, 0.0])
    everything = Canvas(red.expand_as(canvas.image).contiguous(), torch.ones_like(canvas.mask), canvas.camera)
    made = run(truth, everything, steps=10)
    front = draw(truth, made.gaussians, truth.pose, truth.camera)
    solid = front.alpha > 0.99
    assert (front.image[solid] - red).abs().amax(-1).median() < 0.1
    behind = Camera(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), truth.camera.K, SIZE, SIZE)
    behind.viewmat[2, 3] = 2 * float(truth.pose.translation[2])
    assert draw(truth, truth.avatar.gaussians, truth.pose, behind).alpha.max() > 0.99
    back = [draw(truth, g, truth.pose, behind).image for g in (truth.avatar.gaussians, made.gaussians)]
    changed = (back[0] - back[1]).abs().amax(-1) > 0.2
    seen = draw(truth, truth.avatar.gaussians, truth.pose, behind).alpha > 0.99
    assert (changed & seen).sum() < 0.25 * seen.sum()  # the rim, round which the paint begins


def test_paint_beside_the_hand_is_refused(truth):
    _, canvas = painted(truth)
    mask = torch.zeros_like(canvas.mask)
    mask[:8, :8] = 1
    with pytest.raises(ValueError, match="expected paint on the hand, got none"):
        run(truth, canvas._replace(mask=mask))


def test_the_same_paint_gives_the_same_bits(truth):
    _, canvas = painted(truth, "ring")
    first, second = (run(truth, canvas, steps=5).gaussians for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


FINE, WRIST = 512, 0.03


@pytest.fixture(scope="module")
def case(hand):
    """A photo with detail finer than the Gaussians that were fitted to it, half as large; and what comes of them."""
    fine_truth = make_truth(hand, MeanPrior(hand), back=False, size=FINE, steps=20)
    rest, posed = fine_truth.avatar.rest, skin(hand, fine_truth.avatar.rest, fine_truth.pose)
    gaussians = fine_truth.avatar.gaussians
    assert gaussians.shade is not None
    alpha = render(pose_gaussians(gaussians, hand.faces, rest.vertices, posed.vertices), fine_truth.camera).alpha
    image = fine_truth.photo.rgb.float() / 255
    crop = HandCrop(image, (alpha > 0.5).float(), torch.ones_like(alpha), fine_truth.camera, rest, posed)
    return crop, gaussians, sharpen(hand, gaussians, [crop])


def draw_crop(hand, crop, gaussians, camera):
    """In the shade of the photo, which is in even light."""
    shown = with_shade_baked(gaussians)
    return render(pose_gaussians(shown, hand.faces, crop.rest.vertices, crop.posed.vertices), camera)


def judged(hand, crop):
    """Where the photo shows the hand, but for its rim and its wrist."""
    uv = crop.posed.vertices[hand.rim].mean(0) @ crop.camera.K.T
    rows, columns = torch.meshgrid(torch.arange(FINE), torch.arange(FINE), indexing="ij")
    away = (torch.stack([columns, rows], -1) - uv[:2] / uv[2]).norm(dim=-1)
    reach = WRIST * crop.camera.K[0, 0] / uv[2]
    return inner_mask(crop.mask, 5) * (away > 2 * reach)


def test_detail_that_coarse_gaussians_cannot_show_is_shown(hand, case):
    crop, coarse, made = case
    inside = judged(hand, crop)
    before, after = (
        masked_psnr(draw_crop(hand, crop, gaussians, crop.camera).image, crop.image, inside)
        for gaussians in (coarse, made.gaussians)
    )
    assert inside.mean() > 0.1
    assert after > before + 4


def test_half_as_large_the_hand_is_as_like_the_photo_as_before(hand, case):
    crop, coarse, made = case
    half = Camera(
        crop.camera.viewmat, crop.camera.K * torch.tensor([[0.5], [0.5], [1.0]]), FINE // 2, FINE // 2
    )
    image = avg_pool2d(crop.image.permute(2, 0, 1), 2).permute(1, 2, 0)
    inside = (avg_pool2d(judged(hand, crop)[None], 2)[0] == 1).float()
    before, after = (
        masked_psnr(draw_crop(hand, crop, gaussians, half).image, image, inside)
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
    assert float(of_coarse) > 0.002  # there is some; what is finer than 15 mm is albedo
    assert abs(float(shade.log().abs().mean() / of_coarse) - 1) < 0.5


def test_seen_from_behind_the_hand_is_the_same(hand, case):
    crop, coarse, made = case
    camera = orbit_camera(crop.posed.vertices, torch.pi, 0.0, 256)
    before, after = (draw_crop(hand, crop, gaussians, camera) for gaussians in (coarse, made.gaussians))
    assert masked_psnr(after.image, before.image, inner_mask((before.alpha > 0.9).float())) > 40


def test_a_picture_that_is_explained_asks_for_nothing(hand, case):
    crop, coarse, _ = case
    own = draw_crop(hand, crop, coarse, crop.camera).image
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
    picture = draw_crop(hand, crop, made.gaussians, crop.camera).image
    shown = map_surface(crop.posed.vertices, hand.faces, Canvas(crop.image, crop.mask, crop.camera), FACING)
    believed = (first[hand.faces[shown.faces.clamp_min(0)]] * shown.barycentrics).sum(-1)
    inside = judged(hand, crop) * (shown.share > 0.99)
    for photo, share in ((crop, believed), (darker, 1 - believed)):
        own = inside * (share > 0.99)
        assert own.mean() > 0.05
        assert masked_psnr(picture, photo.image, own) > 30


@pytest.fixture(scope="module")
def photo():
    return read_photo(PHOTOS / "palm_flat_right_03.jpg")


def drawn(photo, color=(0.1, 0.15, 0.4)):
    """The photo with a disc, a thin line and a cross of hairs in `color`, and where they are."""
    mask = np.zeros(photo.rgb.shape[:2], np.uint8)
    cv2.circle(mask, (200, 330), 14, 255, -1, cv2.LINE_AA)
    cv2.line(mask, (170, 380), (250, 400), 255, 2, cv2.LINE_AA)
    share = torch.from_numpy(mask).float() / 255
    rgb = torch.lerp(photo.rgb.float() / 255, torch.tensor(color), share[..., None])
    return rgb, share


def saved(rgb, quality=None, scale=1.0):
    pixels = (rgb.numpy() * 255).round().astype(np.uint8)
    if scale != 1:
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LANCZOS4
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=how)
    if quality is not None:
        pixels = cv2.imdecode(cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality))[1], cv2.IMREAD_COLOR)
    return torch.from_numpy(pixels).float() / 255


@pytest.mark.parametrize(("quality", "scale"), [(None, 1.0), (95, 1.0), (70, 1.0), (85, 0.7), (90, 1.5), (75, 0.5)])
def test_paint_is_found_in_a_copy_that_was_scaled_and_compressed(photo, quality, scale):
    rgb, share = drawn(photo)
    painted = saved(rgb, quality, scale)
    height, width = painted.shape[:2]
    found = find_paint(match_size(photo, width, height, "x"), painted) > 0.5
    true = torch.from_numpy(cv2.resize(share.numpy(), (width, height))) > 0.5
    near = torch.from_numpy(cv2.dilate(true.numpy().astype(np.uint8), np.ones((15, 15)))) > 0
    assert found[true].float().mean() > 0.98
    assert (found & ~near).sum() < 0.03 * true.sum()


@pytest.mark.parametrize(("quality", "scale"), [(95, 1.0), (60, 1.0), (85, 0.7), (90, 1.5)])
def test_saving_and_scaling_alone_is_no_paint(photo, quality, scale):
    copy = saved(photo.rgb.float() / 255, quality, scale)
    assert find_paint(match_size(photo, copy.shape[1], copy.shape[0], "x"), copy).max() == 0


def test_faint_paint_is_found_in_an_exact_copy(photo):
    rgb, share = drawn(photo, color=tuple((photo.rgb[330, 200] / 255 + 0.15).clamp(max=1).tolist()))
    found = find_paint(photo.rgb.float() / 255, saved(rgb)) > 0.5
    disc = share.clone()
    disc[345:] = 0
    assert found[disc > 0.9].float().mean() > 0.98


def test_a_cut_or_turned_copy_is_refused_in_one_sentence(photo):
    for width, height in ((416, 416), (555, 416), (416, 400)):
        with pytest.raises(InputError, match=f"painted.png: {width} x {height} pixels do not have the proportions"):
            match_size(photo, width, height, "painted.png")


def test_rounded_sides_are_a_scaled_copy(photo):
    for width in range(100, 800, 37):
        assert match_size(photo, width, round(width * 555 / 416), "x").shape[1] == width


def test_a_mask_is_its_alpha_or_its_brightness(photo):
    grey = torch.zeros(100, 75, 3, dtype=torch.uint8)
    grey[20:40] = 255
    mask = Photo(grey, None, None, "mask.png", 1.0)
    assert torch.equal(read_mask(mask, 75, 100), (grey[..., 0] > 0).float())
    alpha = torch.rand(100, 75, generator=torch.Generator().manual_seed(0))
    assert torch.equal(read_mask(mask._replace(alpha=alpha), 75, 100), alpha)
    assert read_mask(mask, 150, 200)[50:70].min() > 0.99
