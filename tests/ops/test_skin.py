"""Linear blend skinning and bone transforms: laws, references, and blends whose nearest rotation is hard to find."""

import math
from typing import Any

import pytest
import torch
from operator_calls import calls
from torch import Tensor

from oasis_warp.core.rotation import from_axis_angle, to_matrix
from oasis_warp.ops import bone_transforms, skinning
from oasis_warp.reference import posing as reference


def skin(*args, **options) -> Any:
    """For the type checker: covariances are there."""
    return skinning.skin(*args, **options)


def scene(seed, n_joints=16, rigid=False):
    """Points, covariances (not even symmetric ones), weights and transforms without any structure, or rigid ones."""
    generator, n = torch.Generator().manual_seed(seed), 41

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    linear = to_matrix(normal(n_joints, 4)) if rigid else normal(n_joints, 3, 3)
    return {
        "means": normal(n, 3),
        "covars": normal(n, 3, 3),
        "weights": normal(n, n_joints).softmax(-1),
        "transforms": torch.cat([linear, normal(n_joints, 3, 1)], -1),
    }


def test_points_alone_move_as_with_covariances_and_none_come_out():
    arguments = scene(3)
    leaves = [arguments[name].requires_grad_() for name in ("means", "weights", "transforms")]
    both = skin(**arguments)
    alone = skin(**arguments | {"covars": None})
    assert alone.covars is None and torch.equal(alone.means, both.means)
    weights = torch.arange(float(both.means.numel())).view_as(both.means)
    first, second = (torch.autograd.grad((out.means * weights).sum(), leaves) for out in (both, alone))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_transforms_of_four_rows_are_those_of_three_and_their_last_row_gets_no_gradient():
    arguments = scene(7)
    last = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(16, 1, 4)
    square = torch.cat([arguments["transforms"], last], 1).requires_grad_()
    got = skin(**arguments | {"transforms": square})
    assert all(torch.equal(a, b) for a, b in zip(got, skin(**arguments), strict=True))
    (grad,) = torch.autograd.grad(got.means.sum(), square)
    assert grad[:, :3].any() and not grad[:, 3].any()


@pytest.mark.parametrize("rotation_only", [False, True])
def test_one_rigid_motion_of_all_bones_moves_everything_rigidly(rotation_only):
    arguments = scene(8)
    turn = to_matrix(torch.randn(4, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    shift = torch.tensor([1.0, -2, 3], dtype=torch.float64)
    arguments["transforms"] = torch.cat([turn, shift[:, None]], 1).expand(16, 3, 4)
    got = skin(**arguments, rotation_only=rotation_only)
    torch.testing.assert_close(got.means, arguments["means"] @ turn.T + shift)
    torch.testing.assert_close(got.covars, turn @ arguments["covars"] @ turn.T)


def test_rotation_only_keeps_the_axes_lengths():
    arguments = scene(9, rigid=True)
    half = arguments["covars"]
    arguments["covars"] = half @ half.transpose(1, 2)
    got = skin(**arguments, rotation_only=True).covars
    torch.testing.assert_close(torch.linalg.eigvalsh(got), torch.linalg.eigvalsh(arguments["covars"]))


def blend_of_turns(angles, axis=(0.0, 0.0, 1.0)):
    """One point between two bones, turned by these angles [rad] about `axis`, with equal shares."""
    axis = torch.tensor(axis, dtype=torch.float64)
    turns = torch.stack([from_axis_angle(axis, torch.tensor(a, dtype=torch.float64)) for a in angles])
    return {
        "means": torch.zeros(1, 3, dtype=torch.float64),
        "covars": torch.diag(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))[None],
        "weights": torch.full((1, 2), 0.5, dtype=torch.float64),
        "transforms": torch.cat([turns, torch.zeros(2, 3, 1, dtype=torch.float64)], -1),
    }


@pytest.mark.parametrize("gap", [1.0, 1e-2, 1e-5])
def test_between_almost_opposite_bones_the_rotation_is_the_one_half_way(gap):
    # Turns of 0 and pi - gap: the blend is almost flat, but the nearest rotation is well-defined.
    arguments = blend_of_turns([0.0, math.pi - gap])
    arguments["transforms"].requires_grad_()
    got = skin(**arguments, rotation_only=True).covars
    angle = torch.tensor((math.pi - gap) / 2, dtype=torch.float64)
    half = from_axis_angle(torch.tensor([0.0, 0, 1]).double(), angle)
    torch.testing.assert_close(got.detach(), half @ arguments["covars"] @ half.T, rtol=0, atol=1e-14 / gap)
    (grad,) = torch.autograd.grad(got[0, 0, 1], arguments["transforms"])
    assert grad.isfinite().all() and grad.any()


def test_where_the_nearest_rotation_is_not_unique_there_is_one_without_gradient():
    for arguments in (blend_of_turns([0.0, math.pi]), blend_of_turns([0.0, 0.0])):
        if arguments["transforms"][0].equal(arguments["transforms"][1]):
            arguments["transforms"] = torch.zeros_like(arguments["transforms"])
        arguments["transforms"].requires_grad_()
        got = skin(**arguments, rotation_only=True).covars
        assert torch.allclose(torch.linalg.eigvalsh(got.detach())[0], torch.tensor([1.0, 2.0, 3.0]).double())
        (grad,) = torch.autograd.grad(got.square().sum(), arguments["transforms"])
        assert not grad.any()


def test_a_mirroring_blend_still_turns_by_a_proper_rotation():
    arguments = scene(10, n_joints=1)
    linear = arguments["transforms"][0, :, :3]
    arguments["transforms"][0, 0] *= -torch.det(linear).sign()
    assert torch.det(arguments["transforms"][0, :, :3]) < 0
    got = skin(**arguments, rotation_only=True).covars
    *_, want = reference.skin(**arguments, rotation_only=True)
    torch.testing.assert_close(got, want)
    torch.testing.assert_close(got.det(), arguments["covars"].det())


@pytest.mark.parametrize("name", ["skin correctives", "skin poses"])
def test_correctives_shift_points_before_the_bones_carry_them(name, device):
    arguments = calls(device=device)[name].arguments
    displacements, strengths = arguments.pop("displacements"), arguments.pop("strengths")
    got = skin(**arguments, displacements=displacements, strengths=strengths).means
    shifts = (displacements @ strengths.mT).movedim(-1, 0) if strengths.ndim > 1 else (displacements @ strengths)[None]
    transforms = arguments["transforms"] if strengths.ndim > 1 else arguments["transforms"][None]
    for one, shift, transform in zip(got.view(-1, *got.shape[-2:]), shifts, transforms, strict=True):
        moved = arguments | {"means": arguments["means"] + shift, "transforms": transform}
        torch.testing.assert_close(one, skin(**moved).means, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transforms": torch.zeros(16, 5, 4).double()}, r"transforms: expected shape \[16, 4, 4\], got \[16, 5, 4\]."),
        ({"covars": None, "rotation_only": True}, "rotation_only: expected False without covars, got True."),
        ({"strengths": torch.zeros(5)}, "displacements: expected a tensor, got None. It goes with strengths."),
        ({"displacements": torch.zeros(41, 3, 5)}, "strengths: expected a tensor, got None. It goes with displace"),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_expected(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        skin(**scene(0) | change)


PARENTS = (-1, 0, 1, 1, 0, 4, 3)  # a chain of four, two forks
FLOATS = ("angles", "orientation", "translation", "joints")


def joint_rotations(angles: Tensor, axes: Tensor) -> Tensor:
    """Local rotations of all joints, the first one's the identity: the matrix product flexion @ abduction @ twist."""
    flexion, abduction, twist = (from_axis_angle(axes[1:, k], angles[:, k]) for k in range(3))
    first = torch.eye(3, dtype=angles.dtype, device=angles.device)[None]
    return torch.cat([first, flexion @ abduction @ twist])


def expected(angles: Tensor, orientation: Tensor, translation: Tensor, joints: Tensor, axes: Tensor, parents):
    """`bone_transforms` of one pose, joint by joint in torch: transforms [J, 3, 4] and bends [2 (J - 1)]."""
    local = joint_rotations(angles, axes)
    rotations, origins = [orientation], [orientation @ joints[0] + translation]
    for j in range(1, len(parents)):
        parent = parents[j]
        rotations.append(rotations[parent] @ local[j])
        origins.append(rotations[parent] @ (joints[j] - joints[parent]) + origins[parent])
    rotation = torch.stack(rotations)
    shift = torch.stack(origins) - (rotation @ joints[..., None])[..., 0]
    c = 1 - torch.cos(angles[:, 0])
    return torch.cat([rotation, shift[..., None]], -1), torch.stack([c, c * c], -1).flatten()


def skeleton(seed, dtype=torch.float64, device="cpu", poses=()):
    """Random joints, axes and poses."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(device, dtype)

    n = len(PARENTS)
    return {
        "angles": normal(*poses, n - 1, 3),
        "orientation": to_matrix(normal(*poses, 4)),
        "translation": normal(*poses, 3),
        "joints": normal(n, 3),
        "axes": torch.nn.functional.normalize(normal(n, 3, 3), dim=-1),
        "parents": PARENTS,
    }


def rel(a, b):
    """Relative L2 distance."""
    return (a.detach().double().cpu() - b.detach()).norm() / b.detach().norm()


def weighted(out, seed=0):
    """A random weighting of all outputs."""
    generator = torch.Generator().manual_seed(seed)
    return sum((o * torch.randn(o.shape, generator=generator, dtype=torch.float64).to(o)).sum() for o in out)


@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients_are_those_of_the_reference(seed, dtype, device):
    ours = skeleton(seed, dtype, device)
    theirs = {name: t.cpu().double() if name != "parents" else t for name, t in ours.items()}
    leaves = [ours[name].requires_grad_() for name in FLOATS]
    wide = [theirs[name].requires_grad_() for name in FLOATS]
    got, want = bone_transforms(**ours), expected(**theirs)
    # Axes are rounded to the same numbers; the reference's formulas are exact for unit ones, and so is the adjoint.
    tolerance = 2e-7 if dtype == torch.float32 else 1e-14
    for a, b in zip(got, want, strict=True):
        assert a.dtype == dtype and rel(a, b) < tolerance
    pairs = zip(
        FLOATS, torch.autograd.grad(weighted(got), leaves), torch.autograd.grad(weighted(want), wide), strict=True
    )
    for name, a, b in pairs:
        assert rel(a, b) < (1e-6 if dtype == torch.float32 else 1e-13), name


def test_a_skeleton_of_one_bone_only_moves():
    orientation, translation = to_matrix(torch.tensor([1.0, 2, 3, 4])), torch.tensor([1.0, 2, 3])
    nothing = torch.zeros(0, 3)
    out = bone_transforms(nothing, orientation, translation, torch.ones(1, 3), torch.ones(1, 3, 3), [-1])
    assert torch.equal(out.transforms[0], torch.cat([orientation, translation[:, None]], 1)) and not len(out.bends)


def test_without_angles_every_bone_moves_as_the_first():
    arguments = skeleton(8)
    arguments["angles"].zero_()
    moved = torch.cat([arguments["orientation"], arguments["translation"][:, None]], 1)
    out = bone_transforms(**arguments)
    torch.testing.assert_close(out.transforms, moved.expand(7, 3, 4))
    assert not out.bends.any()


def test_a_joint_stays_where_its_parent_carries_it():
    arguments = skeleton(9)
    transforms, joints = bone_transforms(**arguments).transforms, arguments["joints"]
    parents = [max(parent, 0) for parent in PARENTS]
    by_itself, by_parent = (
        (t[..., :3] @ joints[..., None])[..., 0] + t[..., 3] for t in (transforms, transforms[parents])
    )
    torch.testing.assert_close(by_itself, by_parent)


def test_flexion_acts_last_and_twist_first():
    arguments = skeleton(10)
    arguments["orientation"] = torch.eye(3, dtype=torch.float64)
    turns = [from_axis_angle(arguments["axes"][1, k], arguments["angles"][0, k]) for k in range(3)]
    torch.testing.assert_close(bone_transforms(**arguments).transforms[1, :, :3], turns[0] @ turns[1] @ turns[2])


def test_bends_keep_their_digits_at_small_angles():
    arguments = skeleton(11, torch.float32)
    arguments["angles"] = torch.full((6, 3), 1e-3)
    want = 1 - math.cos(float(torch.tensor(1e-3)))
    torch.testing.assert_close(bone_transforms(**arguments).bends[::2], torch.full((6,), want), rtol=1e-6, atol=0)


def test_the_joints_of_the_reference_turn_by_rotations_and_the_first_not_at_all():
    arguments = skeleton(12)
    local = joint_rotations(arguments["angles"], arguments["axes"])
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(local @ local.mT, eye.expand(7, 3, 3))
    assert torch.linalg.det(local).gt(0).all() and torch.equal(local[0], eye)


def test_axes_that_are_not_finite_are_refused():
    arguments = skeleton(0)
    arguments["axes"][1, 2, 0] = math.nan
    with pytest.raises(ValueError, match="^axes: expected finite values .* got 1 of "):
        bone_transforms(**arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angles": torch.zeros(5, 3).double()}, r"angles: expected shape \[6, 3\], got \[5, 3\]. One row for each"),
        ({"angles": torch.zeros(2, 6, 3).double()}, r"orientation: expected shape \[2, 3, 3\], got \[3, 3\]."),
        ({"parents": (-1, 0, 2, 1, 0, 4, 3)}, "parents: expected -1, then an earlier bone for each other one, got "),
        ({"parents": (0, 0, 1, 1, 0, 4, 3)}, "parents: expected -1, then an earlier bone for each other one, got "),
        ({"parents": ()}, r"parents: expected -1, then an earlier bone for each other one, got \[\]."),
    ],
)
def test_a_wrong_argument_of_bone_transforms_is_named(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        bone_transforms(**skeleton(0) | change)
