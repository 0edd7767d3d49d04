"""Bone transforms against their reference, and what they owe a skeleton."""

import math

import pytest
import torch
from torch import Tensor

from oasis_warp.core.rotation import from_axis_angle, to_matrix
from oasis_warp.ops import bone_transforms

PARENTS = (-1, 0, 1, 1, 0, 4, 3)  # a chain of four, two forks
FLOATS = ("angles", "orientation", "translation", "joints")


def joint_rotations(angles: Tensor, axes: Tensor) -> Tensor:
    """Local rotations of all joints, the first one's the identity: the matrix product flexion @ abduction @ twist."""
    flexion, abduction, twist = (from_axis_angle(axes[1:, k], angles[:, k]) for k in range(3))
    first = torch.eye(3, dtype=angles.dtype, device=angles.device)[None]
    return torch.cat([first, flexion @ abduction @ twist])


def reference(angles: Tensor, orientation: Tensor, translation: Tensor, joints: Tensor, axes: Tensor, parents):
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
    got, want = bone_transforms(**ours), reference(**theirs)
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
def test_a_wrong_argument_is_named_with_what_was_expected(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        bone_transforms(**skeleton(0) | change)
