"""VPIA: equations 5 and 6."""

import pytest
import torch

from oasis_warp.network.attention import JointAttention, VisibilityAttention

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
