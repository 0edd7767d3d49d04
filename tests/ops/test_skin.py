"""Linear blend skinning: laws, and blends whose nearest rotation is hard to find."""

import math
from typing import Any

import pytest
import torch
from operator_calls import calls

from oasis_warp.core.rotation import from_axis_angle, to_matrix
from oasis_warp.ops import skinning
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
