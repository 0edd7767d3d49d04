from dataclasses import replace

import pytest
import torch
from synthetic import BACK_TO_CAMERA, PALM_TO_CAMERA, crop_of

from oasis_warp.avatar.observation import CropBatch, batch_of_crop
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork


@pytest.fixture(scope="session")
def tiny():
    """The compact profile with few channels: every part is there, a pass takes a fifth of a second."""
    return replace(
        COMPACT, image_size=64, width=32, heads=2, n_tokens=16, n_coarse=64, refine_layers=1, head_width=16
    )


@pytest.fixture(scope="session")
def crops(hand):
    """A light palm and a dark back."""
    prior = MeanPrior(hand)
    light, _, _ = crop_of(hand, prior.vertex_colors(0.02), size=64, orientation=PALM_TO_CAMERA)
    dark, _, _ = crop_of(
        hand, prior.vertex_colors(0.2), size=64, orientation=BACK_TO_CAMERA, pose_name="fist"
    )
    return light, dark


@pytest.fixture(scope="session")
def batch(crops):
    return CropBatch(*(torch.cat(parts) for parts in zip(*map(batch_of_crop, crops), strict=True)))


@pytest.fixture(scope="session")
def make_network(hand):
    def make(config, awake=True):
        """Seeded weights; `awake` ones have heads that say something, and gates and biases that are not at rest."""
        with torch.random.fork_rng(devices=[]):  # weights are made on the CPU
            torch.manual_seed(0)
            network = HandNetwork(config, hand)
            if awake:
                for name, parameter in network.named_parameters():
                    if not parameter.any() or "norm" in name:
                        torch.nn.init.normal_(parameter, std=0.1)
        return network

    return make


@pytest.fixture(scope="session")
def network(make_network, tiny):
    return make_network(tiny)


@pytest.fixture
def random():
    return torch.Generator().manual_seed(0)
