"""Feature-on-Mesh and the Gaussian heads: equations 7 and 8."""

import math

import pytest
import torch

from oasis_warp.avatar.anchors import OPACITY
from oasis_warp.core import rotation
from oasis_warp.network.heads import (
    FACE_LIMITS,
    FACE_OUTPUTS,
    MAX_OFFSET,
    VERTEX_LIMITS,
    VERTEX_OUTPUTS,
    FeatureOnMesh,
    GaussianHead,
    decode,
    decode_offsets,
)

FACES = torch.tensor([[0, 1, 2], [2, 1, 3]])


@pytest.fixture
def anchors(random):
    quats = torch.randn(1, 5, 4, generator=random)
    return {
        "quats": quats / quats.norm(dim=-1, keepdim=True),
        "scales": 0.001 + 0.001 * torch.rand(1, 5, 3, generator=random),
        "fade": torch.tensor([[1.0, 1.0, 0.5, 0.01, 0.0]]),
        "colors": torch.rand(1, 5, 3, generator=random) * 0.8 + 0.1,
        "seen": None,
        "limits": VERTEX_LIMITS,
    }


def raw_outputs(scale, random):
    return {name: scale * torch.randn(1, 5, size, generator=random) for name, size in VERTEX_OUTPUTS.items()}


@pytest.mark.parametrize("outputs", [VERTEX_OUTPUTS, FACE_OUTPUTS], ids=["vertices", "faces"])
def test_an_untrained_head_says_nothing_and_can_learn(outputs, random):
    head, features = GaussianHead(16, 8, outputs), torch.randn(2, 5, 16, generator=random)
    raw = head(features)
    assert {name: tensor.shape[-1] for name, tensor in raw.items()} == outputs
    assert not any(tensor.any() for tensor in raw.values())
    sum(tensor.sum() for tensor in raw.values()).backward()
    assert head.last.weight.grad is not None and head.last.weight.grad.any()


def test_outputs_stay_in_float32_under_autocast(random):
    head = GaussianHead(16, 8, VERTEX_OUTPUTS)
    with torch.autocast("cpu", torch.bfloat16):
        assert head(torch.randn(1, 3, 16, generator=random))["colors"].dtype == torch.float32


@pytest.mark.parametrize("limits", [VERTEX_LIMITS, FACE_LIMITS], ids=["vertices", "faces"])
def test_no_output_leaves_the_anchors_as_they_are(limits, anchors, random):
    same = decode(raw_outputs(0.0, random), **{**anchors, "limits": limits})
    torch.testing.assert_close(same.quats, anchors["quats"])
    torch.testing.assert_close(same.scales, anchors["scales"])
    torch.testing.assert_close(same.opacities, OPACITY * anchors["fade"])
    torch.testing.assert_close(same.colors, anchors["colors"])


@pytest.mark.parametrize("limits", [VERTEX_LIMITS, FACE_LIMITS], ids=["vertices", "faces"])
def test_any_output_gives_gaussians_that_can_be_drawn(limits, anchors, random):
    raw = raw_outputs(50.0, random)
    out = decode(raw, **{**anchors, "limits": limits})
    ratio = out.scales / anchors["scales"]
    assert bool((ratio > 0.999 / torch.tensor(limits.shrink)).all()) and float(ratio.max()) < 1.001 * limits.growth
    torch.testing.assert_close(out.quats.norm(dim=-1), torch.ones(1, 5))
    assert bool((out.opacities <= anchors["fade"]).all())
    assert bool((out.opacities >= limits.opacity * anchors["fade"]).all())
    assert float(out.colors.min()) >= 0 and float(out.colors.max()) <= 1
    assert float(decode_offsets(raw).abs().max()) <= MAX_OFFSET + 1e-9


def test_what_was_seen_comes_in_by_the_share_that_is_trusted(anchors, random):
    photo = torch.rand(1, 5, 3, generator=random) * 0.8 + 0.1
    seen = torch.logit(photo) - torch.logit(anchors["colors"])
    raw = {**raw_outputs(0.0, random), "trust": torch.tensor([[[0.0], [1], [0], [1], [0.5]]])}
    colors = decode(raw, **{**anchors, "seen": seen}).colors
    torch.testing.assert_close(colors[:, 0::2][:, :2], anchors["colors"][:, 0::2][:, :2])
    torch.testing.assert_close(colors[:, 1::2], photo[:, 1::2])
    assert bool(((colors[0, 4] - photo[0, 4]) * (colors[0, 4] - anchors["colors"][0, 4]) < 0).all())


def test_a_turn_is_in_the_frame_of_the_anchor(anchors, random):
    raw = raw_outputs(0.0, random)
    raw["quats"][..., 3] = 1.0  # (1, 0, 0, 1): a quarter turn about the anchor's own z axis
    out = rotation.to_matrix(decode(raw, **anchors).quats)
    before = rotation.to_matrix(anchors["quats"])
    torch.testing.assert_close(out[..., :, 2], before[..., :, 2], atol=1e-6, rtol=0)
    torch.testing.assert_close(out[..., :, 0], before[..., :, 1], atol=1e-6, rtol=0)


def test_a_face_starts_at_its_centroid_and_mixes_within_its_corners(random):
    mesh, features = FeatureOnMesh(2), torch.randn(1, 4, 6, generator=random)
    torch.testing.assert_close(mesh(features, FACES), features[:, FACES].mean(2))
    with torch.no_grad():
        mesh.logits[0] = torch.tensor([math.log(2.0), 0.0, math.log(5.0)])
    expected = (2 * features[:, 0] + features[:, 1] + 5 * features[:, 2]) / 8
    torch.testing.assert_close(mesh(features, FACES)[:, 0], expected)
    constant = torch.full((1, 4, 6), 0.7)
    torch.testing.assert_close(mesh(constant, FACES), torch.full((1, 2, 6), 0.7))


def test_barycentrics_and_features_learn(random):
    mesh, features = FeatureOnMesh(2), torch.randn(1, 4, 6, generator=random, requires_grad=True)
    loss = mesh(features, FACES).square().sum()
    for gradient in torch.autograd.grad(loss, (mesh.logits, features)):
        assert gradient.any(dim=-1).all()
