import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from oasis_warp.ops import spherical_harmonics
from oasis_warp.reference import rasterization as twin

DEGREES = range(4)


def textbook_basis(degree, directions):
    """[N, (degree + 1)^2] in float64 by SciPy; directions [N, 3] need not be unit."""
    x, y, z = torch.nn.functional.normalize(directions.double(), dim=-1).numpy().T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for degree_l in range(degree + 1):
        for m in range(-degree_l, degree_l + 1):
            value = sph_harm_y(degree_l, abs(m), polar, azimuth)  # carries the Condon-Shortley sign
            if m < 0:
                columns.append(np.sqrt(2) * value.imag)
            elif m == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * value.real)
    return torch.from_numpy(np.stack(columns, -1))


@pytest.mark.parametrize("degree", DEGREES)
def test_the_twin_is_the_textbook_basis(degree):
    directions, _ = directions_and_coefficients(degree)
    torch.testing.assert_close(twin.sh_basis(degree, directions), textbook_basis(degree, directions))


def directions_and_coefficients(degree, n=50, seed=0, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    directions = torch.randn(n, 3, generator=g, dtype=torch.float64) * 10 ** torch.empty(n, 1).uniform_(
        -2, 2, generator=g
    )
    coefficients = torch.randn(n, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64)
    return directions.to(dtype), coefficients.to(dtype)


@pytest.mark.parametrize("degree", DEGREES)
def test_sums_are_those_of_the_textbook_basis(degree, device):
    directions, coefficients = directions_and_coefficients(degree)
    expected = (textbook_basis(degree, directions)[..., None] * coefficients).sum(1)
    got = spherical_harmonics(degree, directions.to(device), coefficients.to(device)).cpu()
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("degree", DEGREES)
def test_float32_is_as_good_as_its_numbers(degree, device):
    exact = [t.to(device) for t in directions_and_coefficients(degree, dtype=torch.float32)]
    got = spherical_harmonics(degree, *exact)
    expected = spherical_harmonics(degree, *(t.double() for t in exact))
    assert (got - expected).norm() <= 5e-7 * expected.norm()


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("degree", DEGREES)
def test_gradients_are_those_of_finite_differences(degree, device):
    directions, coefficients = (t.to(device).requires_grad_() for t in directions_and_coefficients(degree, n=6))
    directions = torch.nn.functional.normalize(directions.detach(), dim=-1).mul_(1.7).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda d, c: spherical_harmonics(degree, d, c), (directions, coefficients), nondet_tol=0.0
    )


def test_further_coefficients_are_not_read_and_get_no_gradient(device):
    directions, coefficients = (t.to(device) for t in directions_and_coefficients(3))
    coefficients.requires_grad_()
    got = spherical_harmonics(1, directions, coefficients)
    assert torch.equal(got, spherical_harmonics(1, directions, coefficients[:, :4]))
    (g,) = torch.autograd.grad(got.sum(), coefficients)
    assert not g[:, 4:].any() and g[:, :4].any()


def test_one_set_of_coefficients_serves_many_directions(device):
    directions, coefficients = (t.to(device) for t in directions_and_coefficients(2))
    views = torch.stack([directions, -directions])
    got = spherical_harmonics(2, views, coefficients)
    assert got.shape == (2, 50, 3)
    assert torch.equal(got[1], spherical_harmonics(2, -directions, coefficients))


def test_length_of_a_direction_does_not_matter_even_at_the_ends_of_float32(device):
    directions, coefficients = (t.to(device) for t in directions_and_coefficients(3, dtype=torch.float32))
    unit = torch.nn.functional.normalize(directions, dim=-1)
    for length in (1e-30, 1e15):
        torch.testing.assert_close(
            spherical_harmonics(3, unit * length, coefficients), spherical_harmonics(3, unit, coefficients),
            rtol=0, atol=1e-5,
        )  # fmt: skip


def test_no_directions_give_no_colours():
    assert spherical_harmonics(1, torch.zeros(0, 3), torch.zeros(0, 4, 3)).shape == (0, 3)


def test_torch_finds_no_fault_with_the_registration():
    directions, coefficients = (t.requires_grad_() for t in directions_and_coefficients(3, n=5))
    torch.library.opcheck(torch.ops.oasis_warp.spherical_harmonics, (directions, coefficients, 3, True))


def test_a_second_derivative_is_refused():
    directions, coefficients = (t.requires_grad_() for t in directions_and_coefficients(1, n=3))
    (g,) = torch.autograd.grad(
        spherical_harmonics(1, directions, coefficients).square().sum(), directions, create_graph=True
    )
    with pytest.raises(RuntimeError, match="spherical_harmonics: expected one derivative"):
        g.sum().backward()


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("degree", "shape", "words"),
    [(4, (5, 25, 3), "from 0 to 3"), (-1, (5, 4, 3), "from 0 to 3"), (2, (5, 4, 3), "takes 9"),
     (1, (5, 4, 2), r"\[..., K, 3\]"), (1, (4, 4, 3), "broadcast")],
)  # fmt: skip
def test_a_wrong_degree_or_shape_is_refused(degree, shape, words):
    with pytest.raises(ValueError, match=words):
        spherical_harmonics(degree, torch.ones(5, 3), torch.ones(shape))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused_by_name(bad, device):
    coefficients = torch.ones(5, 4, 3, device=device)
    coefficients[2, 1, 0] = bad
    with pytest.raises(ValueError, match="coefficients: expected finite"):
        spherical_harmonics(1, torch.ones(5, 3, device=device), coefficients)
