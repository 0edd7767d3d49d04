"""`oasis pretrain` with a tiny network, in each of the processes that torchrun starts; run by its command's test."""

import sys

import torch
from test_pretrain_command import TINY

from oasis_warp.cli import main
from oasis_warp.network.config import PROFILES

if __name__ == "__main__":
    torch.set_num_threads(1)
    PROFILES["compact"] = TINY
    sys.exit(main(["pretrain", *sys.argv[1:]]))
