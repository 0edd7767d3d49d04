"""How to look at an avatar: what the options of `render` and `animate` mean."""

import torch

from oasis_warp.core.config import BLACK, WHITE
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar

MAX_SIDE = 8192
"""Of a picture [px]."""
COLORS = {"white": WHITE, "black": BLACK}


def check_device(device: str) -> None:
    """Check that torch can compute on `device`.

    Raises:
        InputError: there is no CUDA device.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no CUDA device; use --device cpu, or see `oasis doctor`.")


def check_side(size: int) -> None:
    """Check the side of a picture [px].

    Raises:
        InputError: too small or too large.
    """
    if not 16 <= size <= MAX_SIDE:
        raise InputError(f"--size {size}: expected 16 to {MAX_SIDE} pixels; choose another size.")


def read_color(text: str) -> tuple[float, float, float]:
    """The colour that `text` names or spells as rrggbb.

    Raises:
        InputError: neither.
    """
    if text in COLORS:
        return COLORS[text]
    digits = text.removeprefix("#")
    if len(digits) != 6 or not all(digit in "0123456789abcdefABCDEF" for digit in digits):
        raise InputError(f"--background {text}: expected {', '.join(COLORS)} or six hex digits; write e.g. d0e0f0.")
    red, green, blue = bytes.fromhex(digits)
    return red / 255, green / 255, blue / 255


def choose_pose(avatar: Avatar, name: str) -> HandPose:
    """The avatar's hand in the named pose, held as in the photo; "photo" is the photo's own pose."""
    if name == "photo":
        return avatar.source_pose
    return avatar.source_pose._replace(angles=named_pose(avatar.hand, name))
