"""Train one model with several processes, as set up by torchrun, or with one."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from oasis_warp.core.errors import InputError


class ProcessInfo(NamedTuple):
    """This process among all processes."""

    rank: int
    world: int
    device: torch.device


@contextmanager
def join_processes(device: str) -> Iterator[ProcessInfo]:
    """Join the processes that torchrun started, over NCCL on CUDA and gloo on the CPU; without torchrun there is one.

    Raises:
        InputError: fewer CUDA devices than processes.
    """
    world, local = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("LOCAL_RANK", 0))
    here = torch.device(device, local) if device == "cuda" else torch.device(device)
    if device == "cuda":
        found = torch.cuda.device_count()
        if local >= found:
            raise InputError(
                f"--nproc-per-node: expected at most {found}, as many as there are CUDA devices; give torchrun less."
            )
        torch.cuda.set_device(here)
    if world == 1:
        yield ProcessInfo(0, 1, here)
        return
    dist.init_process_group("nccl" if device == "cuda" else "gloo")
    yield ProcessInfo(dist.get_rank(), world, here)
    # Not after an error: it would wait for the other processes, which wait for this one; torchrun ends them all.
    dist.destroy_process_group()


def mean_over_processes(values: Tensor, world: int) -> Tensor:
    """The mean of `values` over all processes."""
    if world > 1:
        dist.all_reduce(values)
        values = values / world
    return values


def share_weights(parameters: Sequence[Tensor], world: int) -> None:
    """Copy the weights of process 0 to all processes."""
    if world > 1:
        for parameter in parameters:
            dist.broadcast(parameter.data, 0)


def average_gradients(parameters: Sequence[Tensor], world: int) -> None:
    """Replace gradients by their means over the processes, in one all-reduce that a CUDA graph can capture."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if world == 1 or not gradients:
        return
    together = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(together)
    together /= world
    parts = together.split([gradient.numel() for gradient in gradients])
    torch._foreach_copy_(gradients, [part.view_as(g) for part, g in zip(parts, gradients, strict=True)])


def any_process(flag: bool, process: ProcessInfo) -> bool:
    """Whether `flag` is set in any process: the same answer in all, and all must call this."""
    if process.world == 1:
        return flag
    votes = torch.tensor(float(flag), device=process.device)
    dist.all_reduce(votes)
    return bool(votes > 0)


def wait_for_all(process: ProcessInfo) -> None:
    """Wait until every process has called this."""
    any_process(False, process)
