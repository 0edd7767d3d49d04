"""Devices that compute."""

import torch

from oasis_warp.core.config import ReconstructConfig, check_config
from oasis_warp.core.errors import InputError


def check_run(config: ReconstructConfig) -> None:
    """Check the options of a reconstruction, and its device.

    Raises:
        InputError: see `check_config` and `check_device`.
    """
    check_config(config)
    check_device(config.device)


def check_device(device: torch.device | str, flag: str = "") -> None:
    """Check that torch can compute on `device`; `flag` stands before names in messages: "--" on the command line.

    Raises:
        InputError: there is no CUDA device.
    """
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            f"{flag}device {device}: torch finds no CUDA device; use {flag}device cpu, or see `oasis doctor`."
        )
