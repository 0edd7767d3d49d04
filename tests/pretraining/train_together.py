"""One step of pretraining in each of the processes that torchrun starts; run by test_pretrain.py."""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from painted_hands import PaintedHands
from safetensors.torch import save_file
from test_pretrain import CONFIG, small_network

from oasis_warp.hand.template import bundled_hand
from oasis_warp.pretraining.distributed import join_processes
from oasis_warp.pretraining.pretrain import pretrain
from oasis_warp.pretraining.prior_trainer import PriorTrainer


def main(folder: Path):
    hand = bundled_hand()
    torch.set_num_threads(1)
    with join_processes("cpu") as process:
        network = small_network(hand)
        source = PaintedHands(hand, hands=1, targets=1, size=32)
        pretrain(PriorTrainer(network, replace(CONFIG, steps=1, clip=1e9), process), source, folder)
        state = {name: parameter.detach() for name, parameter in network.named_parameters()}
        save_file(state, folder / f"rank{process.rank}.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
