import pytest
import torch
from synthetic import avatar_of, crop_of

from oasis_warp.avatar import folds as found
from oasis_warp.avatar.anchors import vertex_colors
from oasis_warp.avatar.appearance import label_regions
from oasis_warp.avatar.pose import in_even_light
from oasis_warp.avatar.vertex_light import posed_lighting
from oasis_warp.core.types import HandLight, HandPose
from oasis_warp.hand_avatar import Avatar

DARK = 0.8
"""Factor of the colours of folds."""


@pytest.fixture(scope="module")
def wrinkled(hand):
    """An avatar of straight fingers with dark folds, in the photo's light."""
    knuckle = label_regions(hand).knuckle[:, None]
    colors = 0.5 * (1 - (1 - DARK) * (knuckle > 0.5).float()).expand(-1, 3)
    crop, truth, pose = crop_of(hand, colors, size=64, pose_name="open")
    n = len(hand.template)
    light = HandLight(
        torch.eye(9, 3)[:, :1].expand(9, 3).clone(), torch.tensor([[0.2] * 3, [1.6] * 3]), torch.ones(3),
        shade=torch.ones(n, 3), facing=crop.posed.vertices.new_tensor([0.0, 0.0, -1.0]).expand(n, 3).clone(),
    )  # fmt: skip
    return avatar_of(hand, truth, pose, crop.camera, light)


def colors_of_joint(avatar, angles, name):
    """Mean colour of the darkest folds of a joint in a pose."""
    folds = found.find_folds(avatar.hand, avatar.gaussians, avatar.invented, avatar.source_pose.angles)
    of_joint = (folds.joints == avatar.hand.joint_names.index(name) - 1).all(1) & (folds.change.amin(1) > 0.15)
    assert int(of_joint.sum()) > 20
    posed = avatar.pose(avatar.source_pose._replace(angles=angles))
    return float(posed.colors[..., folds.index[of_joint], :].mean())


def bent(avatar, name, flexion):
    angles = avatar.source_pose.angles.clone()
    angles[avatar.hand.joint_names.index(name) - 1, 0] += flexion
    return angles


def painted(avatar):
    """The same, all of it painted."""
    return Avatar(
        side=avatar.side, shape=avatar.shape, surface_offsets=avatar.surface_offsets, gaussians=avatar.gaussians,
        source_pose=avatar.source_pose, source_camera=avatar.source_camera, light=avatar.light,
        invented=torch.ones(len(avatar.hand.template)), hand=avatar.hand,
    )  # fmt: skip


def test_dark_folds_open_when_their_joint_bends_and_no_others(wrinkled):
    """Folds that stayed on bent fingers looked like soot."""
    for name, other in (("index2", "middle2"), ("ring3", "ring2")):
        straight = wrinkled.source_pose.angles
        curled = bent(wrinkled, name, 1.6)
        assert colors_of_joint(wrinkled, curled, name) / colors_of_joint(wrinkled, straight, name) > 1.1
        assert colors_of_joint(wrinkled, curled, other) == pytest.approx(
            colors_of_joint(wrinkled, straight, other), rel=0.02
        )


def test_skin_stretched_over_a_joint_is_paler_and_warmer_than_around_it(wrinkled):
    """Brown spots were left of folds that had opened but for their lines: fingers of a fist looked dirty."""
    folds = found.find_folds(wrinkled.hand, wrinkled.gaussians, None, wrinkled.source_pose.angles)
    most = folds.change[(folds.joints[:, 0] == folds.joints[:, 1]) & (folds.change.amin(1) > 0.15)]
    red, green, blue = most.median(0).values
    assert 0.2 < float(blue) < float(green) < float(red) < 0.4  # e^.22 makes up for DARK
    plain = found.find_folds(
        wrinkled.hand, wrinkled.gaussians._replace(colors=torch.full_like(wrinkled.gaussians.colors, 0.4)), None,
        wrinkled.source_pose.angles,
    )  # fmt: skip
    fold = plain.change[(plain.joints[:, 0] == plain.joints[:, 1])]
    torch.testing.assert_close(fold.amax(0), fold.new_tensor(found.STRETCHED), rtol=1e-3, atol=0)


def test_what_the_photo_shows_of_bent_fingers_stays_and_painted_folds_are_those_of_straight_ones(wrinkled):
    curled = bent(wrinkled, "index2", 1.6)
    of_fist = Avatar(
        side=wrinkled.side, shape=wrinkled.shape, surface_offsets=wrinkled.surface_offsets,
        gaussians=wrinkled.gaussians, source_pose=wrinkled.source_pose._replace(angles=curled),
        source_camera=wrinkled.source_camera, light=wrinkled.light._replace(facing=None, shade=None),
    )  # fmt: skip
    folds = found.find_folds(of_fist.hand, of_fist.gaussians, None, curled)
    kept = found.open_folds(folds, curled)
    assert float(kept.logs.abs().max()) == float(kept.share.max()) == float(kept.painted.abs().max()) == 0
    opened = found.open_folds(folds._replace(painted=torch.ones_like(folds.painted)), curled).painted
    assert float(opened.amax()) > 0.1
    assert colors_of_joint(painted(of_fist), curled, "index2") > 1.1 * colors_of_joint(of_fist, curled, "index2")


def test_many_poses_at_once_open_the_same_and_the_photos_own_view_does_not_change(wrinkled):
    curled = bent(wrinkled, "middle2", 1.2)
    alone = wrinkled.pose(wrinkled.source_pose._replace(angles=curled)).colors
    source = wrinkled.source_pose
    angles = torch.stack([source.angles, curled])
    many = wrinkled.pose(HandPose(angles, source.orientation.expand(2, 3, 3), source.translation.expand(2, 3)))
    torch.testing.assert_close(many.colors[1], alone)
    folds = found.find_folds(wrinkled.hand, wrinkled.gaussians, torch.ones(len(wrinkled.hand.template)), source.angles)
    in_photo = wrinkled.with_looks(wrinkled.gaussians, wrinkled.light._replace(facing=wrinkled_normals(wrinkled)))
    in_photo._folds = folds._replace(straight=folds.straight - 3)  # all are open but for the photo's shade
    plain = wrinkled.with_looks(in_photo.gaussians, in_photo.light)
    plain._folds = None
    torch.testing.assert_close(in_photo.pose(source).colors, plain.pose(source).colors)


def wrinkled_normals(avatar):
    """Where its vertices face in the photo."""
    return posed_lighting(avatar.rest.vertices, avatar._photo_surface(), avatar.hand.faces, avatar.light).normals


def test_even_light_leaves_them_as_they_are(wrinkled):
    even = wrinkled.with_looks(in_even_light(wrinkled.gaussians, wrinkled.light), None)
    assert even.parts.folds is None
    posed = even.pose(even.source_pose._replace(angles=bent(even, "index2", 1.6)))
    assert torch.equal(posed.colors, even.gaussians.colors)


@pytest.fixture(scope="module")
def backs(hand):
    """Avatars of flat hands whose backs have a dark line along the middle finger's bone, as deep as it says."""

    def of(logarithm):
        middle = hand.joints[hand.joint_names.index("middle1")]
        along = hand.template[:, 0] / middle[0]
        line = (hand.template[:, 2] - along * middle[2]).abs() < 0.002
        deep = line & (along > 0.45) & (along < 0.85) & (label_regions(hand).palm < 0.1)
        colors = 0.5 * torch.where(deep, logarithm, 0.0).exp()[:, None].expand(-1, 3)
        crop, truth, pose = crop_of(hand, colors, size=64, pose_name="open")
        even = torch.eye(9, 3)[:, :1].expand(9, 3).clone()
        light = HandLight(even, torch.tensor([[0.2] * 3, [1.6] * 3]), torch.ones(3))
        return avatar_of(hand, truth, pose, crop.camera, light), deep

    return of


def fist(avatar):
    angles = avatar.source_pose.angles.clone()
    angles[[avatar.hand.joint_names.index(f"{name}1") - 1 for name in ("index", "middle", "ring", "little")], 0] += 1.5
    return angles


def opened_by(avatar, angles):
    """What the pose adds to the logarithms of the colours of all Gaussians."""
    folds = found.find_folds(avatar.hand, avatar.gaussians, avatar.invented, avatar.source_pose.angles)
    opened = found.open_folds(folds, angles)
    return torch.zeros_like(avatar.gaussians.colors).index_copy(0, opened.index, opened.logs + opened.painted)


def on_vertices(values, avatar):
    return vertex_colors(avatar.gaussians._replace(colors=values), len(avatar.hand.template)).mean(1)


def test_the_hollow_beside_a_tendon_becomes_shallow_in_a_fist_and_ink_stays(backs):
    """A photo's trench of .4 in a fist looked like a scar."""
    hollow, deep = backs(-0.4)
    inked, _ = backs(-1.5)
    assert 0.1 < float(on_vertices(opened_by(hollow, fist(hollow)), hollow)[deep].mean()) < 0.35
    assert float(opened_by(hollow, hollow.source_pose.angles).abs().max()) == 0
    assert float(on_vertices(opened_by(inked, fist(inked)), inked)[deep].abs().max()) < 0.05


def test_knuckles_of_a_fist_are_pale_and_a_finger_that_stays_straight_keeps_its_own(backs):
    plain, _ = backs(0.0)
    hand = plain.hand
    angles = fist(plain)
    angles[hand.joint_names.index("index1") - 1] = plain.source_pose.angles[hand.joint_names.index("index1") - 1]
    added = on_vertices(opened_by(plain, angles), plain)
    back = label_regions(hand).palm < 0.1
    for name, low, high in (("ring1", 0.05, 0.12), ("middle1", 0.05, 0.12), ("index1", -0.02, 0.02)):
        apart = (hand.template - hand.joints[hand.joint_names.index(name)])[:, [0, 2]].norm(dim=1)
        assert low < float(added[back & (apart < 0.002)].mean()) < high, name
