import numpy as np
import pytest
import torch
from splat_readers import gaussians_of_ply

from oasis_warp.core.types import Camera, Gaussians
from oasis_warp.export import export_avatar
from oasis_warp.hand.poses import named_pose
from oasis_warp.render.render import render


def redraw(avatar, pose, means, quats, scales, opacities, colors):
    """Draw what was read (y down, the wrist at the origin) as the photo's camera sees it, and the avatar itself."""
    wrist = avatar.mesh(pose).joints[0]
    camera, turned = avatar.source_camera, avatar.source_camera.viewmat.clone()
    turned[:3, :3] = torch.eye(3)
    turned[:3, 3] = camera.viewmat[:3, :3] @ wrist + camera.viewmat[:3, 3]
    parts = (torch.from_numpy(np.array(part, np.float32)) for part in (means, quats, scales, opacities, colors))
    drawn = render(Gaussians(*parts), Camera(turned, *camera[1:])).image
    return drawn, render(avatar.pose(pose), camera).image


def psnr(a, b):
    return float(-10 * (a - b).square().mean().log10())


@pytest.mark.parametrize("name", ["photo", "fist"])
def test_what_a_ply_holds_looks_as_the_avatar_does(avatar, name, tmp_path):
    pose = avatar.source_pose
    if name != "photo":
        pose = pose._replace(angles=named_pose(avatar.hand, name))
    export_avatar(avatar, tmp_path / "hand.ply", pose=pose)
    drawn, expected = redraw(avatar, pose, *gaussians_of_ply(tmp_path / "hand.ply"))
    assert psnr(drawn, expected) > 45


def test_means_of_a_ply_are_exact_and_lie_about_the_wrist(avatar, tmp_path):
    export_avatar(avatar, tmp_path / "hand.ply")
    means, quats, *_ = gaussians_of_ply(tmp_path / "hand.ply")
    pose, turn = avatar.source_pose, avatar.source_camera.viewmat[:3, :3]
    expected = (avatar.pose(pose).means - avatar.mesh(pose).joints[0]) @ turn.T
    assert np.abs(means - expected.numpy()).max() <= 1e-6
    assert np.abs(np.linalg.norm(quats, axis=1) - 1).max() < 1e-5


def test_without_its_light_a_ply_holds_the_colours_of_even_light(right_hand, tmp_path):
    colors = {}
    for light in ("baked", "none", None):
        export_avatar(right_hand, tmp_path / "hand.ply", light=light)
        colors[light] = gaussians_of_ply(tmp_path / "hand.ply")[-1]
    np.testing.assert_allclose(colors["none"], right_hand.in_even_light().gaussians.colors.numpy(), atol=1e-6)
    assert np.array_equal(colors["baked"], colors[None])
    assert np.abs(colors["baked"] - colors["none"]).max() > 0.1
