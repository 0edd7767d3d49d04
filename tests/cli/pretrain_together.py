"""`oasis pretrain` with a tiny network, in each of the processes that torchrun starts; run by its command's test.

With DIE_AT in the environment process 1 kills itself after that step, the first time that torchrun starts it.
"""

import functools
import os
import signal
import sys

import torch
from test_pretrain_command import TINY

from oasis_warp.cli import main, pretrain
from oasis_warp.network.config import PROFILES
from oasis_warp.pretraining.prior_trainer import PriorTrainer

advance = PriorTrainer.advance


def advance_or_die(trainer, batch):
    result = advance(trainer, batch)
    if trainer.step == int(os.environ["DIE_AT"]):
        os.kill(os.getpid(), signal.SIGKILL)
    return result


if __name__ == "__main__":
    torch.set_num_threads(1)
    PROFILES["compact"] = TINY
    pretrain.PretrainConfig = functools.partial(pretrain.PretrainConfig, checkpoint_every=2)
    if "DIE_AT" in os.environ and os.environ["RANK"] == "1" and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
        PriorTrainer.advance = advance_or_die
    sys.exit(main(["pretrain", *sys.argv[1:]]))
