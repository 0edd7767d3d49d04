"""Colours: sRGB as linear light, its luminance, and CIELAB; and backgrounds of one colour.

A background is made once: each new one would cost a copy to the device or a kernel.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.tracing import is_traced

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Share of linear red, green and blue in the luminance (ITU-R BT.709)."""
_XYZ = ((0.4124, 0.3576, 0.1805), LUMINANCE, (0.0193, 0.1192, 0.9505))
_KNEE = 6 / 29
"""Where CIELAB's cube root goes over into a line."""


def linear_light(srgb: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Linear light of sRGB colours, both in [0, 1] (IEC 61966-2-1)."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def luminance(srgb: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Luminance of sRGB colours, 1 for white."""
    return linear_light(srgb) @ srgb.new_tensor(LUMINANCE)


def cielab(srgb: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """L* in [0, 100], a* (green to red) and b* (blue to yellow) of sRGB colours under D65 (CIE 1976)."""
    matrix = srgb.new_tensor(_XYZ)
    share = linear_light(srgb) @ (matrix / matrix.sum(1, keepdim=True)).T
    line = share / (3 * _KNEE**2) + 4 / 29
    x, y, z = torch.where(share > _KNEE**3, share.clamp_min(1e-9) ** (1 / 3), line).unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


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
