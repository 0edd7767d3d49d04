import pytest
import torch

from oasis_warp.ops.checks import (
    check_choice,
    check_finite,
    check_float,
    check_index,
    check_positive,
    check_shape,
)

pytestmark = pytest.mark.usefixtures("as_shipped")


def test_one_letter_means_one_size_over_several_arguments():
    sizes = {}
    check_shape("quats", torch.zeros(3, 4), "N", 4, sizes=sizes)
    with pytest.raises(ValueError, match=r"scales: expected shape \[3, 3\], got \[2, 3\]"):
        check_shape("scales", torch.zeros(2, 3), "N", 3, sizes=sizes)


def test_another_number_of_axes_is_refused_with_the_hint():
    with pytest.raises(ValueError, match=r"quats: expected shape \[N, 4\], got \[4\]\. Quaternions are wxyz\."):
        check_shape("quats", torch.zeros(4), "N", 4, hint="Quaternions are wxyz.")


def test_something_that_is_no_tensor_is_refused():
    with pytest.raises(TypeError, match="means: expected a torch.Tensor, got list"):
        check_shape("means", [[0, 0, 0]], "N", 3)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e20])
def test_values_that_are_not_finite_are_counted_and_named(bad):
    tensor = torch.zeros(5)
    tensor[3] = bad
    with pytest.raises(ValueError, match="opacities: expected finite values .* 1 of 5 that are not"):
        check_finite(means=torch.zeros(2, 3), opacities=tensor)


def test_none_and_empty_tensors_are_finite():
    check_finite(means=torch.zeros(0, 3), backgrounds=None)


def test_half_precision_is_refused():
    with pytest.raises(ValueError, match="means: expected float32 or float64, got float16"):
        check_float("means", torch.zeros(1, dtype=torch.float16))


def test_two_dtypes_in_one_call_are_refused():
    with pytest.raises(ValueError, match="scales: expected torch.float32"):
        check_float("scales", torch.zeros(1, dtype=torch.float64), like=torch.zeros(1))


@pytest.mark.parametrize("bad", [-1, 7])
def test_an_index_out_of_range_is_refused(bad):
    with pytest.raises(ValueError, match=r"faces: expected indices in 0 \.\. 6 \(7 vertices\)"):
        check_index("faces", torch.tensor([[0, bad, 1]]), 7, "vertices")


def test_an_unknown_choice_is_refused_with_the_list():
    with pytest.raises(ValueError, match="render_mode: expected one of 'RGB', 'D', got 'XYZ'"):
        check_choice("render_mode", "XYZ", ["RGB", "D"])


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_a_number_that_is_not_positive_is_refused(bad):
    with pytest.raises(ValueError, match="tau: expected a positive finite number"):
        check_positive("tau", bad)
