"""Attention of points to tokens; anchors and mean colours of many hands at once equal those of one."""

import math

import pytest
import torch

from oasis_warp.avatar.anchors import OPACITY, batch_anchors, place_anchors
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.observation import observe, observe_batch
from oasis_warp.avatar.prior import (
    DARKEST,
    LIGHTEST,
    SIGMA_CAST,
    SIGMA_COLOR,
    SIGMA_EXPOSURE,
    TONES,
    MeanHands,
    MeanPrior,
)
from oasis_warp.core import rotation, surface
from oasis_warp.core.hand_model import finger_of
from oasis_warp.core.surface import faces_of_vertices
from oasis_warp.hand.skinning import rest_hand
from oasis_warp.network.attention import (
    MASKED_LOGIT,
    AdaptiveNorm,
    Block,
    CoarseLevel,
    JointAttention,
    Refinement,
    VisibilityAttention,
    attend,
    place_coarse_points,
    to_coarse,
    to_fine,
)


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
    column[0, 2] = MASKED_LOGIT
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


@pytest.fixture(scope="module")
def vertex_faces(hand):
    return faces_of_vertices(hand.faces, len(hand.template))


@pytest.fixture(scope="module")
def hands(hand):
    shapes = torch.randn(2, len(hand.shape_names), generator=torch.Generator().manual_seed(1))
    return [rest_hand(hand, 0.5 * shape) for shape in shapes]


@pytest.fixture(scope="module")
def anchors(hand, hands, vertex_faces):
    return batch_anchors(torch.stack([rest.vertices for rest in hands]), hand.faces, vertex_faces, hand.rim)


def covariances(quats, scales):
    half = rotation.to_matrix(quats) * scales[:, None, :]
    return half @ half.transpose(1, 2)


def test_each_vertex_has_its_faces_once(hand, vertex_faces):
    real = vertex_faces < len(hand.faces)
    assert int(real.sum()) == hand.faces.numel()
    owners = torch.arange(len(hand.template))[:, None].expand_as(vertex_faces)[real]
    assert bool((hand.faces[vertex_faces[real]] == owners[:, None]).any(1).all())


@pytest.mark.parametrize("which", [0, 1])
def test_vertices_are_discs_and_faces_uniform_plates(hand, hands, anchors, which):
    vertices, n = hands[which].vertices.double(), len(hand.template)
    spread = 0.75 * (surface.vertex_areas(vertices, hand.faces) / torch.pi).sqrt().clamp_min(1e-4)
    torch.testing.assert_close(anchors.scales[which][:n, 0], spread.float(), atol=1e-8, rtol=1e-4)
    corners = vertices[hand.faces]
    arms = corners - corners.mean(1, keepdim=True)
    variance, axes = torch.linalg.eigh(arms.transpose(1, 2) @ arms / 12)  # ascending: across, short, long
    long = (1.5 * variance[:, 2].sqrt()).clamp_min(1e-4)
    short = torch.maximum(1.5 * variance[:, 1].clamp_min(0).sqrt(), long / 3).clamp_min(1e-4)
    expected = (axes * torch.stack([0.5 * short, short, long], -1)[:, None]).float()
    expected = expected @ expected.transpose(1, 2)
    found = covariances(anchors.quats[which][n:], anchors.scales[which][n:])
    error = (found - expected).abs().amax((1, 2)) / expected.abs().amax((1, 2))
    assert float(error.quantile(0.999)) < 1e-3  # two equal axes have no direction


def test_anchors_of_one_hand_leave_out_those_too_faint_to_be_drawn(hand, hands, anchors):
    alone = place_anchors(hand, hands[0])
    kept = torch.cat([alone.vertex_index, len(hand.template) + alone.face_index])
    torch.testing.assert_close(alone.scales, anchors.scales[0][kept])
    torch.testing.assert_close(alone.opacities, OPACITY * anchors.fade[0][kept])
    out = torch.ones(len(anchors.fade[0]), dtype=torch.bool)
    out[kept] = False
    assert bool(out.any())
    assert float(OPACITY * anchors.fade[0][out].max()) < 1 / 255


def test_photos_of_a_batch_are_observed_as_alone(network, crops, batch, hand):
    observation = observe_batch(batch, network.faces, network.vertex_faces, network.vertex_index)
    for k, crop in enumerate(crops):
        seen = observe(hand, crop)
        torch.testing.assert_close(observation.colors[k], seen.colors, atol=1e-5, rtol=0)
        torch.testing.assert_close(observation.confidence[k], seen.confidence, atol=1e-4, rtol=0)


def expected_melanin(regions, seen):
    """The posterior mean of the tone, one tone after the other."""
    weight = seen.confidence[:, None]
    logs, costs = torch.linspace(math.log(LIGHTEST), math.log(DARKEST), TONES), []
    for melanin in logs.exp().tolist():
        model = region_colors(regions, melanin)
        gain = (weight * model * seen.colors).sum(0) / (weight * model * model).sum(0)
        residual = (weight * (gain * model - seen.colors) ** 2).sum() / (3 * weight.sum())
        log_gain = gain.log()
        cast = (log_gain[[0, 2]] - log_gain[1]) / SIGMA_CAST
        costs.append(residual / SIGMA_COLOR**2 + (log_gain.mean() / SIGMA_EXPOSURE) ** 2 + (cast**2).sum())
    return float((torch.softmax(-torch.stack(costs) / 2, dim=0) * logs).sum().exp())


def test_tones_are_posterior_means(hand, batch, crops, network):
    seen = observe_batch(batch, network.faces, network.vertex_faces, network.vertex_index)
    mean = MeanHands(hand)(seen.colors, seen.confidence)
    regions = label_regions(hand)
    for k, crop in enumerate(crops):
        melanin = expected_melanin(regions, observe(hand, crop))
        assert float(mean.log_melanin[k].exp()) == pytest.approx(melanin, rel=1e-3)
        torch.testing.assert_close(mean.colors[k], region_colors(regions, melanin), atol=2e-3, rtol=0)


def test_gains_say_how_much_brighter_the_photo_is(hand):
    colors = MeanPrior(hand).vertex_colors(0.05)
    gain = torch.tensor([1.1, 0.95, 0.9])
    mean = MeanHands(hand)((colors * gain)[None], torch.ones(1, len(colors)))
    torch.testing.assert_close(mean.colors[0] * mean.log_gain[0].exp(), colors * gain, atol=0.03, rtol=0)


def test_a_photo_that_shows_nothing_gets_the_middle_tone(hand):
    mean = MeanHands(hand)(torch.rand(1, len(hand.template), 3), torch.zeros(1, len(hand.template)))
    assert bool(mean.colors.isfinite().all())
    assert 0 < float(mean.colors.min()) and float(mean.colors.max()) < 1


@pytest.fixture(scope="module")
def coarse_points(hand):
    return place_coarse_points(hand, 1024)


def test_points_are_spread_evenly(hand, coarse_points):
    places = hand.template[coarse_points.index]
    assert len(coarse_points.index.unique()) == 1024
    to_nearest = torch.cdist(hand.template, places).amin(1)
    assert float(to_nearest.max()) < 0.006
    assert 0.001 < float(to_nearest.mean()) < 0.003


def test_a_constant_field_survives_both_ways(coarse_points, hand):
    fine = torch.full((2, len(hand.template), 3), 0.3)
    coarse = to_coarse(fine, coarse_points.pool)
    torch.testing.assert_close(coarse, torch.full((2, 1024, 3), 0.3))
    torch.testing.assert_close(to_fine(coarse, coarse_points.blend, coarse_points.weights), fine)


def test_a_smooth_field_comes_back_nearly_as_it_went(coarse_points, hand):
    field = hand.template[None] / 0.01
    back = to_fine(to_coarse(field, coarse_points.pool), coarse_points.blend, coarse_points.weights)
    assert float((back - field).norm(dim=-1).mean()) < 0.2  # 2 mm


def test_neither_the_other_side_nor_another_finger_is_read(hand, coarse_points):
    normals = surface.vertex_normals(hand.template, hand.faces)
    read = coarse_points.index[coarse_points.blend]
    facing = (normals[read] * normals[:, None]).sum(-1)
    assert float((facing > 0).float().mean()) > 0.995
    finger = finger_of(hand.segment)
    other = (finger[read] != finger[:, None]) & (finger[read] > 0) & (finger[:, None] > 0)
    # at the webs fingers meet; away from them none is blended with its neighbour
    tips = (hand.segment > 0) & ((hand.segment - 1) % 3 == 2)
    assert not bool(other[tips].any())
    assert float(other.float().mean()) < 0.01


def test_the_same_hand_gets_the_same_points(hand, coarse_points):
    assert all(torch.equal(a, b) for a, b in zip(coarse_points, place_coarse_points(hand, 1024), strict=True))


def test_more_points_than_vertices_are_refused(hand):
    with pytest.raises(ValueError, match="n_coarse: expected 16 to 12337, the vertices of the hand, got 12338"):
        place_coarse_points(hand, 12_338)


def test_refinement_passes_on_what_changed_at_coarse_points(hand, random):
    torch.manual_seed(0)
    level, refinement = CoarseLevel(hand, 64), Refinement(16, 2, 1)
    x = torch.randn(1, len(hand.template), 16, generator=random)
    out = refinement(x, level)
    coarse = level.down(x)
    torch.testing.assert_close(out - x, level.up(refinement.blocks(coarse) - coarse), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(refinement(coarse, None), refinement.blocks(coarse))
    assert not list(level.parameters()) and not level.state_dict()
