"""Compile the network into one graph, forward and backward; prints the largest difference. Run by test_hand_network.py.

A process of its own, because the shape checks of the test run are Python that torch.compile cannot look through.
"""

from dataclasses import replace

import torch

from oasis_warp.avatar.observation import CropBatch
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork


def main():
    torch.manual_seed(0)
    hand = bundled_hand()
    config = replace(COMPACT, image_size=32, width=16, heads=2, n_tokens=8, n_coarse=32, refine_layers=1, head_width=8)
    network = HandNetwork(config, hand)
    for head in (network.vertex_head, network.face_head):
        torch.nn.init.normal_(head.last.weight)
    viewmat, K = torch.eye(4), torch.tensor([[80.0, 0, 16], [0, 80, 16], [0, 0, 1]])
    viewmat[2, 3] = 0.6
    inputs = CropBatch(
        torch.rand(1, 32, 32, 3), torch.ones(1, 32, 32), hand.template[None], viewmat[None], K[None],
        hand.template[None],
    )  # fmt: skip
    compiled = torch.compile(network, fullgraph=True, backend="aot_eager")
    expected, out = network(inputs), compiled(inputs)
    sum(part.sum() for part in out).backward()
    assert all(parameter.grad is not None for parameter in network.parameters())
    print(max(float((a - b).abs().max().detach()) for a, b in zip(expected, out, strict=True)))


if __name__ == "__main__":
    main()
