import itertools

import pytest
import torch

from oasis_warp.avatar import pose as posing
from oasis_warp.avatar.creases import Creases
from oasis_warp.avatar.folds import Folds, rows_of
from oasis_warp.avatar.pose import Bend, lit_in_steps
from oasis_warp.avatar.sky import sky_mesh
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.ops.corner_reading import Corners
from oasis_warp.ops.gaussian_light import light_gaussians

N, JOINTS = 1003, 15


@pytest.fixture
def scene(hand, device):
    """Gaussians with any shade, some of which have folds and others creases, on two surfaces."""
    random, n = torch.Generator().manual_seed(0), len(hand.template)

    def uniform(*shape, low=0.0, high=1.0):
        return (low + (high - low) * torch.rand(*shape, generator=random)).to(device)

    def whole(high, *shape):
        return torch.randint(high, shape, generator=random, dtype=torch.int32).to(device)

    shares = uniform(N, 3)
    corners = Corners(whole(n, N, 3), shares / shares.sum(1, keepdim=True))
    canonical = CanonicalGaussians(
        whole(n, 0), uniform(0, 3), whole(1, N), shares, uniform(N, 4), uniform(N, 3), uniform(N), colors=uniform(N, 3),
        shade=uniform(N, 3, low=0.2, high=1.9),
    )  # fmt: skip
    split = torch.randperm(N, generator=random).to(device)
    folded, creased = split[:300].sort().values, split[300:500].sort().values
    folds = Folds(
        folded, rows_of(folded, N), whole(JOINTS, 300, 2), uniform(300, 1), uniform(300, 3, low=-0.5, high=0.5),
        uniform(300, 1), uniform(JOINTS, low=-0.3, high=0.0), uniform(JOINTS),
    )  # fmt: skip
    mesh = sky_mesh(torch.device(device))
    creases = Creases(
        creased, rows_of(creased, N), Corners(*(part[creased] for part in corners)),
        uniform(200, 3, low=-0.5, high=0.5), uniform(200, 3, low=-0.5, high=0.5),
        uniform(len(mesh.vertices), low=1e-5, high=3e-5),
    )  # fmt: skip
    posed = torch.stack([hand.template, 1.1 * hand.template]).to(device)
    of_vertices = uniform(2, n, 5)
    return canonical, of_vertices, corners, Bend(folds, uniform(2, JOINTS, 3, high=1.6), creases), posed


def test_one_kernel_gives_what_many_steps_give(scene):
    canonical, of_vertices, corners, bend, posed = scene
    for shade, own in itertools.product((canonical.shade, None), (bend, None)):
        given = canonical._replace(shade=shade), of_vertices, corners, own, posed
        expected = lit_in_steps(*given)
        torch.testing.assert_close(posing.lit(*given), expected, atol=1e-5, rtol=1e-5)
        assert 0.01 < float(((expected > 0) & (expected < 1)).float().mean())
    plain = posing.lit(canonical, of_vertices, corners, None, posed)
    changed = (posing.lit(*scene) - plain).abs().amax((0, 2)) > 1e-3
    assert bool(changed[bend.folds.index].any()) and bool(changed[bend.creases.index].any())
    assert not changed[(bend.folds.row < 0) & (bend.creases.row < 0)].any()


def test_a_pose_alone_has_the_same_bits(scene):
    canonical, of_vertices, corners, bend, posed = scene
    together = posing.lit(*scene)
    for k in range(2):
        alone = posing.lit(canonical, of_vertices[k], corners, bend._replace(angles=bend.angles[k]), posed[k])
        assert torch.equal(alone, together[k])


def test_gradients_by_light_and_by_angles_take_the_steps(scene):
    canonical, of_vertices, corners, bend, posed = scene
    given = of_vertices.clone().requires_grad_(), bend.angles.clone().requires_grad_()
    out = posing.lit(canonical, given[0], corners, bend._replace(angles=given[1]), posed)
    for gradient in torch.autograd.grad(out.sum(), given):
        assert bool(gradient.isfinite().all()) and float(gradient.abs().max()) > 0


def test_no_gaussian_and_no_pose_are_no_special_case(scene):
    canonical, of_vertices, corners, _, _ = scene
    none = Corners(corners.index[:0], corners.weights[:0])
    assert light_gaussians(of_vertices, none, canonical.colors[:0], None, (0.3, 0.6)).shape == (2, 0, 3)
    assert light_gaussians(of_vertices[:0], corners, canonical.colors, None, (0.3, 0.6)).shape == (0, N, 3)
