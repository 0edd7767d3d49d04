import pytest
import torch

from oasis_warp.adaptation.repaint import repaint
from oasis_warp.adaptation.reprojection import Canvas
from oasis_warp.avatar.pose import pose_gaussians, with_shade_baked
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import BLACK
from oasis_warp.core.types import Camera
from oasis_warp.losses.image import masked_psnr
from oasis_warp.ops import depth_map
from oasis_warp.render.render import render
from studies.painted_truth import Chart, draw_truth, make_truth

pytestmark = pytest.mark.slow

SIZE = 192


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
    depth = float(truth.avatar.mesh(truth.pose).vertices[truth.hand.segment == 0].mean(0)[2])
    millimetre = float(canvas.camera.K[0, 0]) / depth * 1e-3
    mask = torch.zeros_like(canvas.mask)
    y, x = (int(v) for v in torch.nonzero(canvas.mask > 0.9).float().mean(0))
    half = round(8 * millimetre)
    mask[y - half : y + half, x - half : x + half] = 1
    made = run(truth, canvas._replace(mask=mask), steps=0)
    expected = (2 * half / millimetre) ** 2
    assert 0.9 * expected < 1e6 * made.area < 1.4 * expected  # the palm is curved and a little turned


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
