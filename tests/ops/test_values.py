"""The look at values that is part of a call."""

import pytest
import torch

from oasis_kernels.runtime import finite
from oasis_warp.ops._runtime.values import DeferredFiniteCheck, check_finite
from oasis_warp.ops.rasterization import rasterization

POISON = float("nan"), float("inf"), -float("inf"), 1.1e15, -1e30


def arrays(device):
    """More than fit into one launch, of sizes around those of a block, of both types."""
    sizes = [0, 1, 255, 257, finite.CHUNK - 1, finite.CHUNK, finite.CHUNK + 1, 3, 2, 5, 9000, 7]
    g = torch.Generator().manual_seed(0)
    made = {f"array{k}": torch.randn(size, generator=g).to(device) for k, size in enumerate(sizes)}
    assert len(made) > finite.ARRAYS
    return made


def test_every_number_of_every_array_is_looked_at(dtype, device):
    given = {name: tensor.to(dtype) for name, tensor in arrays(device).items()}
    check_finite(nothing=None, **given)
    for k, (name, tensor) in enumerate(given.items()):
        for place in {0, len(tensor) // 2, len(tensor) - 1} if len(tensor) else ():
            kept = tensor[place].item()
            tensor[place] = POISON[(k + place) % len(POISON)]
            with pytest.raises(ValueError, match=f"^{name}: expected finite values .*, got 1 of {len(tensor)} that"):
                check_finite(nothing=None, **given)
            tensor[place] = kept
    check_finite(**given)


def test_the_largest_numbers_allowed_are_allowed(device):
    check_finite(a=torch.tensor([1e15, -1e15], device=device), b=torch.tensor([1e15], device=device).double())


def test_memory_of_any_layout_is_read_as_what_it_stands_for(device):
    wide = torch.full((40, 6), torch.nan, device=device)
    wide[:, ::2] = 1
    check_finite(every_second=wide[:, ::2], transposed=wide[:, ::2].T, repeated=wide[:1, 2].expand(50))
    with pytest.raises(ValueError, match="^transposed: .* got 120 of 240"):
        check_finite(every_second=wide[:, ::2], transposed=wide.T)


@pytest.mark.gpu
def test_a_look_says_at_its_end_what_it_saw_and_leaves_other_errors_alone():
    good, bad = torch.ones(5, device="cuda"), torch.full((5,), torch.nan, device="cuda")
    with DeferredFiniteCheck(good=good, nothing=None):
        pass
    reached = False
    with pytest.raises(ValueError, match="^bad: expected finite values"), DeferredFiniteCheck(good=good, bad=bad):
        reached = True
    assert reached
    with pytest.raises(KeyError), DeferredFiniteCheck(bad=bad):
        raise KeyError
    with DeferredFiniteCheck(good=good), DeferredFiniteCheck(good=good):
        check_finite(good=good)


@pytest.mark.gpu
def test_values_are_not_looked_at_while_a_graph_is_captured():
    values = torch.ones(5, device="cuda")
    check_finite(values=values)  # loads the kernel
    torch.cuda.synchronize()
    with torch.cuda.graph(torch.cuda.CUDAGraph()):
        with pytest.raises(ValueError, match=r"^validate: expected False while a CUDA graph is being captured, got T"):
            check_finite(values=values)
        values.add_(1)  # a graph of nothing would be warned of


def test_a_bad_color_is_refused_before_it_is_drawn(device, as_shipped):
    colors = torch.rand(2, 3, device=device)
    means = torch.tensor([[0.0, 0, 2], [0.1, 0, 2]], device=device)
    K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]], device=device)
    quats, ones = torch.tensor([[1.0, 0, 0, 0]], device=device).expand(2, 4), torch.ones(2, device=device)
    arguments = means, quats, means * 0 + 0.1, ones, colors, torch.eye(4, device=device)[None], K[None], 16, 16
    image = rasterization(*arguments)[0]
    assert torch.equal(rasterization(*arguments, validate=False)[0], image)
    colors[1, 2] = torch.nan
    for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        with pytest.raises(ValueError, match=r"^colors: expected finite values below 1e\+15, got 1 of "):
            rasterization(*arguments, render_mode=mode)
