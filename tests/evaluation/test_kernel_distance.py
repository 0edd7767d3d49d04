"""The kernel distance: unbiased, zero between halves of one crowd, and larger the farther crowds are apart."""

import numpy as np
import pytest
import torch

from oasis_warp.evaluation.kernel_distance import (
    LAYERS,
    Sample,
    hand_features,
    kernel_distance,
    kernel_distances,
)


def crowd(n, shift=0.0, groups=40, within=0.1, seed=0):
    """Pictures of `groups` hands: hands differ by 1, pictures of one by `within`."""
    random = np.random.default_rng(seed)
    hands = random.normal(size=(groups, 8)) + shift
    index = np.arange(n) % groups
    return hands[index] + within * random.normal(size=(n, 8)), [f"{seed} {k}" for k in index]


def test_the_distance_of_two_halves_is_zero_within_its_error_and_its_error_is_that_of_repetitions():
    found = []
    for seed in range(30):
        (x, a), (y, b) = crowd(80, seed=2 * seed), crowd(80, seed=2 * seed + 1)
        found.append(kernel_distance(x, y, a, b))
    values = np.array([each.value for each in found])
    assert abs(values.mean()) < 3 * values.std() / np.sqrt(len(values))
    # Pictures of one hand counted as if independent would give a mean far above 0.
    assert 0.5 < np.median([each.error for each in found]) / values.std() < 2


def test_the_distance_grows_with_the_shift():
    x, a = crowd(80, seed=0)
    near, far = (kernel_distance(x, *(made := crowd(80, shift, seed=1))[:1], a, made[1]).value for shift in (0.5, 1.0))
    assert 0 < near < far


def test_the_distance_is_the_formula_of_the_paper():
    random = np.random.default_rng(0)
    x, y = random.normal(size=(5, 3)), random.normal(size=(6, 3)) + 1
    kernel = lambda a, b: (a @ b / 3 + 1) ** 3  # noqa: E731
    xx = np.mean([kernel(x[i], x[j]) for i in range(5) for j in range(5) if i != j])
    yy = np.mean([kernel(y[i], y[j]) for i in range(6) for j in range(6) if i != j])
    xy = np.mean([kernel(a, b) for a in x for b in y])
    found = kernel_distance(x, y, [f"x{i}" for i in range(5)], [f"y{i}" for i in range(6)])
    assert found.value == pytest.approx(xx + yy - 2 * xy)


def samples(shift, names):
    random = np.random.default_rng(len(names))
    values = [{layer: (random.normal(size=4) * 100 + shift).tolist() for layer in LAYERS} for _ in names]
    return [Sample(name, "palm", features) for name, features in zip(names, values, strict=True)]


def test_layers_are_scaled_and_too_few_hands_are_refused():
    real, drawn = samples(0, [f"r{k}" for k in range(20)]), samples(150, [f"d{k}" for k in range(10)])
    found = kernel_distances(drawn, real, real)
    assert set(found) == {*LAYERS, "all"} and all(0.1 < each.value < 1000 for each in found.values())
    assert found == kernel_distances(drawn, real, real)
    with pytest.raises(ValueError, match="drawn: expected pictures of 4 hands or more, got 2"):
        kernel_distances(drawn[:2], real, real)


def test_features_read_the_hand_and_not_what_lies_beside_it():
    generator = torch.Generator().manual_seed(0)
    image, mask = torch.rand(64, 64, 3, generator=generator), torch.zeros(64, 64)
    mask[16:48, 16:48] = 1
    found = hand_features(image, mask)
    assert [len(found[layer]) for layer in LAYERS] == [48, 80, 160, 256]
    brighter = hand_features((image + 0.2 * mask[..., None]).clamp(0, 1), mask)
    assert not np.allclose(found["half"], brighter["half"], atol=0.01)
    assert found == hand_features(image, mask)
