import pytest
import torch

from oasis_warp.network.attention import NEVER, AdaptiveNorm, Block, JointAttention, VisibilityAttention, attend


def draw(random, *shape, dtype=torch.float32):
    return torch.randn(*shape, generator=random, dtype=dtype)


def literal(q, k, v, row, column):
    bias = (row[:, :, None] * column[:, None])[:, None]
    return (q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5 + bias).softmax(-1)


def test_a_bias_in_spare_dimensions_is_a_bias_on_the_logits(random):
    q, k, v = draw(random, 2, 3, 7, 16), draw(random, 2, 3, 11, 16), draw(random, 2, 3, 11, 16)
    row, column = 3 * draw(random, 2, 7), draw(random, 2, 11).sign()
    extra = draw(random, 2, 11, 2)
    out, mean = attend(q, k, v, row, column, extra)
    weights = literal(q, k, v, row, column)
    torch.testing.assert_close(out, weights @ v, atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(mean, weights.mean(1) @ extra, atol=2e-6, rtol=1e-5)


def test_gradients_are_those_of_the_biased_softmax(random):
    def leaves():
        g = torch.Generator().manual_seed(3)
        tensors = [draw(g, 1, 2, 5, 8), draw(g, 1, 2, 6, 8), draw(g, 1, 2, 6, 8), draw(g, 1, 5)]
        return [t.requires_grad_(True) for t in tensors]

    column, extra, sign = draw(random, 1, 6).sign(), draw(random, 1, 6, 2), draw(random, 1, 2, 5, 8)
    ours, theirs = leaves(), leaves()
    out, mean = attend(*ours, column, extra)
    ((out * sign).sum() + mean.sum()).backward()
    weights = literal(*theirs, column)
    ((weights @ theirs[2] * sign).sum() + (weights.mean(1) @ extra).sum()).backward()
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


N_LOCAL = 12


@pytest.fixture
def tokens(random):
    def draw(*shape):
        return torch.randn(*shape, generator=random)

    return draw(2, 9, 16), draw(2, N_LOCAL, 16), draw(2, 16), torch.rand(2, 9, generator=random)


def attention(biased=True):
    torch.manual_seed(0)
    module = VisibilityAttention(16, 2, N_LOCAL, biased)
    for norm in (module.point_norm, module.token_norm):
        torch.nn.init.normal_(norm.modulation.weight, std=0.1)
    return module


def test_with_equal_affinities_the_global_token_gets_half_of_a_hidden_point_and_nothing_of_a_visible_one(tokens):
    module = attention()
    torch.nn.init.zeros_(module.query.weight)
    torch.nn.init.zeros_(module.query.bias)
    points, local, context, visibility = tokens
    hidden = module.global_share(points, local, context, torch.zeros_like(visibility))
    visible = module.global_share(points, local, context, torch.ones_like(visibility))
    torch.testing.assert_close(hidden, torch.full_like(hidden, (N_LOCAL + 1) / (2 * N_LOCAL + 1)))
    torch.testing.assert_close(visible, torch.full_like(visible, 1 / (1 + N_LOCAL * (N_LOCAL + 1))))


def test_the_less_visible_a_point_the_more_it_reads_the_global_token(tokens):
    module, (points, local, context, _) = attention(), tokens
    same = points[:, :1].expand(-1, 9, -1)
    share = module.global_share(same, local, context, torch.linspace(0, 1, 9).expand(2, -1))
    assert bool((share.diff(dim=1) < 0).all())


def test_without_its_bias_visibility_changes_nothing(tokens):
    module, (points, local, context, visibility) = attention(biased=False), tokens
    assert torch.equal(module(points, local, context, visibility), module(points, local, context, 1 - visibility))
    assert not any("beta" in name for name, _ in module.named_parameters())


def test_at_visibility_one_half_the_bias_is_nothing(tokens):
    biased, plain, (points, local, context, visibility) = attention(), attention(biased=False), tokens
    plain.load_state_dict(biased.state_dict(), strict=False)
    half = torch.full_like(visibility, 0.5)
    assert torch.equal(biased(points, local, context, half), plain(points, local, context, half))


def test_attention_is_the_softmax_of_equation_6(tokens):
    module, (points, local, context, visibility) = attention(), tokens
    q, k, v, gate = module._project(points, local, context)
    assert module.log_beta is not None
    s, beta = 2 * visibility - 1, module.log_beta.exp()
    bias = torch.cat([(beta / 2 * s)[..., None].expand(-1, -1, N_LOCAL), (-beta / 2 * s)[..., None]], dim=-1)
    weights = (q @ k.transpose(-1, -2) / 8**0.5 + bias[:, None]).softmax(-1)
    read = module.output((weights @ v).transpose(1, 2).flatten(2))
    torch.testing.assert_close(module(points, local, context, visibility), points + gate * read, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(module.global_share(points, local, context, visibility), weights[..., -1].mean(1))


def test_points_do_not_see_each_other_and_tokens_have_no_order(tokens, random):
    module, (points, local, context, visibility) = attention(), tokens
    out = module(points, local, context, visibility)
    order = torch.randperm(9, generator=random)
    torch.testing.assert_close(module(points[:, order], local, context, visibility[:, order]), out[:, order])
    shuffled = local[:, torch.randperm(N_LOCAL, generator=random)]
    torch.testing.assert_close(module(points, shuffled, context, visibility), out, atol=1e-5, rtol=1e-4)


def test_every_weight_learns_the_bias_too(tokens):
    module = attention()
    module(*tokens).square().sum().backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in module.parameters())


def test_in_joint_attention_points_see_tokens_and_each_other(tokens, random):
    torch.manual_seed(0)
    module, (points, local, context, _) = JointAttention(16, 2), tokens
    out = module(points, local, context)
    assert out.shape == points.shape
    moved = points.clone()
    moved[:, 0] *= torch.linspace(-1, 1, 16)  # a shift of all channels would be normalised away
    assert not torch.allclose(module(moved, local, context)[:, 1:], out[:, 1:])
    assert not torch.allclose(module(points, local.flip(-1), context), out)
    order = torch.randperm(9, generator=random)
    torch.testing.assert_close(module(points[:, order], local, context), out[:, order], atol=1e-5, rtol=1e-4)
    out.square().sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())
