"""Gaussians stretched with their faces: laws, and flat faces."""

import pytest
import torch
from operator_calls import calls

from oasis_warp.core.rotation import from_axis_angle, to_matrix
from oasis_warp.ops import pose_on_mesh_covars


def scene(seed, dtype=torch.float64):
    """Arguments: 35 Gaussians on some of the 32 faces of a rumpled grid."""
    return calls(seed, dtype=dtype)["pose_on_mesh_covars"].arguments


def test_a_rigid_motion_turns_covariances():
    arguments = scene(3)
    turn = from_axis_angle(torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64), torch.tensor(2.5).double())
    arguments["posed_vertices"] = arguments["rest_vertices"]
    still = pose_on_mesh_covars(**arguments)
    arguments["posed_vertices"] = arguments["rest_vertices"] @ turn.T + 5
    moved = pose_on_mesh_covars(**arguments)
    half = to_matrix(arguments["quats"]) * arguments["scales"][:, None]
    torch.testing.assert_close(still.covars, half @ half.transpose(1, 2))
    torch.testing.assert_close(moved.covars, turn @ still.covars @ turn.T)
    torch.testing.assert_close(moved.means, still.means @ turn.T + 5)


def test_a_stretch_in_the_plane_stretches_along_its_direction_only():
    rest = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    posed = rest * torch.tensor([3.0, 0.5, 1.0])
    scales = torch.tensor([[0.2, 0.3, 0.4]], dtype=torch.float64)
    thirds, upright = torch.full((1, 3), 1 / 3).double(), torch.tensor([[1.0, 0, 0, 0]]).double()
    face, index = torch.tensor([[0, 1, 2]]), torch.tensor([0])
    covars = pose_on_mesh_covars(rest, posed, face, index, thirds, upright, scales).covars[0]
    # Along the normal a Gaussian keeps its thickness.
    torch.testing.assert_close(covars, torch.diag(torch.tensor([0.6, 0.15, 0.4]).double() ** 2))


def test_equal_scales_have_a_gradient():
    # An eigenvalue decomposition would divide by the difference of equal eigenvalues.
    arguments = scene(4)
    arguments["posed_vertices"] = arguments["rest_vertices"].clone().requires_grad_()
    arguments["scales"] = torch.ones_like(arguments["scales"])
    covars = pose_on_mesh_covars(**arguments).covars
    (grad,) = torch.autograd.grad((covars * torch.arange(9.0).view(3, 3)).sum(), arguments["posed_vertices"])
    assert grad.isfinite().all() and grad.any()


@pytest.mark.parametrize("flat", ["rest_vertices", "posed_vertices"])
def test_a_flat_face_leaves_covariances_alone_and_has_no_gradient(flat):
    arguments = scene(5)
    a, b, c = arguments["faces"][0]
    arguments["face_index"][:] = 0
    arguments[flat][c] = (arguments[flat][a] + arguments[flat][b]) / 2
    meshes = [arguments[name].requires_grad_() for name in ("rest_vertices", "posed_vertices")]
    covars = pose_on_mesh_covars(**arguments).covars
    half = to_matrix(arguments["quats"]) * arguments["scales"][:, None]
    torch.testing.assert_close(covars.detach(), half @ half.transpose(1, 2))
    assert not any(grad.any() for grad in torch.autograd.grad(covars.sum(), meshes))
