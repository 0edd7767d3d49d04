"""A network and a training of a second."""

from dataclasses import replace

import torch

from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.pretraining.distributed import ProcessInfo
from oasis_warp.pretraining.pretrain import PretrainConfig

ALONE = ProcessInfo(0, 1, torch.device("cpu"))
SMALL = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
CONFIG = PretrainConfig(steps=4, warmup=2, precision="float32", checkpoint_every=2, log_every=1)


def small_network(hand, **switches):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return HandNetwork(replace(SMALL, **switches), hand)
