"""The dense network on a photo: what each pixel around a hand shows, as a right hand."""

import functools
from dataclasses import dataclass
from importlib import resources

import cv2
import numpy as np
import torch

from oasis_warp.assets import asset
from oasis_warp.core.processes import using_threads
from oasis_warp.network.dense_network import FRONT, HAND, SURFACE_UNIT, DenseNetwork
from oasis_warp.network.dense_weights import load_dense_network

SIDE = 256
"""Side of the crop that the network reads [px]; a multiple of 16."""
MARGIN = 1.6
"""Side of the crop over the longer side of the landmarks' box."""


@dataclass(frozen=True)
class PixelReading:
    """What the network says about the pixels of a square crop; [S, S], S = `SIDE`, arrays of float32."""

    corner: np.ndarray
    """Upper left corner of the crop [px of the photo]."""
    scale: float
    """Pixels of the crop per pixel of the photo."""
    image: np.ndarray
    """The crop itself, [S, S, 3] bytes; black where the photo ends."""
    shares: np.ndarray
    """Probabilities of background, hand, arm or clothes, and things in front of the hand, [4, S, S]."""
    surface: np.ndarray
    """Point on the mean hand at rest [m], [3, S, S]."""
    spread: np.ndarray
    """Scale of the surface point's Laplace distribution [m]."""
    normal: np.ndarray
    """Unit normal in the camera's frame, [3, S, S]."""
    albedo: np.ndarray
    """Diffuse reflectance, linear RGB, [3, S, S]."""
    finger: np.ndarray
    """Probabilities of palm and back, thumb, index, middle, ring and little finger, [6, S, S]."""

    @property
    def hand(self) -> np.ndarray:
        """Probability of the hand's bare skin."""
        return self.shares[HAND]

    @property
    def front(self) -> np.ndarray:
        """Probability of a thing in front of the hand."""
        return self.shares[FRONT]

    def to_photo(self, at: np.ndarray) -> np.ndarray:
        """Points of the crop [px] -> photo [px]."""
        return at / self.scale + self.corner

    def in_photo(self, values: np.ndarray, size: tuple[int, int], outside: float = 0.0) -> np.ndarray:
        """Values of the crop [S, S] at the pixels of a photo of `size` (width, height); `outside` beyond the crop."""
        shift = -self.corner * self.scale + 0.5 * (self.scale - 1)  # cv2 counts pixel centres as whole numbers
        to_crop = np.array([[self.scale, 0, shift[0]], [0, self.scale, shift[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(values, to_crop, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)


@functools.cache
def bundled_dense_network() -> DenseNetwork:
    """The network that ships with the package.

    Raises:
        InputError: its file is missing or damaged.
    """
    with resources.as_file(asset("estimator", "dense.safetensors")) as path:
        return load_dense_network(path).to(memory_format=torch.channels_last)


def read_pixels(rgb: np.ndarray, xy: np.ndarray, network: DenseNetwork | None = None) -> PixelReading:
    """Read the pixels around a right hand.

    Args:
        rgb: The photo, [H, W, 3] bytes; a left hand mirrored.
        xy: Landmarks [px of the photo], [21, 2]; NaN for those that are not known.
        network: Another network than the bundled one.
    """
    network = network or bundled_dense_network()
    low, high = np.nanmin(xy, 0), np.nanmax(xy, 0)
    side = MARGIN * max(float((high - low).max()), 1.0)
    corner, scale = (low + high) / 2 - side / 2, SIDE / side
    crop = _crop(rgb, corner, scale)
    with torch.inference_mode(), using_threads(1):  # several share sums out differently, and bits would change
        image = torch.from_numpy(crop).permute(2, 0, 1)[None].float() / 255
        points = torch.from_numpy((xy - corner) * scale)[None].float()
        out = network(image.contiguous(memory_format=torch.channels_last), points)
        return PixelReading(
            corner,
            scale,
            crop,
            out.classes[0].softmax(0).numpy(),
            SURFACE_UNIT * out.surface[0].numpy(),
            SURFACE_UNIT * out.log_scale[0].exp().numpy(),
            out.normal[0].numpy(),
            _linear(out.albedo[0].numpy()),
            out.finger[0].softmax(0).numpy(),
        )


def _crop(rgb: np.ndarray, corner: np.ndarray, scale: float) -> np.ndarray:
    """The square crop, black where the photo ends, [SIDE, SIDE, 3] bytes; smoothed before it is reduced."""
    if scale < 0.5:
        factor = 2 * scale  # by areas to twice the size, then linearly
        size = [max(1, round(side * factor)) for side in rgb.shape[1::-1]]
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        corner, scale = corner * factor, scale / factor
    x, y = corner + 0.5 / scale - 0.5
    to_photo = np.array([[1 / scale, 0, x], [0, 1 / scale, y]])
    return cv2.warpAffine(rgb, to_photo, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def _linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
