"""Backgrounds of one colour, made once: each new one would cost a copy to the device or a kernel."""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.tracing import is_traced

MAX_KEPT = 256
"""Others are made anew at every call. None is ever dropped: another stream may still be reading it."""
_kept: dict[tuple[tuple[float, ...], int, torch.dtype, torch.device], Tensor] = {}


def plain_background(color: tuple[float, ...], n_cameras: int, like: Tensor) -> Float[Tensor, "C D"]:
    """The `color` once a camera, of the type and on the device of `like`; many calls share it, none may write to it."""
    if is_traced():
        return like.new_tensor(color).expand(n_cameras, -1)
    key = color, n_cameras, like.dtype, like.device
    kept = _kept.get(key)
    if kept is not None:
        return kept
    with torch.inference_mode(False), torch.no_grad():
        # Filled, not copied from the host, which a stream that is being captured could not do.
        made = torch.empty(n_cameras, len(color), dtype=like.dtype, device=like.device)
        for channel, value in enumerate(color):
            made[:, channel] = value
    if made.is_cuda:
        if torch.cuda.is_current_stream_capturing():
            return made  # filled whenever the graph runs, and its memory is the graph's
        torch.cuda.current_stream(made.device).synchronize()  # for later calls from other streams
    if len(_kept) < MAX_KEPT:
        _kept[key] = made
    return made
