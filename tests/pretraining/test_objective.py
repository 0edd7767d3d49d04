"""The training objective, and the pictures it compares."""

from dataclasses import replace

import pytest
import torch
from painted_hands import PaintedHands

from oasis_warp.avatar.observation import source_photos
from oasis_warp.core.types import Camera
from oasis_warp.losses.image import masked_dssim, masked_l1
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork, Prediction
from oasis_warp.pretraining.objective import (
    LossConfig,
    RenderBatch,
    draw_targets,
    objective,
    picture_psnr,
    position_loss,
    scaling_loss,
    true_pictures,
)
from oasis_warp.render.render import render


def prediction(**changed):
    still = Prediction(
        offsets=torch.zeros(1, 4, 3), barycentrics=torch.full((1, 2, 3), 1 / 3), quats=torch.rand(1, 6, 4),
        scales=torch.full((1, 6, 3), 1e-3), opacities=torch.ones(1, 6), colors=torch.rand(1, 6, 3),
        anchor_scales=torch.full((1, 6, 3), 1e-3),
    )  # fmt: skip
    return still._replace(**changed)


@pytest.fixture
def network_of(hand):
    """Draw the targets of a batch by an untrained network."""
    config = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)

    def draw(batch):
        network = HandNetwork(config, hand)
        with torch.no_grad():
            return draw_targets(network(source_photos(batch)), batch, network)

    return draw


@pytest.fixture
def pair():
    random = torch.Generator().manual_seed(0)
    true = RenderBatch(torch.rand(3, 24, 24, 3, generator=random), torch.zeros(3, 24, 24))
    true.alphas[:, 4:20, 4:20] = 1
    true = true._replace(images=true.images * true.alphas[..., None])
    noise = 0.1 * torch.randn(3, 24, 24, 3, generator=random)
    return RenderBatch(true.images + noise, (true.alphas + 0.1).clamp(0, 1)), true


def test_the_truth_costs_nothing(pair):
    _, true = pair
    loss, terms = objective(prediction(), true, true, LossConfig())
    assert float(loss) == pytest.approx(0, abs=1e-6)
    assert set(terms) == {"rgb", "mask", "ssim", "perceptual", "position", "scaling"}


def test_terms_are_means_over_pictures_and_add_up_with_the_papers_weights(pair):
    drawn, true = pair
    loss, terms = objective(prediction(), drawn, true, LossConfig())
    rgb = [masked_l1(a, b, m) for a, b, m in zip(drawn.images, true.images, true.alphas, strict=True)]
    ssim = [masked_dssim(a, b, m) for a, b, m in zip(drawn.images, true.images, true.alphas, strict=True)]
    torch.testing.assert_close(terms["rgb"], torch.stack(rgb).mean())
    torch.testing.assert_close(terms["ssim"], torch.stack(ssim).mean())
    outside = 24 * 24 - 16 * 16
    assert float(terms["mask"]) == pytest.approx(0.1 * outside / 256, rel=1e-5)
    weights = {"rgb": 10, "mask": 1, "ssim": 1, "perceptual": 5, "position": 1, "scaling": 0.5}
    torch.testing.assert_close(loss, sum(weights[name] * term for name, term in terms.items()))


def test_another_perceptual_term_takes_the_place_of_ours(pair):
    drawn, true = pair
    _, terms = objective(prediction(), drawn, true, LossConfig(), lambda a, b, m: 7 + 0 * a.mean((1, 2, 3)))
    assert float(terms["perceptual"]) == 7


def test_offsets_cost_beyond_the_limit_and_have_a_gradient_at_zero():
    offsets = torch.tensor([[0.0, 0, 0], [0.003, 0, 0], [0, 0.012, 0], [0, 0, -0.009]], requires_grad=True)
    loss = position_loss(offsets, 0.006)
    assert loss.item() == pytest.approx((1 + 0.5) / 4, rel=1e-5)
    loss.backward()
    assert offsets.grad is not None and bool(offsets.grad.isfinite().all())
    assert offsets.grad[:2].abs().sum() == 0


def test_needles_cost_what_they_exceed_the_limit_by():
    scales = torch.tensor([[1.0, 1, 1], [5, 1, 1], [1, 8, 1], [1, 1, 0.1]]) * 1e-3
    assert float(scaling_loss(scales, torch.ones(4, 3), 5.0)) == pytest.approx((3 + 5) / 4, rel=1e-5)


def test_an_anchor_may_stay_as_long_as_it_is():
    anchors = torch.tensor([[1.0, 1, 0.1], [2, 1, 1]]) * 1e-3
    assert not scaling_loss(anchors, anchors, 5.0).any()
    longer = anchors * torch.tensor([1.2, 1, 1])
    assert float(scaling_loss(longer, anchors, 5.0)) == pytest.approx(2 / 2, rel=1e-5)


def test_psnr_is_that_inside_the_masks(pair):
    drawn, true = pair
    error = ((drawn.images - true.images)[:, 4:20, 4:20] ** 2).mean((1, 2, 3))
    torch.testing.assert_close(picture_psnr(drawn, true), (-10 * error.log10()).mean())


def test_targets_fade_at_the_wrist_as_gaussians_do_and_nowhere_else(hand):
    batch = PaintedHands(hand, hands=1, targets=2, size=64).batch(0)
    full = batch._replace(
        target_images=torch.ones_like(batch.target_images), target_masks=torch.ones_like(batch.target_masks)
    )
    true = true_pictures(full, hand.faces, hand.rim)
    assert torch.equal(true.images[..., 0], true.alphas)
    assert float(true.alphas.amin()) < 0.2
    rim = batch.target_posed[0, :, hand.rim].mean(1)
    for target in range(2):
        viewmat, K = batch.target_viewmats[0, target], batch.target_Ks[0, target]
        local = viewmat[:3, :3] @ rim[target] + viewmat[:3, 3]
        place = (K @ (local / local[2]))[:2]
        faded = torch.nonzero(true.alphas[target] < 0.99).float().flip(1) + 0.5
        assert float((faded - place).norm(dim=1).max()) < 25  # pixels of a picture 64 wide
        assert float(true.alphas[target].mean()) > 0.9


def test_what_was_drawn_by_the_truth_costs_nearly_nothing(hand):
    """Faded Gaussians drawn over black are the faded target: no term asks for more than can be drawn."""
    from oasis_warp.avatar.anchors import place_anchors
    from oasis_warp.avatar.pose import pose_gaussians
    from oasis_warp.hand.skinning import rest_hand

    batch = PaintedHands(hand, hands=1, targets=1, size=64).batch(0)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))._replace(vertices=batch.rest[0])
    anchors = place_anchors(hand, rest)
    grey = anchors.with_colors(torch.full((len(anchors.opacities), 3), 0.5))
    posed = pose_gaussians(grey, hand.faces, batch.rest[0], batch.target_posed[0, 0])
    camera = Camera(batch.target_viewmats[0, 0], batch.target_Ks[0, 0], 64, 64)
    drawn = render(posed, camera)
    solid = batch._replace(
        target_images=torch.full_like(batch.target_images, 0.5) * (drawn.alpha > 0.02)[None, None, ..., None],
        target_masks=(drawn.alpha > 0.02).float()[None, None],
    )
    true = true_pictures(solid, hand.faces, hand.rim)
    inner = -torch.nn.functional.max_pool2d(-(drawn.alpha > 0.02).float()[None], 3, 1, 1)[0] > 0
    assert float((true.images[0] - drawn.image).abs().mean(-1)[inner].mean()) < 0.03


def test_what_a_sleeve_hides_is_neither_asked_for_nor_forbidden(hand, network_of):
    batch = PaintedHands(hand, hands=1, targets=1, size=32).batch(0)
    known = torch.ones_like(batch.target_known)
    known[..., :16] = 0
    half = batch._replace(target_known=known)
    true = true_pictures(half, hand.faces, hand.rim)
    assert not true.images[:, :, :16].any() and not true.alphas[:, :, :16].any()
    drawn = network_of(half)
    assert not drawn.images[:, :, :16].any() and not drawn.alphas[:, :, :16].any()
    assert drawn.alphas[:, :, 16:].any()
