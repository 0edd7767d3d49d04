import torch

from oasis_warp.estimation.shared_shape import shared_shape


def shapes(count, noise, seed=0):
    """A true shape of 40 coefficients, and what `count` photos say of it."""
    random = torch.Generator().manual_seed(seed)
    true = torch.randn(40, generator=random)
    return true, [true + noise * torch.randn(40, generator=random) for _ in range(count)]


def test_shapes_that_agree_are_kept():
    true, _ = shapes(0, 0.0)
    for count in (1, 2, 5):
        assert torch.allclose(shared_shape([true] * count), true, atol=1e-6)


def test_the_shared_shape_is_nearer_to_the_truth_than_one_photo_and_than_their_mean():
    alone, mean, shared = [], [], []
    for seed in range(20):
        true, said = shapes(3, 1.5, seed)
        alone.append((said[0] - true).norm())
        mean.append((torch.stack(said).mean(0) - true).norm())
        shared.append((shared_shape(said) - true).norm())
    assert sum(shared) < 0.95 * sum(mean) < 0.8 * sum(alone)


def test_shapes_that_contradict_each_other_leave_the_mean_hand():
    true, _ = shapes(0, 0.0)
    assert torch.equal(shared_shape([true, -0.9 * true]), torch.zeros(40))
