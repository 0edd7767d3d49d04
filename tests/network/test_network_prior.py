"""The network at the seam of priors."""

import pytest
import torch

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior, Prior
from oasis_warp.core import rotation
from oasis_warp.core.config import AdaptConfig
from oasis_warp.losses.image import masked_psnr
from oasis_warp.network.inputs import input_of_evidence
from oasis_warp.network.prior import NetworkPrior, all_gaussians, canonical_gaussians
from oasis_warp.render.render import render
from oasis_warp.training.adapt import adapt


def covariances(gaussians):
    half = rotation.to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    return half @ half.transpose(1, 2)


@pytest.fixture(scope="module")
def untrained(make_network, tiny):
    return NetworkPrior(make_network(tiny, awake=False))


@pytest.mark.parametrize("which", [0, 1])
def test_an_untrained_network_is_the_mean_prior(untrained, hand, evidences, which):
    assert isinstance(untrained, Prior)
    ours, mean = untrained(evidences[which]), MeanPrior(hand)(evidences[which])
    for field in ("vertex_index", "face_index"):
        assert torch.equal(getattr(ours, field), getattr(mean, field))
    torch.testing.assert_close(ours.barycentrics, mean.barycentrics)
    assert not ours.offsets.any()
    torch.testing.assert_close(ours.scales, mean.scales, atol=1e-8, rtol=1e-4)
    torch.testing.assert_close(ours.opacities, mean.opacities, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(ours.colors, mean.colors, atol=2e-3, rtol=0)
    error = (covariances(ours) - covariances(mean)).abs().amax((1, 2)) / covariances(mean).abs().amax((1, 2))
    assert float(error.max()) < 2e-5


def test_faint_gaussians_are_left_out_of_an_avatar_and_kept_for_training(untrained, hand, evidences):
    with torch.no_grad():
        prediction = untrained.network(input_of_evidence(evidences[0]))
    few = canonical_gaussians(prediction, 0)
    every_vertex, every_face = torch.arange(len(hand.template)), torch.arange(len(hand.faces))
    everything = all_gaussians(prediction, 0, every_vertex, every_face)
    assert len(few.opacities) < len(everything.opacities) == 36_945
    evidence = evidences[0]
    pictures = [
        render(pose_gaussians(g, hand.faces, evidence.rest.vertices, evidence.posed.vertices), evidence.camera).image
        for g in (few, everything)
    ]
    torch.testing.assert_close(*pictures, atol=1e-6, rtol=0)


def test_its_guess_can_be_adapted_to_the_photo(network, hand, evidences):
    evidence = evidences[0]
    guess = NetworkPrior(network)(evidence)
    done = adapt(hand, guess, evidence, AdaptConfig(calibration_steps=5, texture_steps=5))

    def psnr(gaussians):
        posed = pose_gaussians(gaussians, hand.faces, evidence.rest.vertices, evidence.posed.vertices)
        return masked_psnr(render(posed, evidence.camera).image.clamp(0, 1), evidence.image, evidence.mask)

    assert psnr(done.gaussians) > psnr(guess)
