"""Several processes, one model: what torchrun set up, or a process alone."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor


class Place(NamedTuple):
    """This process among all."""

    rank: int
    world: int
    device: torch.device


@contextmanager
def join_processes(device: str) -> Iterator[Place]:
    """Join the processes that torchrun started, over NCCL on CUDA and gloo on the CPU; a process alone joins none."""
    world, local = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("LOCAL_RANK", 0))
    here = torch.device(device, local) if device == "cuda" else torch.device(device)
    if device == "cuda":
        torch.cuda.set_device(here)
    if world == 1:
        yield Place(0, 1, here)
        return
    dist.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield Place(dist.get_rank(), world, here)
    finally:
        dist.destroy_process_group()


def mean_over_processes(values: Tensor, world: int) -> Tensor:
    """The mean of `values` of all processes."""
    if world > 1:
        dist.all_reduce(values)
        values = values / world
    return values
