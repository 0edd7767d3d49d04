import copy

import pytest
import torch
from synthetic import PALM_TO_CAMERA, as_left_hand, avatar_of, crop_of, with_invented

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.wrist import hand_up
from oasis_warp.core import rotation
from oasis_warp.core.errors import InputError
from oasis_warp.core.mirror import mirror_points
from oasis_warp.core.types import CanonicalGaussians, HandPose
from oasis_warp.data.avatar_file import save_avatar
from oasis_warp.evaluation.metrics import coverage
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar


@pytest.fixture(scope="module")
def right(hand):
    crop, truth, pose = crop_of(hand, region_colors(label_regions(hand), 0.03), size=64)
    return avatar_of(hand, truth, pose, crop.camera)


@pytest.fixture(scope="module")
def left(right):
    return as_left_hand(right)


def test_a_left_hand_is_the_mirror_image_of_a_right_hand(left, right):
    ours, theirs = left.pose(left.source_pose), right.pose(right.source_pose)
    torch.testing.assert_close(ours.means, mirror_points(theirs.means), atol=1e-6, rtol=0)
    flip = torch.tensor([-1.0, 1.0, 1.0])
    turns, mirrored = rotation.to_matrix(ours.quats), rotation.to_matrix(theirs.quats) * flip * flip[:, None]
    torch.testing.assert_close(turns, mirrored, atol=2e-5, rtol=0)
    torch.testing.assert_close(ours.scales, theirs.scales, atol=1e-8, rtol=1e-5)
    torch.testing.assert_close(left.mesh(left.source_pose).tips, mirror_points(right.mesh(right.source_pose).tips))
    pictures = [a.render(a.source_camera, a.source_pose).image for a in (left, right)]
    difference = (pictures[0].flip(1) - pictures[1]).abs().amax(-1)
    # A layer at the cut of 1/255 may be drawn in one picture and left out of the other.
    assert difference.max() <= 6e-3 and (difference > 2e-4).float().mean() <= 2e-3


def test_the_mesh_carries_the_gaussians(left):
    pose = left.source_pose._replace(angles=named_pose(left.hand, "fist"))
    vertices, means = left.mesh(pose).vertices, left.pose(pose).means
    torch.testing.assert_close(means[:100], vertices[left.gaussians.vertex_index[:100]])


def test_a_pose_may_be_given_by_its_name(left, as_shipped):
    fist = left.source_pose._replace(angles=named_pose(left.hand, "fist"))
    picture = left.render(left.source_camera, "fist").image
    assert torch.equal(picture, left.render(left.source_camera, fist).image)
    assert torch.equal(left.mesh("fist").vertices, left.mesh(fist).vertices)
    assert torch.equal(left.pose("fist").means, left.pose(fist).means)
    for call in (left.mesh, left.pose, lambda pose: left.render(left.source_camera, pose)):
        with pytest.raises(ValueError, match=r"^pose: expected one of rest, .* got 'fits'\. Did you mean 'fist'\?$"):
            call("fits")
        with pytest.raises(TypeError, match=r"^pose: expected a HandPose or a pose's name, got tuple\.$"):
            call(tuple(fist))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("turn", [0.0, 1.5, 3.0])
def test_an_orbit_shows_no_hand_along_its_arm(side, turn, left, right):
    """A hand that points to the side was a stump of arm from 270 degrees."""
    avatar = {"left": left, "right": right}[side]
    source = avatar.source_pose
    roll = rotation.from_axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(turn))
    pose = source._replace(orientation=roll @ source.orientation)
    arm = -hand_up(avatar.hand, avatar.mesh(pose).vertices)
    for azimuth in (0.0, 1.6, 3.1, 4.7):
        view = avatar.orbit_camera(pose, azimuth).viewmat
        assert float((view[2, :3] @ arm).abs()) < 0.4


def test_an_orbit_is_around_one_pose(left):
    many = HandPose(*(torch.stack([part, part]) for part in left.held("fist")))
    with pytest.raises(ValueError, match=r"^pose\.angles: expected shape \[15, 3\], got .* One pose a camera\.$"):
        left.orbit_camera(many, 0.0)


@pytest.mark.parametrize("side", ["left", "right"])
def test_many_poses_are_what_as_many_calls_give(side, left, right):
    avatar = {"left": left, "right": right}[side]
    angles = [named_pose(avatar.hand, name) for name in ("fist", "pinch", "open")]
    shifts = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    poses = [HandPose(a, PALM_TO_CAMERA, t) for a, t in zip(angles, shifts, strict=True)]
    together = HandPose(*map(torch.stack, zip(*poses, strict=True)))
    gaussians, surfaces = avatar.pose(together), avatar.mesh(together)
    for k, pose in enumerate(poses):
        alone = avatar.pose(pose)
        assert all(torch.equal(a[k], b) for a, b in zip(gaussians[:3], alone[:3], strict=True))
        assert torch.equal(surfaces.vertices[k], avatar.mesh(pose).vertices)
    assert gaussians.opacities is avatar.gaussians.opacities and gaussians.colors is avatar.gaussians.colors


def test_a_shape_that_needs_a_gradient_gets_one_through_the_surface_at_rest_too(right):
    shape = right.shape.clone().requires_grad_()
    avatar = Avatar(
        side="right", shape=shape, surface_offsets=right.surface_offsets, gaussians=right.gaussians,
        source_pose=right.source_pose, source_camera=right.source_camera,
    )  # fmt: skip
    flat = avatar.source_pose._replace(angles=torch.zeros(15, 3))
    (both,) = torch.autograd.grad(avatar.pose(flat).scales.sum(), shape, retain_graph=True)
    posed = avatar.mesh(flat).vertices
    alone = pose_gaussians(avatar.gaussians, avatar.hand.faces, avatar.rest.vertices.detach(), posed).scales.sum()
    (left_behind,) = torch.autograd.grad(alone, shape)
    # An unbent hand grows as much posed as at rest.
    assert both.norm() < 1e-3 * left_behind.norm()


def test_an_avatar_survives_its_file_bit_for_bit(left, tmp_path):
    left.save(tmp_path / "a.safetensors")
    loaded = Avatar.load(tmp_path / "a.safetensors")
    assert loaded.side == "left"
    pose = HandPose(named_pose(left.hand, "pinch"), PALM_TO_CAMERA, torch.tensor([0.0, 0.1, 0.5]))
    for ours, theirs in zip(loaded.pose(pose), left.pose(pose), strict=True):
        assert torch.equal(ours, theirs)
    assert (loaded.source_camera.width, loaded.source_camera.height) == (64, 64)


def test_an_avatar_knows_what_of_it_is_invented_after_its_file_and_in_other_light(left, tmp_path):
    assert left.invented is None
    share = torch.linspace(0, 1, len(left.surface_offsets))
    with_invented(left, share).save(tmp_path / "a.safetensors")
    loaded = Avatar.load(tmp_path / "a.safetensors")
    for avatar in (loaded, loaded.in_even_light()):
        assert avatar.invented is not None and torch.equal(avatar.invented, share)


def test_attributes_from_which_all_else_is_computed_cannot_be_set(left):
    # Set, they changed no picture, and files held what no picture showed.
    for name in ("light", "shape", "invented"):
        with pytest.raises(AttributeError, match=rf"^Avatar\.{name}: attributes are fixed"):
            setattr(left, name, None)


def test_an_avatar_says_what_it_is(left):
    assert repr(left) == f"Avatar(left hand, {len(left.gaussians.colors)} Gaussians, on cpu)"


def test_an_avatar_moves_without_gradients_and_stays_itself_where_nothing_changes(left):
    assert left.to("cpu") is left
    there = with_invented(left, torch.zeros(len(left.surface_offsets), requires_grad=True)).to("cpu")
    assert there.invented is not None and not there.invented.requires_grad
    assert torch.equal(there.pose("fist").means, left.pose("fist").means)


def test_an_avatar_can_be_copied(left):
    twin = copy.deepcopy(left)
    assert torch.equal(twin.pose(left.source_pose).means, left.pose(left.source_pose).means)


def test_an_avatar_of_another_hand_model_is_refused(right, tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    written = {}

    def keep(_, tensors, header):
        written.update(t=tensors, h=header)

    monkeypatch.setattr("oasis_warp.hand_avatar.save_avatar", keep)
    right.save(path)
    save_avatar(path, written["t"], {**written["h"], "hand_model": "nimble"})
    with pytest.raises(InputError, match="nimble"):
        Avatar.load(path)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angles": torch.zeros(14, 3)}, r"pose\.angles: expected shape \[15, 3\], got \[14, 3\]"),
        ({"orientation": torch.eye(4)}, r"pose\.orientation: expected shape \[3, 3\]"),
        ({"translation": torch.tensor([0.0, float("nan"), 0])}, "translation: expected finite"),
        ({"angles": torch.zeros(2, 15, 3)}, r"pose\.orientation: expected shape \[2, 3, 3\]"),
    ],
)
def test_a_pose_that_is_none_is_refused(right, change, message):
    with pytest.raises(ValueError, match=message):
        right.pose(right.source_pose._replace(**change))


@pytest.mark.usefixtures("as_shipped")
def test_many_poses_are_no_picture(right):
    many = HandPose(*(part[None] for part in right.source_pose))
    with pytest.raises(ValueError, match=r"pose\.angles: expected shape \[15, 3\], got \[1, 15, 3\]. One pose a"):
        right.render(right.source_camera, many)


def test_an_unchecked_pose_is_posed_whatever_it_holds(right):
    broken = right.source_pose._replace(translation=torch.full((3,), torch.nan))
    assert right.pose(broken, validate=False).means.isnan().all()
    assert right.mesh(broken, validate=False).vertices.isnan().all()


@pytest.mark.usefixtures("as_shipped")
def test_a_camera_that_is_none_is_refused(right):
    camera = right.source_camera
    with pytest.raises(ValueError, match="K: expected finite"):
        right.render(camera._replace(K=camera.K * float("nan")), right.source_pose)
    with pytest.raises(ValueError, match=r"background: expected shape \[3\], got \[4\]"):
        right.render(camera, right.source_pose, (1.0, 1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match=r"camera\.viewmat: expected shape \[4, 4\], got \[3, 4\]"):
        right.render(camera._replace(viewmat=camera.viewmat[:3]), right.source_pose)


@pytest.mark.usefixtures("as_shipped")
def test_light_and_background_of_no_number_are_refused(right):
    # NaN was taken for the least light, and drawn as a plausible, darker picture.
    with pytest.raises(ValueError, match="harmonics: expected finite"):
        right.in_light(torch.full((9, 3), torch.nan))
    with pytest.raises(ValueError, match=r"harmonics: expected shape \[9, 3\], got \[4, 3\]"):
        right.in_light(torch.ones(4, 3))
    with pytest.raises(ValueError, match="background: expected finite"):
        right.render(right.source_camera, right.source_pose, (float("nan"), 0.0, 0.0))


def test_no_side_of_any_pose_has_holes(right):
    assert float(coverage(right, size=96).min()) >= 0.99


def test_pictures_are_differentiable_in_the_pose(right):
    angles = named_pose(right.hand, "relaxed").clone().requires_grad_(True)
    picture = right.render(right.source_camera, right.source_pose._replace(angles=angles))
    picture.image.square().mean().backward()
    assert angles.grad is not None
    assert bool(torch.isfinite(angles.grad).all())
    assert float(angles.grad.abs().max()) > 0


@pytest.mark.gpu
@pytest.mark.parametrize("side", ["left", "right"])
def test_replayed_pictures_are_the_drawn_ones_at_every_size_and_distance(side, left, right, tmp_path):
    {"left": left, "right": right}[side].save(tmp_path / "a.safetensors")
    there = Avatar.load(tmp_path / "a.safetensors", device="cuda")
    camera = there.source_camera
    for width, height, distance in [(64, 64, 0), (64, 64, 2), (96, 64, 0), (64, 64, 0), (64, 64, -0.3), (96, 64, 1)]:
        for name in ("fist", "open"):
            shift = torch.tensor([0.0, 0, distance]).to(there.device)
            pose = HandPose(
                named_pose(there.hand, name).cpu(), there.source_pose.orientation, there.source_pose.translation + shift
            )
            seen = camera._replace(width=width, height=height)
            color = (0.1, 0.2, 0.3)
            replayed = there.render(seen, pose, color)
            angles = pose.angles.cuda().requires_grad_()
            drawn = there.render(seen, pose._replace(angles=angles), color)
            assert drawn.image.requires_grad and not replayed.image.requires_grad
            assert replayed.image.shape == (height, width, 3)
            assert torch.equal(replayed.image, drawn.image) and torch.equal(replayed.alpha, drawn.alpha)


def test_a_device_that_is_not_there_is_refused_before_the_file_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for device in ("cuda", torch.device("cuda:1")):
        with pytest.raises(InputError, match=rf"^device {device}: torch finds no CUDA device; use device cpu"):
            Avatar.load(tmp_path / "none.safetensors", device)


@pytest.mark.gpu
def test_pictures_of_a_gpu_can_be_drawn_in_inference_mode_and_out_of_it(right, tmp_path):
    right.save(tmp_path / "a.safetensors")
    there = Avatar.load(tmp_path / "a.safetensors", device="cuda")
    with torch.inference_mode():
        inside = there.render(there.source_camera, there.source_pose).image
    outside = there.render(there.source_camera, there.source_pose).image
    assert torch.equal(inside, outside)


@pytest.mark.gpu
def test_a_gpu_draws_what_the_cpu_draws(right, tmp_path):
    right.save(tmp_path / "a.safetensors")
    there = Avatar.load(tmp_path / "a.safetensors", device="cuda")
    picture = there.render(there.source_camera, there.source_pose).image
    assert picture.is_cuda
    torch.testing.assert_close(
        picture.cpu(), right.render(right.source_camera, right.source_pose).image, atol=2e-3, rtol=0
    )


@pytest.mark.gpu
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_gpu_poses_what_the_cpu_poses_in_a_graph_too(side, left, right, tmp_path):
    here = {"left": left, "right": right}[side]
    here.save(tmp_path / "a.safetensors")
    there = Avatar.load(tmp_path / "a.safetensors", device="cuda")
    static = HandPose(*(part.cuda() for part in here.source_pose))
    there.pose(static, validate=False)  # loads the kernels, looks at the indices
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = there.pose(static, validate=False)
    pose = HandPose(named_pose(here.hand, "fist"), PALM_TO_CAMERA, torch.tensor([0.1, 0.2, 0.5]))
    for part, new in zip(static, pose, strict=True):
        part.copy_(new)
    graph.replay()
    want, eager = here.pose(pose), there.pose(pose)
    # Vertices half a metre away are rounded to 6e-8 m. Such a change of each vertex of a fist turns small faces so far
    # that numbers of quaternions differ by up to 8e-4, two such changes by 1.6e-3.
    for ours, again, theirs, off in zip(captured[:3], eager[:3], want[:3], (1e-5, 2e-3, 1e-5), strict=True):
        assert torch.equal(ours, again)
        torch.testing.assert_close(ours.cpu(), theirs, atol=off, rtol=0)


def test_fewer_gaussians_make_a_smaller_file_and_still_an_avatar(right):
    n = len(right.gaussians.vertex_index)
    empty = torch.zeros(0, dtype=torch.int64)
    few = CanonicalGaussians(
        right.gaussians.vertex_index, right.gaussians.offsets, empty, torch.zeros(0, 3),
        *(part[:n] for part in right.gaussians[4:8]),
    )  # fmt: skip
    avatar = right.with_looks(few, None)
    assert len(avatar.pose(avatar.source_pose).means) == n
