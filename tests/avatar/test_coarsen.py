import pytest
import torch
from synthetic import crop_of

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.densify import coarsen, densify
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import skin
from oasis_warp.losses.image import masked_psnr
from oasis_warp.render.render import render


@pytest.fixture(scope="module")
def case(hand):
    crop, fine, _ = crop_of(hand, region_colors(label_regions(hand), 0.03))
    return crop.rest, fine, coarsen(hand, fine, crop.rest)


def draw(hand, rest, gaussians, pose, size):
    still = HandPose(named_pose(hand, pose), torch.eye(3), torch.tensor([0.0, 0.0, 0.5]))
    posed = skin(hand, rest, still).vertices
    camera = orbit_camera(posed, 0.6, 0.3, size)
    return render(pose_gaussians(gaussians, hand.faces, rest.vertices, posed), camera)


@pytest.mark.parametrize("pose", ["open", "fist"])
def test_a_third_of_the_gaussians_look_alike_and_leave_no_gaps(hand, case, pose):
    rest, fine, coarse = case
    assert len(coarse.opacities) < 0.36 * len(fine.opacities)
    before, after = (draw(hand, rest, gaussians, pose, 128) for gaussians in (fine, coarse))
    assert masked_psnr(after.image, before.image, (before.alpha > 0.5).float()) > 28
    assert abs(after.alpha.sum() / before.alpha.sum() - 1) < 0.03
    before, after = (draw(hand, rest, gaussians, pose, 384) for gaussians in (fine, coarse))
    inside = inner_mask((before.alpha > 0.99).float(), 6) > 0.5
    assert inside.float().mean() > 0.1
    assert torch.quantile(after.alpha[inside], 0.01) > 0.95


def test_finer_gaussians_can_be_put_on_it_again(hand, case):
    rest, _, coarse = case
    parts = torch.ones(len(hand.faces), dtype=torch.long)
    far = rest.vertices[hand.faces].mean(1).sub(rest.vertices[hand.rim].mean(0)).norm(dim=1) > 0.06
    parts[far] = 2
    dense = densify(coarse, rest.vertices, hand.faces, parts)
    assert dense.n_new == 4 * int(far.sum())
    assert (dense.gaussians.opacities[-dense.n_new :] > 0.2).all()
