"""Learnable tokenization: equation 3."""

import pytest
import torch

from oasis_warp.network.tokens import PlaceEncoding, Tokenizer, encode, grid_places


@pytest.fixture(params=[False, True], ids=["learned", "literal"])
def tokenizer(request):
    torch.manual_seed(0)
    return Tokenizer(16, 2, 7, literal=request.param)


@pytest.fixture
def points(random):
    features = torch.randn(2, 30, 16, generator=random)
    offsets = torch.randn(2, 30, 16, generator=random)
    return features, offsets, torch.rand(2, 30, 2, generator=random), torch.rand(2, 30, generator=random) < 0.7


def test_the_order_of_points_does_not_matter(tokenizer, points, random):
    order = torch.randperm(30, generator=random)
    plain, shuffled = tokenizer(*points), tokenizer(*(part[:, order] for part in points))
    torch.testing.assert_close(plain.tokens, shuffled.tokens, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(plain.centers, shuffled.centers, atol=1e-6, rtol=1e-5)


def test_points_outside_the_frame_are_not_read(tokenizer, points):
    features, offsets, uv, inside = points
    plain = tokenizer(*points)
    out = ~inside[..., None]
    moved = tokenizer(features + 100 * out, offsets - 100 * out, uv + 5 * out, inside)
    assert torch.equal(plain.tokens, moved.tokens)
    assert torch.equal(plain.centers, moved.centers)


def test_tokens_lie_among_the_points_they_read(tokenizer, points):
    centers = tokenizer(*points).centers.detach()
    assert centers.shape == (2, 7, 2)
    assert 0 < float(centers.min()) and float(centers.max()) < 1


def test_the_literal_form_is_the_printed_one(points):
    torch.manual_seed(0)
    tokenizer = Tokenizer(16, 2, 7, literal=True)
    for last in (tokenizer.attention.output, tokenizer.feed_forward[-1]):  # leave the cross-attention alone
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)
    features, _, uv, _ = points
    everywhere = torch.ones(2, 30, dtype=torch.bool)
    tokens, centers = tokenizer(features, None, uv, everywhere)
    weights = (tokenizer.queries @ features.transpose(1, 2) / 4).softmax(-1)
    torch.testing.assert_close(tokens, weights @ features, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(centers, weights @ uv, atol=1e-5, rtol=1e-4)


def test_every_weight_learns(tokenizer, points):
    tokens, centers = tokenizer(*points)
    (tokens.square().sum() + centers.square().sum()).backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in tokenizer.parameters())
    assert tokenizer.queries.grad.any(dim=-1).all()


def test_an_encoding_holds_sines_and_cosines_of_every_octave():
    x = torch.tensor([[0.25, -0.5]])
    expected = [torch.sin(torch.pi * 2**k * x[0, d]) for d in range(2) for k in range(3)]
    expected += [torch.cos(torch.pi * 2**k * x[0, d]) for d in range(2) for k in range(3)]
    torch.testing.assert_close(encode(x, 3)[0], torch.stack(expected), atol=1e-6, rtol=0)


def test_places_far_apart_are_encoded_differently_and_the_same_place_alike(random):
    place = PlaceEncoding(32)
    uv = torch.rand(1, 50, 2, generator=random)
    torch.testing.assert_close(place(uv), place(uv.clone()))
    assert float(torch.pdist(place(uv)[0].detach()).min()) > 0.01


def test_cells_of_a_map_lie_at_their_centres():
    places = grid_places(2, 4, like=torch.zeros(1))
    torch.testing.assert_close(places[0], torch.tensor([0.125, 0.25]))
    torch.testing.assert_close(places[-1], torch.tensor([0.875, 0.75]))
    torch.testing.assert_close(places[1] - places[0], torch.tensor([0.25, 0.0]))
