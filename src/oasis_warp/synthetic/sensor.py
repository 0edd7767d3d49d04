"""Simulate a phone's camera: exposure, white balance, lens, noise, tone curve, sharpening, JPEG."""

import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad

from oasis_warp.synthetic.ops.surface_patterns import pixel_noise

_LUMA = (0.2126, 0.7152, 0.0722)
_PLACES = {
    "exposure": 0, "metering": 1, "balance": 2, "tint": slice(3, 6), "vignette": 6, "blur": 7, "noise": 8, "grain": 9,
    "filmic": 10, "contrast": 11, "saturation": 12, "sharpening": 13, "quality": 14,
}  # fmt: skip
"""Columns of a sensor's fields in its row."""
_SHARPENED = 1.2
"""Blur of the unsharp mask [px]."""
_TAPS = 4
"""Radius of blur kernels [px]."""
# Quantisation tables of the JPEG standard (ITU-T T.81, annex K), and the JFIF colour transform.
_LUMA_STEPS = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51,
    87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
_CHROMA_STEPS = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99, 47, 66, 99, 99, 99,
    99, 99, 99, *(99,) * 32,
)  # fmt: skip
_TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))


class Sensor(NamedTuple):
    """One camera and its settings."""

    exposure: float
    """Exposed value of an 18 % grey card in mean light."""
    metering: float
    """0 meters incident light; 1 meters the picture, which turns pale and dark hands grey."""
    balance: float
    """Share of the light's colour that white balance removes."""
    tint: np.ndarray
    """Its error: a factor per channel, [3]."""
    vignette: float
    blur: float
    """Standard deviation of the lens blur [px at a side of 256]."""
    noise: float
    grain: float
    """Standard deviation of the noise's blur [px]."""
    filmic: bool
    contrast: float
    saturation: float
    sharpening: float
    quality: int
    """JPEG quality."""


def sample_sensor(rng: np.random.Generator) -> Sensor:
    """Sample a phone: near daylight balance, some contrast, some sharpening, JPEG quality 60 to 95."""
    u = rng.uniform
    return Sensor(
        exposure=float(np.exp(rng.normal(-1.72, 0.30))),
        metering=u(0.2, 0.65),
        balance=u(0.35, 1.0),
        tint=np.exp(rng.normal(0, [0.045, 0.02, 0.06])),
        vignette=u(0, 0.18),
        blur=u(0.3, 0.85) if rng.random() < 0.85 else u(0.85, 1.5),
        noise=float(np.exp(u(np.log(0.0015), np.log(0.014)))),
        grain=u(0.3, 0.9),
        filmic=bool(rng.random() < 0.35),
        contrast=u(0.2, 0.85),
        saturation=u(0.88, 1.12),
        sharpening=u(0, 0.45),
        quality=int(rng.integers(60, 96)),
    )


def sensor_row(sensor: Sensor) -> list[float]:
    """A sensor as the numbers of its row."""
    return [float(number) for value in sensor for number in np.atleast_1d(value)]


@functools.cache
def _constant(values: tuple, device: torch.device) -> Tensor:
    return torch.tensor(values, device=device)


def _blur(images: Tensor, sigmas: Tensor) -> Tensor:
    """Gaussian blur of each image [B, C, H, W] by its own sigma, with edges replicated."""
    batch, channels = images.shape[:2]
    at = torch.arange(-_TAPS, _TAPS + 1, device=images.device)
    kernel = torch.exp(-0.5 * (at / sigmas[:, None].clamp_min(0.05)) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)[:, None]
    flat = images.reshape(1, batch * channels, *images.shape[2:])
    with torch.backends.cudnn.flags(deterministic=True, allow_tf32=False):  # as on the CPU
        flat = conv2d(pad(flat, (_TAPS, _TAPS, 0, 0), mode="replicate"), kernel[:, :, None], groups=batch * channels)
        flat = conv2d(pad(flat, (0, 0, _TAPS, _TAPS), mode="replicate"), kernel[..., None], groups=batch * channels)
    return flat.view_as(images)


@functools.cache
def _dct(device: torch.device) -> Tensor:
    """Matrix of the 8-point discrete cosine transform."""
    k = torch.arange(8, dtype=torch.float64)
    basis = torch.cos(math.pi * (2 * k + 1) * k[:, None] / 16) / 2
    basis[0] /= math.sqrt(2)
    return basis.float().to(device)


@functools.cache
def _color_transforms(device: torch.device) -> tuple[Tensor, Tensor]:
    """Matrices from RGB to luma and chroma, and back."""
    to_ycc = torch.tensor(_TO_YCC)
    return to_ycc.to(device), torch.linalg.inv(to_ycc).to(device)


def _quantised(planes: Tensor, steps: Tensor) -> Tensor:
    """Round the cosine coefficients of planes [B, C, H, W] of whole 8 x 8 blocks to multiples of [B, 8, 8]."""
    dct = _dct(planes.device)
    blocks = planes.unflatten(3, (-1, 8)).unflatten(2, (-1, 8)).transpose(3, 4)
    steps = steps[:, None, None, None]
    rounded = (dct @ blocks @ dct.T / steps).round() * steps
    return (dct.T @ rounded @ dct).transpose(3, 4).flatten(4, 5).flatten(2, 3)


def jpeg(images: Float[Tensor, "B 3 H W"], qualities: Float[Tensor, "B"]) -> Float[Tensor, "B 3 H W"]:
    """Compress and decompress sRGB images in [0, 1] as JPEG does with half-size chroma."""
    device, (height, width) = images.device, images.shape[2:]
    scale = torch.where(qualities < 50, 5000 / qualities, 200 - 2 * qualities)[:, None]

    def steps(table: tuple[int, ...]) -> Tensor:
        return ((_constant(table, device) * scale + 50) / 100).floor().clamp(1, 255).view(-1, 8, 8)

    whole = (images * 255).round()
    whole = pad(whole, (0, -width % 16, 0, -height % 16), mode="replicate")
    to_ycc, from_ycc = _color_transforms(device)
    ycc = torch.einsum("cd,bdhw->bchw", to_ycc, whole)
    luma = _quantised(ycc[:, :1] - 128, steps(_LUMA_STEPS)) + 128
    chroma = _quantised(avg_pool2d(ycc[:, 1:], 2), steps(_CHROMA_STEPS))
    chroma = interpolate(chroma, scale_factor=2, mode="bilinear", align_corners=False)
    rgb = torch.einsum("cd,bdhw->bchw", from_ycc, torch.cat([luma, chroma], 1))
    return (rgb[..., :height, :width] / 255).clamp(0, 1)


def srgb(linear: Tensor) -> Tensor:
    """Convert linear light to sRGB."""
    return torch.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-8) ** (1 / 2.4) - 0.055)


def meter(
    light: Float[Tensor, "B H W 3"],
    alpha: Float[Tensor, "B H W"],
    sensors: Float[Tensor, "B 15"],
    incident: Float[Tensor, "B 3"],
) -> Float[Tensor, "B 3"]:
    """Gains of the channels of linear light: exposure and white balance. See `expose` for the arguments."""
    luma = _constant(_LUMA, light.device)
    weight = alpha * 0.7 + 0.25
    mirrored = ((light * luma).sum(3).clamp(max=2.0) * weight).sum((1, 2)) / weight.sum((1, 2))
    falling = 0.18 * (incident * luma).sum(1)
    exposure, share, tint, balance = (sensors[:, _PLACES[k]] for k in ("exposure", "metering", "tint", "balance"))
    gain = exposure / (falling.clamp_min(1e-3) ** (1 - share) * mirrored.clamp_min(1e-3) ** share)
    white = incident / incident.mean(1, keepdim=True)
    return gain[:, None] * tint / white ** balance[:, None]


def _toned(x: Float[Tensor, "B 3 H W"], sensors: Float[Tensor, "B 15"]) -> Float[Tensor, "B 3 H W"]:
    """Apply tone curve, contrast and saturation to exposed linear light; the result is sRGB."""

    def cast(name: str) -> Tensor:
        return sensors[:, _PLACES[name]][:, None, None, None]

    film = x * 1.1
    film = film * (2.51 * film + 0.05) / (film * (2.43 * film + 0.59) + 0.14)
    x = srgb(torch.where(cast("filmic") > 0, film, 1 - torch.exp(-1.55 * x)))
    x = x + cast("contrast") * x * (1 - x) * (2 * x - 0.9)
    grey = (x * _constant(_LUMA, x.device)[:, None, None]).sum(1, keepdim=True)
    return grey + (x - grey) * cast("saturation")


def develop(
    light: Float[Tensor, "B H W 3"], gains: Float[Tensor, "B 3"], sensors: Float[Tensor, "B 15"]
) -> Float[Tensor, "B H W 3"]:
    """`expose` with given gains (see `meter`) and without vignette, blur, noise, sharpening and JPEG."""
    x = light.permute(0, 3, 1, 2) * gains[:, :, None, None]
    return _toned(x.clamp_min(0), sensors).clamp(0, 1).permute(0, 2, 3, 1)


def expose(
    light: Float[Tensor, "B H W 3"],
    alpha: Float[Tensor, "B H W"],
    sensors: Float[Tensor, "B 15"],
    incident: Float[Tensor, "B 3"],
    seeds: Int[Tensor, "B"],
) -> Float[Tensor, "B H W 3"]:
    """Take photos of linear light; sRGB in [0, 1].

    Args:
        light: Linear light of the scene.
        alpha: Share of each pixel that is hand, on which metering concentrates.
        sensors: A `sensor_row` per image.
        incident: Irradiance over pi on the hand, linear RGB.
        seeds: Seeds of the noise.
    """
    device, size = light.device, light.shape[2]

    def column(name: str) -> Tensor:
        return sensors[:, _PLACES[name]]

    def cast(name: str) -> Tensor:
        return column(name)[:, None, None, None]

    x = light.permute(0, 3, 1, 2) * meter(light, alpha, sensors, incident)[:, :, None, None]
    at = (torch.arange(size, device=device) + 0.5) / size * 2 - 1
    x = x * (1 - cast("vignette") * (at[:, None] ** 2 + at**2))
    x = _blur(x, column("blur") * size / 256)
    grain = pixel_noise(seeds, 3, x.shape[2], size)
    grain = _blur(grain, column("grain")) * cast("noise") * (x.clamp_min(0) + 0.01).sqrt() * 1.5
    x = _toned((x + grain).clamp_min(0), sensors)
    x = x + cast("sharpening") * (x - _blur(x, torch.full((len(x),), _SHARPENED, device=device)))
    return jpeg(x.clamp(0, 1), column("quality")).permute(0, 2, 3, 1)
