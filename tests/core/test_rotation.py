import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from oasis_warp.core import rotation


def random_quats(n, seed):
    generator = torch.Generator().manual_seed(seed)
    q = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def test_matrices_agree_with_scipy():
    q = random_quats(100, 0)
    theirs = Rotation.from_quat(q[:, [1, 2, 3, 0]].numpy()).as_matrix()  # SciPy's are xyzw
    torch.testing.assert_close(rotation.to_matrix(q), torch.from_numpy(theirs), atol=1e-14, rtol=0)


def test_scaling_a_quaternion_changes_no_matrix():
    q = random_quats(20, 1)
    torch.testing.assert_close(rotation.to_matrix(3 * q), rotation.to_matrix(q), atol=1e-14, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1.0, math.pi - 1e-7, math.pi])
def test_matrix_to_quaternion_and_back_at_every_angle(angle):
    axes = random_quats(50, 2)[:, 1:]
    axes = axes / axes.norm(dim=-1, keepdim=True)
    matrices = rotation.from_axis_angle(axes, torch.full((50,), angle, dtype=torch.float64))
    quats = rotation.from_matrix(matrices)
    torch.testing.assert_close(rotation.to_matrix(quats), matrices, atol=1e-14, rtol=0)
    assert bool((quats[:, 0] >= 0).all())


def test_multiply_composes_rotations():
    a, b = random_quats(30, 3), random_quats(30, 4)
    composed = rotation.to_matrix(a) @ rotation.to_matrix(b)
    torch.testing.assert_close(rotation.to_matrix(rotation.multiply(a, b)), composed, atol=1e-14, rtol=0)
