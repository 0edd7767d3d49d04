"""Gaussians stretched with their faces: twin, gradients, laws, flat faces, poison values, messages."""


import pytest
import torch

from oasis_warp.core.rotation import from_axis_angle, to_matrix
from oasis_warp.ops import pose_on_mesh_covars
from oasis_warp.reference import posing as twin

FLOATS = ("rest_vertices", "posed_vertices", "barycentrics", "quats", "scales")


def scene(seed, n_gaussians=40, dtype=torch.float64, device="cpu"):
    """A rumpled grid, the same one rumpled otherwise, and Gaussians on some of its faces in no order."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    n = 4
    y, x = torch.meshgrid(torch.arange(n + 1.0), torch.arange(n + 1.0), indexing="ij")
    rest = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3).double() + 0.15 * normal((n + 1) ** 2, 3)
    posed = (rest * torch.tensor([1.4, 0.7, 1.0]) + 0.2 * normal(*rest.shape)) @ to_matrix(normal(4)).T
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    floats = {
        "rest_vertices": rest,
        "posed_vertices": posed,
        "barycentrics": normal(n_gaussians, 3).softmax(-1),
        "quats": normal(n_gaussians, 4),
        "scales": normal(n_gaussians, 3).exp(),
    }
    face_index = torch.randint(len(faces) - 3, (n_gaussians,), generator=generator)
    moved = {name: tensor.to(device, dtype) for name, tensor in floats.items()}
    return moved | {"faces": faces.to(device), "face_index": face_index.to(device)}


def rel(a, b):
    """Relative L2 distance."""
    return (a.detach().double().cpu() - b.detach()).norm() / b.detach().norm()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients_are_those_of_the_twin(seed, dtype, device):
    ours = scene(seed, dtype=dtype, device=device)
    theirs = {k: v.cpu().double() if v.is_floating_point() else v.cpu() for k, v in ours.items()}
    for name in FLOATS:
        ours[name].requires_grad_()
        theirs[name].requires_grad_()
    got, want = pose_on_mesh_covars(**ours), twin.pose_on_mesh_covars(**theirs)
    tolerance = 2e-7 if dtype == torch.float32 else 1e-13
    generator = torch.Generator().manual_seed(seed)
    loss = twin_loss = 0
    for a, b in zip(got, want, strict=True):
        assert a.dtype == dtype and rel(a, b) < tolerance
        weights = torch.randn(b.shape, generator=generator, dtype=torch.float64)
        loss, twin_loss = loss + (a * weights.to(a)).sum(), twin_loss + (b * weights).sum()
    grads = torch.autograd.grad(loss, [ours[name] for name in FLOATS])
    for name, a, b in zip(FLOATS, grads, torch.autograd.grad(twin_loss, [theirs[n] for n in FLOATS]), strict=True):
        assert rel(a, b) < 10 * tolerance, name


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


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_the_unit_of_length_does_not_matter(unit):
    arguments = scene(6, dtype=torch.float32)
    one = pose_on_mesh_covars(**arguments)
    for name in ("rest_vertices", "posed_vertices", "scales"):
        arguments[name] = unit * arguments[name]
    scaled = pose_on_mesh_covars(**arguments)
    assert rel(scaled.means / unit, one.means.double()) < 1e-6
    assert rel(scaled.covars / unit / unit, one.covars.double()) < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rest_vertices": torch.zeros(25, 2).double()}, r"rest_vertices: expected shape \[V, 3\], got \[25, 2\]."),
        ({"posed_vertices": torch.zeros(24, 3).double()}, r"posed_vertices: expected shape \[25, 3\], got \[24, 3\]."),
        ({"faces": torch.full((32, 3), 25)}, r"faces: expected indices in 0 .. 24 \(25 vertices\)"),
        ({"face_index": torch.full((40,), 32)}, r"face_index: expected indices in 0 .. 31 \(32 faces\)"),
        ({"barycentrics": torch.zeros(39, 3).double()}, r"barycentrics: expected shape \[40, 3\], got \[39, 3\]."),
        ({"quats": torch.zeros(40, 3).double()}, r"quats: expected shape \[40, 4\], got \[40, 3\].*wxyz"),
        ({"scales": torch.zeros(40, 3)}, "scales: expected torch.float64 on cpu, got torch.float32 on cpu."),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_expected(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        pose_on_mesh_covars(**scene(0) | change)
