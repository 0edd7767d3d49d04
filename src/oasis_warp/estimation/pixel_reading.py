"""The dense network on a photo: what each pixel around a hand shows, as a right hand, and where on it."""

import functools
from dataclasses import dataclass
from importlib import resources

import cv2
import numpy as np
import torch
from scipy.spatial import KDTree

from oasis_warp.assets import asset
from oasis_warp.core.mirror import mirror_reading
from oasis_warp.core.processes import using_threads
from oasis_warp.core.types import SurfaceReading
from oasis_warp.estimation.fit import SurfacePoints
from oasis_warp.estimation.fit_problem import MirroredInput
from oasis_warp.hand.kinematics import HandKinematics, bundled_kinematics
from oasis_warp.network.dense_network import FRONT, HAND, SURFACE_UNIT, DenseNetwork, load_dense_network

SIDE = 256
"""Side of the crop that the network reads [px]; a multiple of 16."""
MARGIN = 1.6
"""Side of the crop over the longer side of the landmarks' box."""
RARE_FRONT = 3.0
"""Logarithm of how much rarer things in front of a hand are in users' photos than in training, where 16 % of photos
have one (Bayes' rule). Without it shaded palms counted as such things. Chosen on the 52 photos of single hands, whose
masks then overlap the fit by .937 instead of .908 at 5 %, and .963 instead of .959 in the median."""


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
    """sRGB colour of the skin in even white light, [3, S, S]."""
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
def bundled_dense_network(device: str) -> DenseNetwork:
    """The network that ships with the package, on a device.

    Raises:
        InputError: its file is missing or damaged.
    """
    with resources.as_file(asset("estimator", "dense.safetensors")) as path:
        return load_dense_network(path).to(device, memory_format=torch.channels_last)


def read_pixels(rgb: np.ndarray, xy: np.ndarray, network: DenseNetwork | None = None) -> PixelReading:
    """Read the pixels around a right hand.

    Args:
        rgb: The photo, [H, W, 3] bytes; a left hand mirrored.
        xy: Landmarks [px of the photo], [21, 2]; NaN for those that are not known.
        network: Another network than the bundled one, or that on another device than the CPU.
    """
    network = network or bundled_dense_network("cpu")
    device = next(network.parameters()).device
    low, high = np.nanmin(xy, 0), np.nanmax(xy, 0)
    side = MARGIN * max(float((high - low).max()), 1.0)
    corner, scale = (low + high) / 2 - side / 2, SIDE / side
    crop = _crop(rgb, corner, scale)
    exact = torch.backends.cudnn.flags(deterministic=True, allow_tf32=False)  # on CUDA as on the CPU
    with torch.inference_mode(), exact, using_threads(1):  # several share sums out differently, and bits would change
        image = torch.from_numpy(crop).to(device).permute(2, 0, 1)[None].float() / 255
        points = torch.from_numpy((xy - corner) * scale)[None].float().to(device)
        out = network(image.contiguous(memory_format=torch.channels_last), points)
        classes = out.classes[0].clone()
        classes[FRONT] -= RARE_FRONT
        return PixelReading(
            corner,
            scale,
            crop,
            classes.softmax(0).cpu().numpy(),
            SURFACE_UNIT * out.surface[0].cpu().numpy(),
            SURFACE_UNIT * out.log_scale[0].exp().cpu().numpy(),
            out.normal[0].cpu().numpy(),
            out.albedo[0].cpu().numpy(),
            out.finger[0].softmax(0).cpu().numpy(),
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


_HAND = 0.6
"""Least probability of the hand at a pixel that is used."""
_SPREAD = 0.015
"""Largest spread of the surface point at a pixel that is used [m]."""
_MAX_POINTS = 500
"""More do not fit better: the errors of neighbouring pixels are alike."""


@functools.cache
def _rest_places(template: bytes) -> KDTree:
    return KDTree(np.frombuffer(template).reshape(-1, 3))


def surface_points(kinematics: HandKinematics, reading: PixelReading, scale: float) -> SurfacePoints:
    """Where the confident pixels of the hand lie on the mean hand at rest; at most some 500, evenly over the picture.

    `scale` is in pixels of the photo per metre.
    """
    good = (reading.hand > _HAND) & (reading.spread < _SPREAD)
    step = max(1, int(np.ceil(np.sqrt(good.sum() / _MAX_POINTS))))
    rows, columns = np.nonzero(good[step // 2 :: step, step // 2 :: step])
    rows, columns = rows * step + step // 2, columns * step + step // 2
    places = reading.surface[:, rows, columns].T.astype(np.float64)
    # the network knows places on the bundled hand
    learned = kinematics if kinematics.hand.origin is None else bundled_kinematics()
    _, vertex = _rest_places(learned.template.tobytes()).query(places)
    normal = learned.rest_normals[vertex]
    offset = places - learned.template[vertex]
    offset -= normal * (offset * normal).sum(1, keepdims=True)
    if learned is not kinematics:
        offset[:] = 0  # below half an edge, and turned as the two hands rest differently
    return SurfacePoints(
        vertex=vertex,
        offset=offset,
        displacement=offset,
        xy=reading.to_photo(np.stack([columns, rows], 1) + 0.5),
        spread=scale * reading.spread[rows, columns].astype(np.float64),
        normal=reading.normal[:, rows, columns].T.astype(np.float64),
    )


def surface_reading(reading: PixelReading, view: MirroredInput) -> SurfaceReading:
    """What the network reads in `view`, in the photo's own frame."""
    spread = np.where(reading.hand > _HAND, reading.spread, np.inf)
    x, y = reading.corner / view.scale
    places, albedo = (torch.from_numpy(planes).permute(1, 2, 0) for planes in (reading.surface, reading.albedo))
    side = SIDE / reading.scale / float(view.scale[0])
    found = SurfaceReading(places, torch.from_numpy(spread), albedo, float(x), float(y), side)
    return mirror_reading(found, view.photo_size[0]) if view.mirrored else found
