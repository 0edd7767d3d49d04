"""Biased attention without a mask, and adaptive norms."""

import pytest
import torch

from oasis_warp.network.attention import NEVER, AdaptiveNorm, Block, attend


def draw(random, *shape, dtype=torch.float32):
    return torch.randn(*shape, generator=random, dtype=dtype)


def literal(q, k, v, row, column):
    bias = (row[:, :, None] * column[:, None])[:, None]
    return (q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5 + bias).softmax(-1)


def test_a_bias_in_spare_dimensions_is_a_bias_on_the_logits(random):
    q, k, v = draw(random, 2, 3, 7, 16), draw(random, 2, 3, 11, 16), draw(random, 2, 3, 11, 16)
    row, column = 3 * draw(random, 2, 7), draw(random, 2, 11).sign()
    carried = draw(random, 2, 11, 2)
    out, mean = attend(q, k, v, row, column, carried)
    weights = literal(q, k, v, row, column)
    torch.testing.assert_close(out, weights @ v, atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(mean, weights.mean(1) @ carried, atol=2e-6, rtol=1e-5)


def test_gradients_are_those_of_the_biased_softmax(random):
    def leaves():
        g = torch.Generator().manual_seed(3)
        tensors = [draw(g, 1, 2, 5, 8), draw(g, 1, 2, 6, 8), draw(g, 1, 2, 6, 8), draw(g, 1, 5)]
        return [t.requires_grad_(True) for t in tensors]

    column, carried, sign = draw(random, 1, 6).sign(), draw(random, 1, 6, 2), draw(random, 1, 2, 5, 8)
    ours, theirs = leaves(), leaves()
    out, mean = attend(*ours, column, carried)
    ((out * sign).sum() + mean.sum()).backward()
    weights = literal(*theirs, column)
    ((weights @ theirs[2] * sign).sum() + (weights.mean(1) @ carried).sum()).backward()
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a.grad, b.grad, atol=1e-5, rtol=1e-4)


def test_a_forbidden_key_is_never_read(random):
    q, k, v = 30 * draw(random, 1, 1, 4, 8), draw(random, 1, 1, 6, 8), draw(random, 1, 1, 6, 8)
    column = torch.zeros(1, 6)
    column[0, 2] = NEVER
    out, _ = attend(q, k, v, torch.ones(1, 4), column)
    v[..., 2, :] = 1e6
    again, _ = attend(q, k, v, torch.ones(1, 4), column)
    assert torch.equal(out, again)


def test_half_precision_does_not_round_the_bias(random):
    # exp(-2 b) for b = 8.03, which bfloat16 rounds to 8: that alone would be an error of 6 %
    b = torch.tensor([[8.03]])
    zero, values = torch.zeros(1, 1, 1, 16), torch.tensor([[1.0], [0.0]]).expand(1, 1, 2, 16)
    with torch.autocast("cpu", torch.bfloat16):
        out, _ = attend(zero, zero.expand(-1, -1, 2, -1), values, b, torch.tensor([[-1.0, 1.0]]))
    assert float(out[0, 0, 0, 0].float() / (-2 * b).exp() - 1) == pytest.approx(0, abs=0.01)


def test_an_adaptive_norm_starts_plain_and_open_and_follows_its_context(random):
    norm = AdaptiveNorm(16)
    x, context = draw(random, 2, 5, 16), draw(random, 2, 16)
    out, gate = norm(x, context)
    torch.testing.assert_close(out, torch.nn.functional.layer_norm(x, (16,)))
    assert bool((gate == 1).all())
    torch.nn.init.normal_(norm.modulation.weight)
    out, gate = norm(x, context)
    other, other_gate = norm(x, -context)
    assert not torch.allclose(out, other)
    assert not torch.allclose(gate, other_gate)
    out.sum().backward()
    assert norm.modulation.weight.grad is not None and norm.modulation.weight.grad.any()


def test_a_block_treats_tokens_alike_wherever_they_stand(random):
    block, x, order = Block(16, 2), draw(random, 2, 9, 16), torch.randperm(9, generator=random)
    torch.testing.assert_close(block(x)[:, order], block(x[:, order]), atol=1e-5, rtol=1e-4)
